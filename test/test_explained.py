# SPDX-License-Identifier: Apache-2.0
"""Objects say what they are: in ten lines of text, as a table in a notebook, by tab
completion.
"""

import dataclasses
import pydoc
import re
from xml.etree import ElementTree

import numpy as np
import pytest

from sst_ros import (
    Batch,
    InverseDynamics,
    Simulation,
    certify,
    certify_zone,
    distance_to_singularity,
    equations,
    linearize,
    load_scene,
    read_bag,
    reference_motion,
    simulate,
)
from sst_ros import __main__ as cli
from sst_ros.control.actuator_space import ReferenceMotion
from sst_ros.dynamics.motion_table import MotionTable
from sst_ros.mechanism.geometry import Geometry
from sst_ros.mechanism.kinematics import admissible
from sst_ros.mechanism.workspace import measures
from sst_ros.scene.scene import SCENE_TERMS, names
from sst_ros.scene.yaml_document import dump
from sst_ros.state import Explained


def made(bag):
    """One object of each class that explains itself."""
    scene = load_scene("swing")
    batch = Batch(scene, parameters={"star.mass": [1.0, 2.0]})
    recording = read_bag(bag)
    start = np.full((2, 3), 0.7)
    yield from (
        scene,
        Simulation(scene),
        Simulation(scene).state,
        InverseDynamics(scene),
    )
    yield from (reference_motion(load_scene("reach")), recording)
    yield from (
        batch,
        batch.run(start, 0.0 * start, step=1e-3, count=2),
        simulate(scene, duration=0.1),
        simulate(scene, duration=0.1).reactions,
        certify("example2", duration=0.01, t_eval=[0.01]),
        certify_zone("general", tilt=0.4, max_boxes=1_000),
        linearize(scene, None, (0.0, 0.0, 0.0)),
        equations("example2", "numpy"),
    )
    geometry, gamma = Geometry.of(scene), np.array(scene.initial.gamma)
    rotation = admissible(geometry, gamma).rotation
    yield from (
        geometry,
        measures(geometry, gamma, rotation),
        distance_to_singularity(scene, gamma),
        distance_to_singularity(scene, [gamma, gamma]),
    )


def test_each_object_says_in_ten_lines_what_its_table_says(example2_bag):
    pytest.importorskip("flint")
    objects = list(made(example2_bag))
    explained = {*Explained.__subclasses__(), *MotionTable.__subclasses__()} - {
        MotionTable
    }
    assert {type(one) for one in objects} == explained
    for one in objects:
        head, *lines = repr(one).splitlines()
        assert head == type(one).__name__ and 2 <= len(lines) <= 9
        rows = re.search("<table>.*?</table>", one._repr_html_(), re.S)[0]
        cells = [
            "".join(row.itertext()) for row in ElementTree.fromstring(rows).iter("tr")
        ]
        assert ["".join(line.split()) for line in lines] == [
            "".join(c.split()) for c in cells
        ]
        assert all(len(line) <= 230 for line in lines)


@pytest.mark.parametrize("name", names())
def test_a_scene_has_each_term_or_has_it_not(name):
    lines = repr(load_scene(name)).splitlines()[1:]
    said = dict(re.split(r"  +", line.strip(), maxsplit=1) for line in lines)
    listed = [*said["has"].split(", "), *said["has not"].split(", ")]
    assert sorted(set(listed) & set(SCENE_TERMS)) == sorted(SCENE_TERMS)


@pytest.mark.parametrize("error", [ZeroDivisionError, RuntimeError])
def test_what_cannot_be_said_is_left_out_and_no_error(error):
    def fail(time):
        raise error

    assert "gamma" not in repr(ReferenceMotion(fail, (0.0, 1.0)))


def test_tab_completion_shows_a_document_and_not_its_checks():
    scene = load_scene("swing")
    for part in (scene, scene.star):
        assert set(part.SPECS) < set(dir(part))
        hidden = {"SPECS", "ONE_OF", "EFFECTS", "ORIGIN", "check", "rules", "settle"}
        assert not hidden & set(dir(part))
    assert "with_values" in dir(scene)


def test_the_help_of_a_batch_is_short():
    text = pydoc.plain(pydoc.render_doc(Batch))
    assert len(text) < 8_000 and max(map(len, text.splitlines())) < 400


def test_geometries_of_a_map_say_how_many_they_are():
    one = Geometry.of(load_scene("general"))
    many = Geometry.build(np.stack([one.v] * 4), np.stack([one.alpha] * 4), [1.5] * 4)
    assert re.search(r"geometries +4\n", repr(many))


@pytest.mark.slow
def test_no_heading_of_a_scene_is_empty(tmp_path, capsys):
    bare = dataclasses.replace(load_scene("example1"), provenance=())
    path = tmp_path / "bare.yaml"
    path.write_text(dump(bare), encoding="utf-8")
    for name in (str(path), "friction"):
        assert cli.main(["scene", "show", name]) == 0
        lines = capsys.readouterr().out.splitlines()[1:]
        for line, after in zip(lines, [*lines[1:], ""], strict=True):
            if line and not line.startswith(" "):
                assert after.startswith("  "), line
