# SPDX-License-Identifier: Apache-2.0
"""Examples that no page runs as a whole."""

import numpy as np
from docs.blocks import ROOT

from sst_ros import Simulation, load_scene
from sst_ros.control.torque_profiles import sine
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene
from sst_ros.scene.yaml_document import read

EXAMPLES = ROOT / "examples"


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
