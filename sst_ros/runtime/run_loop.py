# SPDX-License-Identifier: Apache-2.0
"""The run: waiting, running, paused, fault, finished. One thread owns it; no ROS types in here.

Others ask for changes by `ask`. They happen between two samples, in the run's own thread.
"""

from __future__ import annotations

import dataclasses
import math
import time
import traceback
from collections import deque
from collections.abc import Callable

from sst_ros.errors import RunStopped, SstError
from sst_ros.runtime.counters import Counters
from sst_ros.runtime.pacing import Pacer
from sst_ros.runtime.run_types import Answer, Audience, Phase, Reply
from sst_ros.runtime.tick_loop import Course, NoAnswer
from sst_ros.runtime.torque_input import CommandBoard, Settings
from sst_ros.scene.scene import Initial, Scene
from sst_ros.simulation import Simulation, Triple

IDLE_PERIOD_S = 0.1
_POLL_S = 0.001
_ANSWER_S = 30.0


class RunLoop:
    """State machine of one node's run.

    Attributes:
        phase: what it does now.
        fault: why it does nothing any more, until a reset.

    """

    def __init__(
        self,
        scene: Scene,
        build: Callable[[Scene], Simulation],
        settings: Settings,
        board: CommandBoard,
        pacer: Pacer,
        audience: Audience,
    ) -> None:
        self.phase, self.fault = Phase.WAITING, ""
        self._build, self._settings = build, settings
        self._board, self._audience = board, audience
        self._original = build(scene)
        self._course = Course(self._original, settings, board, pacer, audience)
        self._requests: deque[tuple[Callable[[], Reply], Answer]] = deque()

    @property
    def simulation(self) -> Simulation:
        """The present one; its `state` may be read by any thread."""
        return self._course.simulation

    @property
    def counters(self) -> Counters:
        """What has been done."""
        return self._course.counters

    @property
    def begun(self) -> bool:
        """Whether the first sample has been published since the start or the last reset."""
        return self._course.begun

    def ask(self, request: Callable[[], Reply], timeout: float = _ANSWER_S) -> Reply:
        """Have a request (`pause`, `reset`, ...) served by the run's thread; wait for the reply."""
        answer = self.post(request)
        if self._course.stop.is_set() or not answer.done.wait(timeout):
            return Reply(False, "the run did not answer: the node is shutting down or too slow")
        return answer.reply

    def post(self, request: Callable[[], Reply]) -> Answer:
        """Have a request served; do not wait."""
        answer = Answer()
        self._requests.append((request, answer))
        self._course.asked.set()
        return answer

    def stop(self) -> None:
        """Have `run` return soon."""
        self._course.stop.set()
        self._course.asked.set()

    def run(self) -> None:
        """Live until `stop` or the end of the run."""
        self._tell()
        act = {
            Phase.WAITING: self._wait_for_start,
            Phase.RUNNING: self._to_the_next_sample,
            Phase.PAUSED: self._idle,
            Phase.FAULT: self._idle,
        }
        while not self._course.stop.is_set() and self.phase is not Phase.FINISHED:
            try:
                self._serve()
                act[self.phase]()
            except (RunStopped, NoAnswer) as stopped:
                self._fail(str(stopped))
            except Exception as error:
                at = traceback.extract_tb(error.__traceback__)[-1]
                where = f"{at.filename.rpartition('/')[2]}:{at.lineno}"
                self._fail(f"internal error: {type(error).__name__}: {error} ({where})")
                self._course.stop.wait(IDLE_PERIOD_S)
        self._end_of_run()

    def pause(self, paused: bool) -> Reply:
        """Hold the run, or let it go on; idempotent."""
        if self.phase is Phase.FAULT:
            return Reply(False, f"fault, reset first: {self.fault}")
        if paused:
            said = "already paused" if self.phase is Phase.PAUSED else "paused"
            self._to(Phase.PAUSED)
            return Reply(True, said)
        if self.phase is not Phase.PAUSED:
            return Reply(True, f"not paused: {self.phase.value}")
        if self.begun:
            self._resume()
        else:
            self._to(Phase.WAITING)
        return Reply(True, self.phase.value)

    def step(self, samples: int = 1) -> Reply:
        """Advance a paused run by one sample or more, by the torques of the last command."""
        if self.phase is not Phase.PAUSED:
            return Reply(False, f"refused: only a paused run can be stepped, it is {self._said()}")
        if not self.begun and not self._course.begin():
            return Reply(False, "refused: there is no time yet on /clock")
        for _ in range(samples):
            self._course.refresh()
            try:
                if not self._course.to_the_next_sample(paced=False):
                    return Reply(False, "not done: the node is shutting down")
            except NoAnswer as none:
                return Reply(False, f"not done: {none}")
            except RunStopped as stopped:
                self._fail(str(stopped))
                return Reply(False, self._said())
        return Reply(True, f"at {self.simulation.time_ns / 1e9:.9f} s")

    def reset(self) -> Reply:
        """Go back to the scene's initial state; stamps go on, the command is forgotten."""
        self._original.reset()
        self._start_anew(self._original)
        self.fault = ""
        self.counters.resets += 1
        if self.phase is not Phase.PAUSED:
            self._to(Phase.WAITING)
        return Reply(True, f"at the initial state, {self.phase.value}")

    def set_state(self, gamma: Triple, gamma_dot: Triple) -> Reply:
        """Put a run that waits or is paused at another state [rad], [rad/s]."""
        if self.phase not in (Phase.WAITING, Phase.PAUSED):
            return Reply(False, f"refused: pause or reset first, the run is {self._said()}")
        try:
            initial = Initial(gamma=gamma, gamma_dot=gamma_dot)
            scene = dataclasses.replace(self._original.scene, initial=initial)
            self._start_anew(self._build(scene))
        except SstError as error:
            return Reply(False, f"refused: {error}")
        self.counters.states_set += 1
        return Reply(True, f"the state is set, {self.phase.value}")

    def _start_anew(self, simulation: Simulation) -> None:
        self._course.start_anew(simulation)
        self._show()

    def _serve(self) -> None:
        if not self._course.asked.is_set():
            return
        self._course.asked.clear()
        while self._requests:
            request, answer = self._requests.popleft()
            try:
                answer.reply = request()
            finally:
                answer.done.set()

    def _wait_for_start(self) -> None:
        """Show the state until a command begins the run, where one has to."""
        shown = -math.inf
        while not self._course.asked.is_set():
            called = not self._settings.parameters.waits or self._board.look()
            if called and self._course.begin():
                self._resume()
                return
            if time.monotonic() - shown > IDLE_PERIOD_S:
                shown = time.monotonic()
                self._show()
            time.sleep(_POLL_S)

    def _resume(self) -> None:
        self._to(Phase.RUNNING)
        self._course.resume()

    def _to_the_next_sample(self) -> None:
        if self._course.to_the_next_sample(paced=True) and self._course.is_over:
            self._to(Phase.FINISHED)

    def _fail(self, reason: str) -> None:
        """Latch a fault; the last valid state is published, then held."""
        self.fault = self.fault or reason
        if self.phase is not Phase.FAULT:
            self._course.publish_rest()
        self._to(Phase.FAULT)

    def _idle(self) -> None:
        self._show()
        self._course.asked.wait(IDLE_PERIOD_S)

    def _show(self) -> None:
        self._course.show(still=self.phase is Phase.FAULT)

    def _end_of_run(self) -> None:
        if self.phase is Phase.RUNNING:
            self._course.publish_rest()
        self.counters.hold()
        self._course.stop.set()
        while self._requests:
            self._requests.popleft()[1].done.set()

    def _to(self, phase: Phase) -> None:
        if phase is not Phase.RUNNING:
            self.counters.hold()
        if phase is not self.phase:
            self.phase = phase
            self._tell()

    def _tell(self) -> None:
        self._audience.changed(self._said())

    def _said(self) -> str:
        return f"{self.phase.value}: {self.fault}" if self.fault else self.phase.value
