# SPDX-License-Identifier: Apache-2.0
"""The code structure that CONTRIBUTING.md describes is the one that is there."""

import importlib
import re

import pytest
from docs.blocks import ROOT

TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
SECTION = TEXT[TEXT.index("## Data paths") : TEXT.index("## Where to add")]
NAMES = re.findall(r"^(\w+\.\w+\.[\w.]+)$", SECTION, re.MULTILINE)


@pytest.mark.parametrize("name", NAMES)
def test_a_function_of_a_data_path_exists(name):
    if name.startswith("nodes."):
        pytest.importorskip("rclpy", reason="needs rclpy: pip install .[ros]")
    room, module, *attributes = name.split(".")
    found = importlib.import_module(f"sst_ros.{room}.{module}")
    for attribute in attributes:
        found = getattr(found, attribute)
    assert callable(found)


def test_there_are_three_paths_and_every_room_is_in_the_tree():
    assert len(re.findall("```", SECTION)) == 6
    rooms = {path.parent.name for path in (ROOT / "sst_ros").glob("*/__init__.py")}
    tree = TEXT[TEXT.index("sst_ros/\n") : TEXT.index("## Data paths")]
    assert rooms <= set(re.findall(r"^  (\w+)/", tree, re.MULTILINE))
