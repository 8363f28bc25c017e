# SPDX-License-Identifier: Apache-2.0
"""The front door: its names, their documentation and types."""

import inspect
import re
from functools import partial
from pathlib import Path

import pytest
import yaml
from programs import python

import sst_ros
from sst_ros.scene.yaml_document import dump

PAGES = Path(__file__).parents[1] / "docs" / "api"
NAMES = [name for name in sst_ros.__all__ if name != "__version__"]
SCRIPT = """
import numpy as np
import sst_ros
from sst_ros import Geometry, Scene, Simulation, State, Trajectory, load_scene, simulate

scene: Scene = load_scene("example2")
run: Trajectory = simulate(scene, lambda t: (1.0, t, 0.0), 0.1)
held = simulate(scene, lambda t, state: state.joints.gamma, 0.1, control_period=1e-3)
total: float = float(np.sum(run.gamma)) + run.error_estimate
state: State = Simulation(scene).step((0.0, 0.0, 0.0), 1_000_000)
x, y, z, w = state.quaternion
geometry: Geometry = Geometry.of(scene)
gamma, mu, beta = sst_ros.inverse_kinematics(geometry, np.eye(3))
rotation = sst_ros.direct_kinematics(geometry, run.gamma[0])[0].rotation
inverse = sst_ros.InverseDynamics(scene)
torque: tuple[float, float, float] = inverse.gravity_torque(state.quaternion)
sst_ros.nothing
"""


@pytest.mark.parametrize("name", NAMES)
def test_each_name_has_a_docstring_and_one_entry_in_reference(name):
    assert inspect.getdoc(getattr(sst_ros, name))
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES.glob("*.md"))
    entries = re.findall(rf"^\.\. auto\w+:: sst_ros\.{name}$", text, re.M)
    assert len(entries) == 1
    assert f"`{name}`" in (PAGES / "index.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "make",
    [
        sst_ros.InverseDynamics,
        sst_ros.Simulation,
        sst_ros.reference_motion,
        partial(sst_ros.distance_to_singularity, gamma=[0.8, 0.7, 0.8]),
        partial(sst_ros.equilibrium, gamma=[0.8, 0.7, 0.8]),
        sst_ros.Batch,
    ],
)
def test_a_scene_is_its_name_its_document_or_a_scene(make):
    scene = sst_ros.load_scene("reach")
    said = [
        repr(make(given)) for given in ("reach", yaml.safe_load(dump(scene)), scene)
    ]
    assert said == [said[0]] * 3


def test_dir_shows_the_public_names_and_nothing_else():
    assert dir(sst_ros) == sorted(sst_ros.__all__)
    assert not hasattr(sst_ros, "nothing")


@pytest.mark.slow
def test_a_script_has_precise_types(tmp_path):
    pytest.importorskip("mypy", reason="types are checked by mypy")
    script = tmp_path / "script.py"
    script.write_text("\n".join([SCRIPT, *(f"sst_ros.{name}" for name in NAMES)]))
    words = ("-m", "mypy", "--strict", "--no-error-summary", str(script))
    done = python(*words, cwd=Path(__file__).parents[1], status=1, timeout=None)
    wrong = done.stdout.splitlines()
    assert len(wrong) == 1, done.stdout
    assert 'Module has no attribute "nothing"' in wrong[0]
