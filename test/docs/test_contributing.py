# SPDX-License-Identifier: Apache-2.0
"""The code structure that CONTRIBUTING.md describes is the one that is there."""

import importlib
import re

import pytest
from docs.blocks import ROOT, blocks
from programs import python

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


CORE = """
import sys
from pathlib import Path
import sst_ros
from sst_ros import simulate

folder, files = Path(sst_ros.__file__).parent, set()

def profile(frame, event, argument):
    path = Path(frame.f_code.co_filename)
    if event == "call" and path.is_relative_to(folder):
        files.add(path.relative_to(folder).as_posix())

sys.setprofile(profile)
simulate("example2")
sys.setprofile(None)
print(*files)
"""


@pytest.mark.slow
def test_the_core_is_what_a_call_of_simulate_passes():
    section = TEXT[TEXT.index("## The core") : TEXT.index("## Data paths")]
    numbered, helpers = section.split("The call also passes")
    named = re.findall(r"^\d+\. `([\w/]+\.py)`:", numbered, re.MULTILINE)
    assert len(named) == len(set(named)) > 10
    first_sentence = helpers[: helpers.index(".\n")]
    named += re.findall(r"`([\w/]+\.py)`", first_sentence)
    assert set(named) == set(python(CORE).stdout.split())


DIFFS = [block.text for block in blocks("docs/extend.md") if block.language == "diff"]


@pytest.mark.parametrize("diff", DIFFS)
def test_a_diff_of_the_page_fits_the_files_that_it_changes(diff):
    for part in diff.split("--- ")[1:]:
        head, _, *lines = part.splitlines()
        source = (ROOT / head).read_text(encoding="utf-8").splitlines()
        kept = [line[1:] for line in lines if line[:1] in ("-", " ") and line.strip()]
        assert set(kept) <= set(source), head
