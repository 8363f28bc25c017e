# SPDX-License-Identifier: Apache-2.0
"""Advice is what a run would do."""

import re

import pytest

from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.methods import DORMAND_PRINCE
from sst_ros.report import states
from sst_ros.report.step_advice import step_advice
from sst_ros.scene.scene import load
from sst_ros.simulation.simulation import Simulation


def test_a_stiff_scene_is_left_to_auto_which_changes_to_rodas4():
    stiff = load("stiff")
    assert re.match(r"auto, which changes to rodas4: the scene is stiff;", step_advice(stiff).text)
    simulation = Simulation(stiff)
    for _ in range(20):
        simulation.step((0.0, 0.0, 0.0), 5_000_000)
    assert simulation.method == "rodas4"


@pytest.mark.parametrize("name", ["friction", "spiral", "reach"])
def test_the_advised_steps_of_other_scenes_resolve_their_motion(name):
    scene = load(name)
    step = float(re.match(r"dopri5 with steps of (\S+) s or less", step_advice(scene).text)[1])
    system = ODE(Dynamics.of(scene))
    machine = CompiledMethod(system, DORMAND_PRINCE, compiled=False)
    start = list(states.initial(scene))
    drive = [0.0] * len(system.drive)
    whole, half = (machine.step_fixed(0.0, step / n, n * 20, start, drive) for n in (1, 2))
    assert max(abs(a - b) for a, b in zip(whole, half, strict=True)) < 1e-4
