# SPDX-License-Identifier: Apache-2.0
"""Shipped scenes, where their values come from, and every way to get a scene wrong."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from sst_ros.__main__ import main
from sst_ros.cli.runs import implausible
from sst_ros.errors import InputError
from sst_ros.scene import scene as scenes
from sst_ros.scene.bodies import Inertia
from sst_ros.scene.loads import Initial
from sst_ros.scene.scene import Scene, load, names
from sst_ros.scene.yaml_document import dump, read

FOLDER = Path(__file__).parents[1] / "config" / "scenes"
every_scene = pytest.mark.parametrize("name", names())


def leaves(tree, path=""):
    """Dotted keys of all numbers of a document; entries of lists belong to the list."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from leaves(value, f"{path}.{key}" if path else key)
    elif isinstance(tree, list):
        for value in tree:
            yield from leaves(value, path)
    elif isinstance(tree, (int, float)):
        yield path


def test_the_examples_of_the_paper_are_shipped():
    assert {"example1", "example2_heavy", "example2_stroke"} <= set(names())
    assert names() == sorted(path.stem for path in FOLDER.glob("*.yaml"))


@every_scene
def test_a_shipped_scene_has_its_files_name_and_survives_a_dump(name):
    scene = load(name)
    assert scene.name == name
    assert scene == load(FOLDER / f"{name}.yaml") == read(Scene, dump(scene), "dump")


@every_scene
def test_every_number_says_where_it_comes_from(name):
    tree = yaml.safe_load((FOLDER / f"{name}.yaml").read_text(encoding="utf-8"))
    told = tree.pop("provenance")
    for leaf in leaves(tree):
        parts = leaf.split(".")
        prefixes = {".".join(parts[: i + 1]) for i in range(len(parts))}
        assert prefixes & set(told), f"{leaf} has no provenance"
    for key, said in told.items():
        # The inertias of the paper are lost.
        kinds = (
            "derived|assumed|chosen"
            if "inertia" in key
            else "printed|derived|assumed|chosen"
        )
        assert re.match(rf"({kinds})\b", said), key


def test_inertia_matrix_is_symmetric_with_the_tensors_entries():
    matrix = Inertia(xx=3.0, yy=4.0, zz=5.0, xy=0.1, xz=-0.2, yz=0.3).matrix
    np.testing.assert_array_equal(
        matrix, [[3, 0.1, -0.2], [0.1, 4, 0.3], [-0.2, 0.3, 5]]
    )


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("example9", r"'example9': must be .* one of .*example1, example2, "),
        ("none.yaml", r"'none\.yaml': must be a readable \.yaml file or one of"),
        ("binary.yaml", "codec can't decode"),
        ("a\0b", "must be a readable"),
    ],
)
def test_what_is_no_scene_is_refused(name, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(InputError, match=message):
        load(name)


def test_an_installation_without_scenes_is_told(monkeypatch, tmp_path):
    monkeypatch.setattr(
        "sst_ros.scene.scene.__file__", str(tmp_path / "a" / "scene.py")
    )
    with pytest.raises(InputError, match=r"config/scenes = .*: was not installed"):
        scenes.share_directory.__wrapped__()  # not the folder that is known already


# Other values by key.

EXAMPLE2 = load("example2_heavy")


def test_numbers_lists_sections_and_choices():
    other = EXAMPLE2.with_values(
        {
            "star.inertia.zz": np.float64(0.3),
            "base.v": np.array(EXAMPLE2.base.v) + 0.01,
            "actuated_links.inertia.xx": 0.02,
            "actuated_links[1].inertia.zz": 0.021,
            "star.mass": 2.6,
            "gravity.acceleration": (0.0, 0.0, -9.81),
            "stroke.at_end": "ignore",
            "torque": None,
            "initial.gamma_dot": 0.5,
            "initial.gamma[1]": 0.25,
        }
    )
    first, _, third = EXAMPLE2.initial.gamma
    links = [link.inertia for link in other.actuated_links]
    assert (other.star.inertia.zz, EXAMPLE2.star.inertia.zz) == (0.3, 0.26)
    assert other.base.v[0] == (1.01, 0.01, 0.01)
    assert [(i.xx, i.zz) for i in links] == [
        (0.02, 0.018375),
        (0.02, 0.021),
        (0.02, 0.018375),
    ]
    assert other.gravity.acceleration == (0.0, 0.0, -9.81)
    assert other.initial == Initial(
        gamma=(first, 0.25, third), gamma_dot=(0.5, 0.5, 0.5)
    )
    assert (other.stroke.at_end, other.torque) == ("ignore", None)
    assert EXAMPLE2.with_values({}) == EXAMPLE2


def test_arcs_define_the_directions_of_the_base():
    scene = EXAMPLE2.with_values({"base": {"arcs_deg": [70, 85, 95], "radius": 0.35}})
    v = np.array(scene.base.v)
    arcs = np.degrees(np.arccos(np.sum(v * np.roll(v, -1, axis=0), axis=1)))
    np.testing.assert_allclose([*arcs, *v[0]], [70, 85, 95, 1, 0, 0], rtol=1e-14)
    assert v[1, 2] == 0.0 < min(v[1, 1], v[2, 2])
    assert read(Scene, dump(scene), "dump") == scene


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"star.inertai.zz": 1.0}, "star.inertai"),
        ({"star.inertia.zz": -1.0}, "star.inertia"),
        ({"star.inertia.zz": "much"}, "must be a finite number"),
        ({"springs[0].rest": 1.0}, r"springs\[0\].rest = 1.0: names nothing"),
        ({"name.first": 1.0}, "names nothing"),
        ({"initial.gamma[-1]": None}, "names nothing"),
        ({"star.": None}, "names nothing"),
        ({"star.inertia.zz": {1, 2}}, "star.inertia.zz"),
        (
            {"star.inertia.zz": object()},
            "star.inertia.zz = .*: must be a finite number",
        ),
    ],
)
def test_what_makes_no_scene_is_refused(values, said):
    with pytest.raises(InputError, match=said):
        EXAMPLE2.with_values(values)


# Inertias that no body of the mass and radius given can have.


@every_scene
def test_a_shipped_mass_fits_its_inertia(name):
    assert implausible(load(name)) == ""


def test_a_star_too_heavy_for_its_mass_is_warned_of(tmp_path, capsys):
    """1.25 times thin arcs of 2.6 kg: the trace is 1.04 kg m^2, 2 m r^2 for 3.25 kg."""
    assert implausible(EXAMPLE2.with_values({"star.mass": 3.25})) == ""
    path = tmp_path / "heavy.yaml"
    path.write_text(dump(EXAMPLE2.with_values({"star.mass": 2.6})), encoding="utf-8")
    assert main(["scene", "check", str(path)]) == 0
    valid, warning = capsys.readouterr().out.splitlines()
    assert valid == f"{path}: valid, with warnings"
    assert (
        warning == f"{path}: warning: star.inertia: its trace is 1.04 kg m^2; a body of"
        " star.mass = 2.6 kg within star.radius = 0.4 m has at most 2 m r^2 = 0.832"
        " kg m^2"
    )


def test_thin_arcs_are_at_the_bound():
    assert implausible(load("example2").with_values({"star.mass": 2.6})) == ""
    assert implausible(load("example2").with_values({"star.mass": 2.59})) != ""


def test_a_file_is_parsed_once_for_each_of_its_texts(tmp_path, monkeypatch):
    """What is read is the file as it is now, and each scene is one of its own."""
    path, parsed = tmp_path / "scene.yaml", []
    original = scenes.read

    def count(*arguments):
        parsed.append(arguments)
        return original(*arguments)

    monkeypatch.setattr(scenes, "read", count)
    text = scenes.text_of("example2")[0]
    path.write_text(text, encoding="utf-8")
    first, second = load(path), load(path)
    assert len(parsed) == 1
    assert first == second
    assert first is not second
    assert first.star is not second.star
    vars(first)["name"] = "another"  # by force: scenes are read-only
    assert load(path) == second
    stamp = path.stat()
    changed = text.replace("name: example2", "name: changed!", 1)
    path.write_text(changed, encoding="utf-8")
    os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    assert load(path).name == "changed!"
    path.write_text(text, encoding="utf-8")
    assert load(path).name == "example2"
    assert len(parsed) == 2


def test_a_text_that_is_refused_is_refused_each_time(tmp_path):
    path = tmp_path / "scene.yaml"
    path.write_text("name: nothing else\n", encoding="utf-8")
    messages = []
    for _ in range(2):
        with pytest.raises(InputError) as refused:
            load(path)
        messages.append(str(refused.value))
    assert messages[0] == messages[1]
