# SPDX-License-Identifier: Apache-2.0
"""The code structure that CONTRIBUTING.md describes is the one that is there."""

import importlib
import os
import re

import pytest
from docs.blocks import ROOT
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


TRACE = """
import pathlib, sys, threading
import bags, sst_ros
from sst_ros import Simulation, load_scene
from sst_ros.recording.recording import read
from sst_ros.report.run import evaluate_run, summary_table

def passed(call):
    files, base = set(), pathlib.Path(sst_ros.__file__).parent
    def profile(frame, event, argument):
        path = pathlib.Path(frame.f_code.co_filename)
        if event == "call" and base in path.parents:
            files.add(".".join(path.relative_to(base).with_suffix("").parts))
    threading.setprofile(profile)  # the report starts a thread
    sys.setprofile(profile)
    try:
        call()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return files

def step():
    simulation.step((0.0, 0.0, 0.0), 1_000_000)

def report():
    summary_table(evaluate_run(read(bag)).summary)

# What is imported at the first use is imported before.
Simulation("friction")
scene = load_scene("example2")
made = passed(lambda: Simulation({scene}))
simulation = Simulation("example2")
step()
print(*sorted(made))
print(*sorted(passed(step)))
if {reports}:
    bag = bags.write(pathlib.Path({folder!r}), bags.simulated(scene, 0.05))
    report()
    print(*sorted(passed(report)))
"""


def test_the_counts_of_files_are_those_of_calls(tmp_path):
    """The first Simulation of a scene by name and as a Scene, a later step, a later report."""
    found = []
    for scene in ('"example2"', "scene"):
        code = TRACE.format(scene=scene, folder=str(tmp_path / "bag"), reports=not found)
        done = python(code, env={"PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'test'}"})
        found.append([set(line.split()) for line in done.stdout.splitlines()])
    (by_name, step, report), (of_scene, *_) = found
    stated = [int(number) for number in re.findall(r"(\d+) files", SECTION)]
    assert stated == [len(files) for files in (step, by_name, of_scene, report)]
    blocks = SECTION.split("```")[3::2]
    for block, files in zip(blocks, (by_name, report), strict=True):
        assert {".".join(name.split(".")[:2]) for name in block.split()} <= files
