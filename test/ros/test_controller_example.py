# SPDX-License-Identifier: Apache-2.0
"""The example of a controller as a node: free-running and in lockstep it reaches its goal."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from sensor_msgs.msg import JointState

pytestmark = pytest.mark.ros
EXAMPLE = Path(__file__).parents[2] / "examples" / "controller.py"
(GOAL,) = (
    ast.literal_eval(line.value)
    for line in ast.parse(EXAMPLE.read_text(encoding="utf-8")).body
    if isinstance(line, ast.Assign) and getattr(line.targets[0], "id", "") == "GOAL"
)


@pytest.mark.parametrize("sync", ["free", "lockstep"])
def test_it_reaches_its_goal(nodes, observer, sync):
    heard = observer.listen(JointState, "/joint_states")
    controller = subprocess.Popen([sys.executable, str(EXAMPLE)])
    try:
        nodes.run("simulator", scene="example2", sync=sync, wait_for_command=True)
        observer.until(
            lambda: heard and heard[-1].position[:3] == pytest.approx(GOAL, abs=0.02),
            "angles at the goal",
            30.0,
        )
    finally:
        controller.terminate()
        controller.wait(10.0)
