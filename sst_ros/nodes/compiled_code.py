# SPDX-License-Identifier: Apache-2.0
"""Whether a run uses machine code; where there is none yet, a process beside makes it."""

from __future__ import annotations

import os
import subprocess
import sys

from rclpy.node import Node

from sst_ros.integration import code_cache, codegen
from sst_ros.integration.cache_folder import cache_folder
from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.scene.scene import Scene


def use(node: Node, scene: Scene, given: SimulatorParameters) -> bool:
    """Tell whether to run machine code, and say so.

    To make it in this process would hold up the run for half a minute, at the start or when the
    integrator turns to another method.
    """
    if codegen.numba_version() is None:
        node.get_logger().info("plain Python: numba is not installed (or SST_ROS_NUMBA=0)")
        return False
    if code_cache.is_there(scene, given.integrator):
        node.get_logger().info(f"machine code from {cache_folder()}")
        return True
    maker = subprocess.Popen(
        [sys.executable, "-m", "sst_ros", "compile", given.scene, "--integrator", given.integrator],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # the next start needs the code, even if this run ends at once
        preexec_fn=lambda: os.nice(19),
    )
    node.get_logger().info(
        "plain Python, the same bits but slower: there is no machine code of the scene yet; "
        f"process {maker.pid} makes it for the next start"
    )
    return False
