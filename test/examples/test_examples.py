# SPDX-License-Identifier: Apache-2.0
"""The examples, run as a reader runs them; those that are nodes are in test/ros."""

import subprocess
import sys

import bags
import numpy as np
import pytest
from docs.blocks import ROOT

from sst_ros import Simulation, load_scene
from sst_ros.control.torque_profiles import sine
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene
from sst_ros.scene.yaml_document import read

EXAMPLES = ROOT / "examples"


PICTURES = {
    "own_scene": "largest angles [rad]",
    "own_controller": "error at the end [rad]",
    "monte_carlo": "% leave the stroke",
    "workspace": "drew ",
}


def run(name, *words):
    """What an example prints."""
    command = [sys.executable, "-W", "error", str(EXAMPLES / f"{name}.py"), *map(str, words)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=110)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


@pytest.mark.parametrize("name", PICTURES)
def test_an_example_draws_its_picture(name, tmp_path):
    if name == "monte_carlo":
        pytest.importorskip("numba", reason="needs numba: pip install .[fast]")
    picture = tmp_path / "picture.png"
    printed = run(name, picture)
    assert PICTURES[name] in printed
    assert picture.read_bytes().startswith(b"\x89PNG") and picture.stat().st_size > 10_000
    if name == "own_controller":
        errors = printed.partition("[rad]")[2].strip(" []\n").split()
        assert np.abs(np.array(errors, dtype=float)).max() < 1e-3


def test_a_recording_as_a_table(tmp_path):
    bag = bags.write(tmp_path / "bag", bags.simulated(load_scene("example2"), 0.1))
    shown = run("bag_to_pandas", bag)
    assert [line.split()[0] for line in shown.splitlines()[1:]] == [
        f"{name}_{k}" for name in ("gamma", "gamma_dot", "tau") for k in (1, 2, 3)
    ]


def test_the_examples_geometry_stays_inside_for_its_whole_run():
    scene = load_scene(EXAMPLES / "my_geometry.yaml")
    simulation, torque, reach = Simulation(scene), sine(scene.torque), Geometry.of(scene).arc
    least = np.inf
    for tick in range(round(scene.duration * 500)):
        gamma = simulation.step(torque(tick * 2e-3), 2_000_000).joints.gamma
        least = min(least, *gamma, *(reach - gamma))
    assert least > 0.3


def test_the_tutorials_scene_is_the_examples():
    """The tutorial shows the same manipulator with less around it."""
    from docs.blocks import blocks

    (shown,) = (b.text for b in blocks("docs/tutorial/geometry.md") if b.language == "yaml")
    tutorial, example = read(Scene, shown, "tutorial"), load_scene(EXAMPLES / "my_geometry.yaml")
    for part in ("base", "star", "actuated_links", "intermediate_links", "gravity", "initial"):
        assert getattr(tutorial, part) == getattr(example, part), part
