# SPDX-License-Identifier: Apache-2.0
"""The examples, run as a reader runs them; those that are nodes are in test/ros."""

import json
import runpy
import shutil
import sys
import warnings
from pathlib import Path

import bags
import numpy as np
import pytest
from docs.blocks import ROOT

from sst_ros import Simulation, load_scene
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene
from sst_ros.scene.yaml_document import read

EXAMPLES = ROOT / "examples"
NOTEBOOK = ROOT / "docs" / "tutorial" / "first_steps.ipynb"


NODES = ("controller", "push")
PICTURES = [
    path.stem
    for path in sorted(EXAMPLES.glob("*.py"))
    if path.stem not in (*NODES, "bag_to_pandas", "vector_env")
]


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Run a script as `__main__` in a copy of the folder, every warning an error."""
    pyplot = pytest.importorskip("matplotlib.pyplot", reason="pictures need matplotlib")
    pyplot.switch_backend("agg")
    shutil.copytree(EXAMPLES, tmp_path / "examples")
    monkeypatch.chdir(tmp_path / "examples")

    def found(name, *words):
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *map(str, words)])
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return runpy.run_path(f"{name}.py", run_name="__main__")

    yield found
    pyplot.close("all")


@pytest.mark.slow
@pytest.mark.parametrize("name", PICTURES)
def test_an_example_draws_its_picture(name, run):
    names = run(name)
    drawn = Path(f"{name}.png").read_bytes()
    assert drawn.startswith(b"\x89PNG") and len(drawn) > 10_000
    if name in CHECKS:
        assert CHECKS[name](names)


CHECKS = {
    "own_controller": lambda found: (
        np.abs(found["GOAL"] - found["motion"].gamma[-1]).max() < 1e-3
    ),
    "monte_carlo": lambda found: (
        0 < found["left"].sum() < len(found["runs"])
        and np.all(found["runs"].status[found["left"]] == 1)
    ),
    "energy": lambda found: np.ptp(found["motion"].energy) < 1e-12,
    "inverse_dynamics": lambda found: (
        np.abs(found["torque"].T - found["applied"]).max() < 1e-4
    ),
    "work_precision": lambda found: min(found["errors"]) < 1e-6,
    "iterative_lqr": lambda found: (
        found["errors"][-1] < 1e-4 and found["changes"][-1] < 1e-4 * found["changes"][0]
    ),
    "minimum_effort": lambda found: (
        max(found["errors"].values()) < 1e-8
        and 4 * found["motions"]["exact derivatives"] < found["motions"]["differences"]
    ),
    "mpc": lambda found: all(
        2 * found["errors"]["MPC", word] < found["errors"]["computed torque", word]
        for word in ("no noise", "noise")
    ),
    "observer": lambda found: found["inside"] >= 0.9,
    "zero_order_hold": lambda found: found["order"] == pytest.approx(2.0, abs=0.1),
}
"""What an example shows, by its names."""


def test_the_notebook_runs(tmp_path, monkeypatch):
    """Its cells one after the other in one namespace, as in a kernel."""
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    monkeypatch.chdir(tmp_path)
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    names: dict[str, object] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
            assert cell["outputs"] or "assert" in "".join(cell["source"]), (
                "run jupyter-execute --inplace on the notebook"
            )
    assert names["stopped"].status == 1
    assert np.abs(names["held"].gamma[-1] - names["goal"]).max() < 1e-6


def test_a_recording_as_a_table(run, tmp_path):
    bag = bags.write(tmp_path / "bag", bags.simulated(load_scene("example2"), 0.1))
    names = run("bag_to_pandas", bag)
    assert len(names["table"]) == 51
    assert names["table"]["gamma_1"].iloc[0] == pytest.approx(np.pi / 4)


def test_the_examples_geometry_stays_inside_for_its_whole_run():
    scene = load_scene(EXAMPLES / "my_geometry.yaml")
    simulation, torque, reach = (
        Simulation(scene),
        scene.torque.at,
        Geometry.of(scene).arc,
    )
    least = np.inf
    for tick in range(round(scene.duration * 500)):
        gamma = simulation.step(torque(tick * 2e-3), 2_000_000).joints.gamma
        least = min(least, *gamma, *(reach - gamma))
    assert least > 0.3


def test_the_tutorials_scene_is_the_examples():
    """The tutorial shows the same manipulator with less around it."""
    from docs.blocks import blocks

    (shown,) = (
        b.text for b in blocks("docs/tutorial/geometry.md") if b.language == "yaml"
    )
    tutorial, example = (
        read(Scene, shown, "tutorial"),
        load_scene(EXAMPLES / "my_geometry.yaml"),
    )
    for part in (
        "base",
        "star",
        "actuated_links",
        "intermediate_links",
        "gravity",
        "initial",
    ):
        assert getattr(tutorial, part) == getattr(example, part), part


OWN = """
from sst_ros import load_scene, simulate
scene = load_scene("general").with_values({
    "star.alpha_deg": [110, 120, 130], "base.v": [[1, 0, 0], [0.1, 1, 0], [0, 0.1, 1]],
    "payload.mass": 0.2, "payload.centre": [0, 0, 0.2],
    "gravity.acceleration": [0, 0, -9.81], "friction.gamma.viscous": 0.05})
start = [0.7, 0.8, 0.75], [0] * 3
motion = simulate(scene, lambda t: (0.3 * t, -0.2, 0.1), 0.1, initial=start)
print(motion.gamma.shape, motion.message)
motion.plot().savefig("motion.png")
"""


def test_what_a_first_user_wants_takes_few_lines(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(OWN, names)
    assert len(OWN.strip().splitlines()) <= 9
    assert (tmp_path / "motion.png").stat().st_size > 1000
    assert names["motion"].success
    assert np.all(np.isfinite(names["motion"].gamma))
