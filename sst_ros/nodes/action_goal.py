# SPDX-License-Identifier: Apache-2.0
"""A goal of an action that ends later than it is accepted."""

from __future__ import annotations

from typing import Any

from rclpy.task import Future


class ActionGoal:
    """An accepted goal that runs until `end`, which any thread may call.

    Attributes:
        handle: rclpy's handle of the goal.

    """

    def __init__(self, handle: Any) -> None:
        self.handle = handle
        self._result: Future[Any] = Future()
        handle.execute(self._wait)

    async def _wait(self, _: Any) -> Any:
        return await self._result

    def end(self, result: Any, *, success: bool) -> None:
        """End the goal with a result: canceled where that was requested, else as `success` is."""
        if self.handle.is_cancel_requested:
            self.handle.canceled()
        elif success:
            self.handle.succeed()
        else:
            self.handle.abort()
        self._result.set_result(result)
