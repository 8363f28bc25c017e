# SPDX-License-Identifier: Apache-2.0
"""Whether a run uses compiled code; where there is none yet, a process of low priority makes it."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys

from rclpy.node import Node
from rclpy.timer import Timer

from sst_ros.host.cache_folder import cache_folder
from sst_ros.integration import code_cache, codegen
from sst_ros.nodes.clocks import STEADY
from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.scene.scene import Scene

_DELAY_S = 5.0
"""Delay of the compiler: the first seconds of a real-time run have the processor alone."""


class CodeCompiler:
    """Finds the compiled code of a scene, or has it made for the next start.

    To compile in this process would delay the run by half a minute, at the start or when the
    integrator changes its method.

    Attributes:
        available: all code of the scene is there.

    """

    def __init__(self, node: Node, scene: Scene, given: SimulatorParameters) -> None:
        self._node, self._given = node, given
        self._timer: Timer | None = None
        self.available = False
        log = node.get_logger()
        if codegen.numba_version() is None:
            log.info("plain Python: numba is not installed (or SST_ROS_NUMBA=0)")
        elif code_cache.is_there(scene, given.integrator):
            self.available = True
            log.info(f"compiled code from {cache_folder()}")
        else:
            log.info("plain Python, the same bits but slower: the scene is not compiled yet")
            self._timer = node.create_timer(_DELAY_S, self.start, clock=STEADY)

    def start(self) -> None:
        """Start the compiler once, unless another process compiles; also at the end of the node."""
        if self._timer is None:
            return
        self._node.destroy_timer(self._timer)
        self._timer = None
        if _is_compiling():
            self._node.get_logger().info("another process compiles: this one does not")
            return
        given = self._given
        command = ["compile", given.scene, "--integrator", given.integrator]
        compiler = subprocess.Popen(
            [sys.executable, "-m", "sst_ros", *command],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # the next start needs the code, even if this run has ended
            preexec_fn=lambda: os.nice(19),
        )
        text = f"process {compiler.pid} compiles the scene for the next start"
        self._node.get_logger().info(text)


def _is_compiling() -> bool:
    """Whether a process has the lock of `code_cache.make`."""
    try:
        with (cache_folder() / "lock").open("r") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # not compiled yet
        return False
    return False
