# SPDX-License-Identifier: Apache-2.0
"""Pictures of a run: all that the bag allows, with units, told apart without colour, as vectors.

Long curves keep all that a picture could show; a picture that finds no room is an OSError.
"""

import errno
import math
import re
import subprocess
import sys

import numpy as np
import pytest
from matplotlib import image

from sst_ros import __main__ as cli
from sst_ros.plot import motion, pictures, style
from sst_ros.plot.pictures import PICTURES, draw_run
from sst_ros.recording import recording
from sst_ros.recording.recording import read_signals
from sst_ros.report import timing
from sst_ros.scene import scene
from sst_ros.simulation.simulation import Simulation

GAMMA = math.pi / 4


def sway(t):
    angle, rate = 0.2 * math.sin(3 * t), 0.6 * math.cos(3 * t)
    return np.full(3, GAMMA + angle), np.full(3, rate)


@pytest.fixture(scope="module")
def run(tmp_path_factory, bags, example2):
    path = bags.write(tmp_path_factory.mktemp("plot") / "bag", bags.tracked(example2, sway))
    return read_signals(path)


@pytest.fixture(scope="module")
def drawn(run, tmp_path_factory):
    """All pictures of a run: the figures by name, and the folder."""
    kept, out = {}, tmp_path_factory.mktemp("pictures")
    whole = pictures.save

    def keep(figure, title, folder, stem, formats):
        kept[stem] = figure
        return whole(figure, title, folder, stem, formats)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "save", keep)
        paths, missing = draw_run(run, out)
    assert missing == {}
    assert {path.stem for path in paths} == set(kept) and len(kept) == len(PICTURES)
    return kept, out


def test_every_picture_shows_something_and_is_a_vector_too(drawn):
    figures, out = drawn
    for name in figures:
        pixels = image.imread(out / f"{name}.png")
        assert (np.ptp(pixels[:, :, :3], axis=2) > 0.2).sum() > 300, f"{name} shows no curve"
        content = (out / f"{name}.pdf").read_bytes()
        assert content.startswith(b"%PDF") and b"/Subtype /Image" not in content


def test_every_axis_has_its_unit(drawn):
    for name, figure in drawn[0].items():
        for axes in figure.axes:
            if name == "sphere":
                assert not axes.axison  # a map, with the joints' names along its sides
                continue
            shared = axes.get_shared_x_axes().get_siblings(axes)
            labels = [axes.get_ylabel(), next(filter(None, (a.get_xlabel() for a in shared)))]
            assert all(re.search(r"\[[^\]]+\]$", label) for label in labels), (name, labels)


def test_curves_are_told_apart_without_colour(drawn):
    for name, figure in drawn[0].items():
        for axes in figure.axes:
            lines = [line for line in axes.lines if not line.get_label().startswith("_")]
            looks = [(x.get_linestyle(), x.get_marker(), x.get_linewidth()) for x in lines]
            assert len(set(looks)) == len(looks), name


def test_tracking_shows_what_was_desired_and_what_was_measured(drawn, run):
    desired, measured = drawn[0]["tracking"].axes[0].lines
    np.testing.assert_allclose(
        desired.get_ydata(), [np.degrees(sway(t)[0][0]) for t in run.seconds()], rtol=1e-12
    )
    np.testing.assert_allclose(measured.get_ydata(), np.degrees(run.legs("gamma")[:, 0]))


def test_the_energy_is_that_of_the_simulation_and_balances_the_work(run):
    """The states of the bag are exact; the cubic between 2 ms samples errs by h^4."""
    kinetic, potential = motion.energies(run, run.scene)
    simulation = Simulation(run.scene)
    zero = (0.0, 0.0, 0.0)
    for tick in range(300):
        at = tuple(run.legs("tau", "ticks")[tick])
        state = simulation.step(at, 1_000_000)
        if tick % 100 == 99:
            sample = (tick + 1) // 2
            parts = simulation.dynamics.energies(*state.quaternion, *state.body_rate, *zero)
            assert kinetic[sample] == pytest.approx(parts[0], rel=1e-12)
            assert potential[sample] == parts[1] == 0.0
    left = kinetic - kinetic[0] - motion.work(run).sum(axis=1)
    assert np.abs(left).max() < 1e-9 * kinetic.max()
    assert motion.work(run)[0].tolist() == [0.0, 0.0, 0.0]


def test_friction_takes_energy_out_and_weight_keeps_it(tmp_path, bags):
    loaded = scene.load("friction")
    run = read_signals(bags.write(tmp_path / "bag", bags.simulated(loaded, 0.1)))
    kinetic, potential = motion.energies(run, loaded)
    left = kinetic + potential - kinetic[0] - potential[0] - motion.work(run).sum(axis=1)
    assert left[-1] < -1e-3 * kinetic.max()
    assert (np.diff(left) < 1e-9).all()


def test_work_is_not_known_beyond_a_lost_torque(tmp_path, bags, example2):
    kept = [e for e in example2 if (e.topic, e.sample) != (bags.APPLIED, 80)]
    run = read_signals(bags.write(tmp_path / "bag", kept))
    known = np.isfinite(motion.work(run)).all(axis=1)
    assert known[:80].all() and not known[80:].any()


def test_a_lost_orientation_is_a_gap_and_no_end(tmp_path, bags, example2):
    """As where a recorder hears joint_states first: SciPy refuses quaternions of nan."""
    kept = [e for e in example2 if (e.topic, e.sample) != (bags.ORIENTATION, 60)]
    bag = bags.write(tmp_path / "bag", kept)
    run = read_signals(bag)
    assert np.flatnonzero(np.isnan(motion.energies(run, run.scene)[0])).tolist() == [60]
    left = timing.energy_residual(recording.read(bag), [])
    assert np.flatnonzero(np.isnan(left)).tolist() == [60]
    assert np.nanmax(np.abs(left)) < 1e-9


def test_what_the_bag_lacks_is_told_and_the_rest_drawn(tmp_path, bags, example2, capsys, undrawn):
    kept = bags.without(example2, bags.ORIENTATION, bags.EULER, bags.APPLIED, bags.COMMANDS)
    bag, out = bags.write(tmp_path / "bag", kept), tmp_path / "out"
    assert cli.main(["plot", str(bag), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    drawn = {"power", "joint_angles", "joint_rates", "phase", "margins"}
    assert {path.stem for path in out.iterdir()} == drawn
    assert "tracking: the bag has no reference\n" in said
    assert "energy: the bag has no orientation, no applied_torques\n" in said


def test_one_picture_may_be_asked_for(run, tmp_path, capsys, undrawn):
    words = ["plot", str(run.bag.path), "--out", str(tmp_path), "--only", "phase"]
    assert cli.main(words) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["phase.pdf", "phase.png"]
    assert cli.main(["plot", "--force", *words[1:], "nothing"]) == 1
    assert "only = 'nothing': must be one of path_of_E" in capsys.readouterr().err


def test_the_list_names_all(capsys):
    assert cli.main(["plot", "--list"]) == 0
    said = capsys.readouterr().out
    assert [line.split()[0] for line in said.splitlines()][:-1] == list(PICTURES)


COUNT = 300_000


def test_few_points_stay_and_every_spike_is_among_them():
    generator = np.random.default_rng(4)
    curves = generator.normal(size=(3, COUNT))
    spikes = generator.choice(COUNT, 40, replace=False)
    curves[np.arange(40) % 3, spikes] = 20.0 * (-1.0) ** np.arange(40)
    rows = style.envelope(curves, COUNT)
    assert len(rows) < 3 * 2 * style.STRETCHES + 10 and np.all(np.diff(rows) > 0)
    assert set(spikes) <= set(rows) and {0, COUNT - 1} <= set(rows)
    size = -(-COUNT // style.STRETCHES)
    for curve in curves:  # the envelope is that of the whole curve
        for begin in range(0, COUNT, 50 * size):
            stretch = slice(begin, begin + size)
            few = curve[rows[(rows >= begin) & (rows < begin + size)]]
            assert (few.min(), few.max()) == (curve[stretch].min(), curve[stretch].max())


def test_a_gap_stays_a_gap():
    curve = np.sin(np.arange(COUNT) / 1e4)
    curve[123_456] = np.nan
    curve[200_000:220_000] = np.nan
    rows = style.envelope([curve], COUNT)
    assert 123_456 in rows and np.isnan(curve[rows]).sum() > 10


def test_short_curves_are_left_alone():
    assert np.array_equal(style.envelope([np.zeros(1000)], 1000), np.arange(1000))


PROGRAM = """
import resource, sys
from pathlib import Path
from matplotlib.figure import Figure
from sst_ros.plot.style import save_figure

figure = Figure()
figure.subplots().plot(range(3000), [i * i % 97 for i in range(3000)])
resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))
for form in ("pdf", "png", "svg"):
    try:
        save_figure(figure, Path(sys.argv[1]) / f"picture.{form}")
    except OSError as error:
        print(error.errno)
"""


def test_a_picture_on_a_full_disk(tmp_path):
    command = [sys.executable, "-c", PROGRAM, tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert (done.stdout, done.stderr) == (3 * f"{errno.EFBIG}\n", "")
