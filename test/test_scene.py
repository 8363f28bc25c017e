# SPDX-License-Identifier: Apache-2.0
"""Shipped scenes, where their values come from, and every way to get a scene wrong."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from sst_ros.errors import InputError
from sst_ros.scene import scene as scenes
from sst_ros.scene.bodies import Inertia
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
def test_a_shipped_scene_is_called_like_its_file_and_survives_a_dump(name):
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
        kinds = "derived|assumed|chosen" if "inertia" in key else "printed|derived|assumed|chosen"
        assert re.match(rf"({kinds})\b", said), key


def test_inertia_matrix_is_symmetric_with_the_tensors_entries():
    matrix = Inertia(xx=3.0, yy=4.0, zz=5.0, xy=0.1, xz=-0.2, yz=0.3).matrix
    np.testing.assert_array_equal(matrix, [[3, 0.1, -0.2], [0.1, 4, 0.3], [-0.2, 0.3, 5]])


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("example9", r"'example9': must be .* one of .*example1, example2, "),
        ("none.yaml", r"No such file.*none\.yaml"),
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
    monkeypatch.setattr("sst_ros.scene.scene.__file__", str(tmp_path / "a" / "scene.py"))
    with pytest.raises(InputError, match=r"config/scenes = .*: was not installed"):
        scenes.share_directory()
