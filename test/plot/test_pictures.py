# SPDX-License-Identifier: Apache-2.0
"""Pictures of a run: all that the bag allows, with units, told apart without colour, as
vectors.

Several runs are laid on each other: differences against differences made by hand. Long
curves keep their spikes and gaps; a picture that finds no room is an OSError.
"""

import dataclasses
import errno
import math
import re
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from matplotlib import image
from matplotlib.figure import Figure

from sst_ros import __main__ as cli
from sst_ros import figures
from sst_ros.errors import InputError
from sst_ros.plot import compare, pictures
from sst_ros.plot.compare import differences, draw_comparison
from sst_ros.plot.pictures import RUN_PICTURES, draw_run
from sst_ros.recording import recording
from sst_ros.recording.recording import read_signals
from sst_ros.report import reference
from sst_ros.scene import scene
from sst_ros.simulation.simulation import Simulation

GAMMA = math.pi / 4


def sway(t):
    angle, rate = 0.2 * math.sin(3 * t), 0.6 * math.cos(3 * t)
    return np.full(3, GAMMA + angle), np.full(3, rate)


@pytest.fixture(scope="module")
def run(tmp_path_factory, bags, example2):
    path = bags.write(
        tmp_path_factory.mktemp("plot") / "bag", bags.tracked(example2, sway)
    )
    return read_signals(path)


def draw_all(run, out):
    """Draw all pictures of a run and return the figures by name."""
    kept = {}
    whole = pictures.save

    def keep(figure, title, folder, stem, formats):
        kept[stem] = figure
        return whole(figure, title, folder, stem, formats)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "save", keep)
        paths, missing = draw_run(run, out)
    assert missing == {}
    assert {path.stem for path in paths} == set(kept) and len(kept) == len(RUN_PICTURES)
    return kept


@pytest.fixture(scope="module")
def drawn(run, tmp_path_factory):
    """All figures of a run by name; their files are empty."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", lambda *_, **__: None)
        return draw_all(run, tmp_path_factory.mktemp("pictures"))


@pytest.mark.slow
def test_every_picture_shows_something_and_is_a_vector_too(run, tmp_path):
    out = tmp_path
    for name in draw_all(run, out):
        pixels = image.imread(out / f"{name}.png")
        assert (np.ptp(pixels[:, :, :3], axis=2) > 0.2).sum() > 300, (
            f"{name} shows no curve"
        )
        content = (out / f"{name}.pdf").read_bytes()
        assert content.startswith(b"%PDF") and b"/Subtype /Image" not in content


def test_every_axis_has_its_unit(drawn):
    for name, figure in drawn.items():
        if name == "sphere":
            # a map, with the joints' names along its sides
            assert not figure.axes[0].axison
            assert figure.axes[1].get_ylabel() == "deg"
            continue
        for axes in figure.axes:
            shared = axes.get_shared_x_axes().get_siblings(axes)
            labels = [
                axes.get_ylabel(),
                next(filter(None, (a.get_xlabel() for a in shared))),
            ]
            assert all(re.search(r"\[[^\]]+\]$", label) for label in labels), (
                name,
                labels,
            )


def test_curves_are_told_apart_without_colour(drawn):
    for name, figure in drawn.items():
        for axes in figure.axes:
            lines = [
                line for line in axes.lines if not line.get_label().startswith("_")
            ]
            looks = [
                (x.get_linestyle(), x.get_marker(), x.get_linewidth()) for x in lines
            ]
            assert len(set(looks)) == len(looks), name


def test_tracking_shows_what_was_desired_and_what_was_measured(drawn, run):
    desired, measured = drawn["tracking"].axes[0].lines
    np.testing.assert_allclose(
        desired.get_ydata(),
        [np.degrees(sway(t)[0][0]) for t in run.seconds()],
        rtol=1e-12,
    )
    np.testing.assert_allclose(
        measured.get_ydata(), np.degrees(run.legs("gamma")[:, 0])
    )


def test_the_energy_is_the_simulations_and_balances_the_work(run):
    """The states of the bag are exact; the cubic between 2 ms samples errs by h^4."""
    kinetic, potential = pictures.energies(run, run.scene)
    simulation = Simulation(run.scene)
    for tick in range(300):
        at = tuple(run.legs("tau", "ticks")[tick])
        state = simulation.step(at, 1_000_000)
        if tick % 100 == 99:
            sample = (tick + 1) // 2
            parts = simulation.dynamics.energies(*state.quaternion, *state.body_rate)
            assert kinetic[sample] == pytest.approx(parts[0], rel=1e-12)
            assert potential[sample] == parts[1] == 0.0
    left = kinetic - kinetic[0] - pictures.work(run).sum(axis=1)
    assert np.abs(left).max() < 1e-9 * kinetic.max()
    assert pictures.work(run)[0].tolist() == [0.0, 0.0, 0.0]


def test_friction_takes_energy_out_and_weight_keeps_it(tmp_path, bags):
    loaded = scene.load("friction")
    run = read_signals(bags.write(tmp_path / "bag", bags.simulated(loaded, 0.1)))
    kinetic, potential = pictures.energies(run, loaded)
    left = (
        kinetic + potential - kinetic[0] - potential[0] - pictures.work(run).sum(axis=1)
    )
    assert left[-1] < -1e-3 * kinetic.max()
    assert (np.diff(left) < 1e-9).all()


def test_work_is_not_known_beyond_a_lost_torque(tmp_path, bags, example2):
    kept = [e for e in example2 if (e.topic, e.sample) != (bags.APPLIED, 80)]
    run = read_signals(bags.write(tmp_path / "bag", kept))
    known = np.isfinite(pictures.work(run)).all(axis=1)
    assert known[:80].all() and not known[80:].any()


def test_a_lost_orientation_is_a_gap_and_no_end(tmp_path, bags, example2):
    """As if a recorder hears joint_states first: SciPy refuses quaternions of nan."""
    kept = [e for e in example2 if (e.topic, e.sample) != (bags.ORIENTATION, 60)]
    bag = bags.write(tmp_path / "bag", kept)
    run = read_signals(bag)
    assert np.flatnonzero(np.isnan(pictures.energies(run, run.scene)[0])).tolist() == [
        60
    ]
    left = reference.integration(recording.read(bag)).energy
    assert np.flatnonzero(np.isnan(left)).tolist() == [60]
    assert np.nanmax(np.abs(left)) < 1e-9


def test_what_the_bag_lacks_is_told_and_the_rest_drawn(
    tmp_path, bags, example2, capsys, undrawn
):
    kept = bags.without(
        example2, bags.ORIENTATION, bags.EULER, bags.APPLIED, bags.COMMANDS
    )
    bag, out = bags.write(tmp_path / "bag", kept), tmp_path / "out"
    assert cli.main(["plot", str(bag), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    drawn = {"power", "joint_angles", "joint_rates", "margins"}
    assert {path.stem for path in out.iterdir()} == drawn
    assert "tracking: the bag has no reference\n" in said
    assert "energy: the bag has no orientation, no applied_torques\n" in said


def test_one_picture_may_be_asked_for(run, tmp_path, capsys, undrawn):
    words = ["plot", str(run.bag.path), "--out", str(tmp_path), "--only", "power"]
    assert cli.main(words) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "power.pdf",
        "power.png",
    ]
    assert cli.main(["plot", "--force", *words[1:], "nothing"]) == 1
    assert "only = 'nothing': must be one of path_of_E" in capsys.readouterr().err


def test_the_list_names_all(capsys):
    assert cli.main(["plot", "--list"]) == 0
    said = capsys.readouterr().out
    assert [line.split()[0] for line in said.splitlines()][:-1] == list(RUN_PICTURES)


def test_a_spike_of_one_sample_is_seen_and_a_gap_stays_a_gap(tmp_path):
    values = np.zeros(300_000)
    values[123_456], values[200_000:220_000] = 1.0, np.nan
    figure, (axes,) = figures.stack(["value [1]"])
    axes.plot(np.arange(300_000), values, color="red")
    paths = [tmp_path / f"picture.{form}" for form in pictures.FORMATS]
    figures.save_figure(figure, *paths)
    red = image.imread(paths[1])[:, :, :3] @ [1.0, -1.0, -1.0] > 0.5
    assert (
        red.any(axis=1).sum() > 200
        and np.diff(np.flatnonzero(red.any(axis=0))).max() > 30
    )
    assert paths[0].stat().st_size < 100_000


PROGRAM = """
import resource, sys
from pathlib import Path
from matplotlib.figure import Figure
from sst_ros.figures import save_figure

figure = Figure()
figure.subplots().plot(range(3000), [i * i % 97 for i in range(3000)])
resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))
for form in ("pdf", "png", "svg"):
    try:
        save_figure(figure, Path(sys.argv[1]) / f"picture.{form}")
    except OSError as error:
        print(error.errno)
"""


@pytest.mark.slow
def test_a_picture_on_a_full_disk(tmp_path):
    command = [sys.executable, "-c", PROGRAM, tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert (done.stdout, done.stderr) == (3 * f"{errno.EFBIG}\n", "")


def shifted(bags, entries, by_ns, turn=0.0, keep=lambda sample: True):
    """The same run at another time, gamma_1 of some samples changed by 1e-3 rad."""
    result = []
    for entry in entries:
        content = entry.content
        if hasattr(content, "header"):
            stamp = content.header.stamp.sec * 10**9 + content.header.stamp.nanosec
            if stamp:
                content = dataclasses.replace(
                    content, header=bags.header(stamp + by_ns)
                )
        if entry.topic == bags.JOINTS and entry.sample >= 0 and entry.sample % 2:
            position = np.array(content.position)
            position[0] += 1e-3
            content = dataclasses.replace(content, position=position)
        if entry.topic == bags.ORIENTATION:
            q, c, s = content.quaternion, math.cos(turn / 2), math.sin(turn / 2)
            x, y, z, w = (
                c * q.x - s * q.y,
                c * q.y + s * q.x,
                c * q.z + s * q.w,
                c * q.w - s * q.z,
            )
            about_z = bags.make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)
            content = dataclasses.replace(content, quaternion=about_z)
        if keep(entry.sample):
            result.append(dataclasses.replace(entry, content=content))
    return result


@pytest.fixture(scope="module")
def pair(tmp_path_factory, bags, example2):
    """A run of 151 samples, and the same 5 s later, changed, without ten of them."""
    folder = tmp_path_factory.mktemp("pair")
    first = bags.write(folder / "first", example2)
    changed = shifted(bags, example2, 5 * 10**9, 0.02, lambda k: not 20 <= k < 30)
    return [
        read_signals(bag) for bag in (first, bags.write(folder / "second", changed))
    ]


def test_the_differences_are_those_that_were_made(pair):
    found = differences(pair).loc["second"]
    assert (found[["samples", "of"]] == 141).all(axis=None)
    angles = found[["max_rad", "rms_rad"]]
    # 70 of the 141 samples are odd, in which one angle is changed.
    assert angles.loc["gamma_1"].tolist() == pytest.approx(
        [1e-3, 1e-3 * math.sqrt(70 / 141)]
    )
    assert angles.loc["star"].tolist() == pytest.approx([0.02, 0.02], rel=1e-9)
    assert (angles.drop(["gamma_1", "star"]) == 0.0).all(axis=None)
    rates = found[["rate_max_rad_per_s", "rate_rms_rad_per_s"]]
    assert (rates.drop("star") == 0.0).all(axis=None) and rates.loc["star"].isna().all()


def test_a_run_does_not_differ_from_itself(pair):
    found = differences([pair[0], pair[0]])
    assert found.iloc[0].tolist() == [0.0, 0.0, 0.0, 0.0, 151, 151]
    assert found.max_rad.tolist() == [0.0] * 10


def test_samples_at_other_times_are_not_compared(pair, bags, example2, tmp_path):
    """Each sample but the first a nanosecond late: only the first is common."""
    late = [
        entry if entry.sample == 0 else shifted(bags, [entry], 1)[0]
        for entry in example2
        if entry.topic != bags.APPLIED
    ]
    other = read_signals(bags.write(tmp_path / "bag", late))
    assert other.start_ns == pair[0].start_ns
    assert differences([pair[0], other]).iloc[0].tolist()[-2:] == [1, 151]


def test_the_panel_names_equal_runs_and_those_that_share_nothing(
    pair,
):
    late = dataclasses.replace(pair[0], start_ns=pair[0].start_ns - 1)
    runs, names = (
        [pair[0], pair[0], pair[1], late],
        ["first", "same", "changed", "late"],
    )
    drawn = list(map(compare.DrawnRun, runs, names, figures.LINES))
    panel = compare.COMPARISON_PICTURES["gamma"].make(drawn).axes[-1]
    said = [line.get_label() for line in panel.lines]
    assert said == ["same: no difference", "changed", "late: no samples in common"]
    assert np.nanmax(panel.lines[1].get_ydata()) == pytest.approx(np.degrees(1e-3))


def test_the_command_draws_and_tells(pair, tmp_path, capsys, undrawn):
    table = tmp_path / "table.csv"
    words = [*(str(run.bag.path) for run in pair), "--out", str(tmp_path / "out")]
    assert cli.main(["compare", *words, "--csv", str(table)]) == 0
    said = capsys.readouterr().out
    assert cli.main(["plot", "--compare", *words, "--force"]) == 0
    old = capsys.readouterr()
    assert old.out.splitlines() == [
        line for line in said.splitlines() if line != str(table)
    ]
    assert "use sst-ros compare" in old.err
    assert (
        "at samples that both have at the same time since the start of each run" in said
    )
    assert "second: 141 of 141 samples\n" in said and "gamma_1 1.000e-03" in said
    written = pd.read_csv(table, index_col=["run", "joint"])
    pd.testing.assert_frame_equal(written, differences(pair), check_exact=True)
    drawn = {path.name for path in (tmp_path / "out").iterdir()}
    names = [name for name in compare.COMPARISON_PICTURES if name != "tracking_error"]
    assert drawn == {
        f"compare_{name}.{form}" for name in names for form in ("pdf", "png")
    }
    assert (
        "tracking_error: not drawn: without first, second: no tracking_error there"
        in said
    )


@pytest.mark.slow
def test_a_run_that_lacks_a_topic_is_left_out_of_its_pictures(
    pair, bags, example2, tmp_path
):
    poor = bags.write(
        tmp_path / "poor", [e for e in example2 if e.topic == bags.APPLIED]
    )
    runs = [*pair, read_signals(poor)]
    paths, missing = draw_comparison(runs, tmp_path / "out", ["gamma", "torques"])
    assert [path.stem for path in paths[::2]] == ["compare_gamma", "compare_torques"]
    assert missing == {"gamma": "without poor: no joint_states there"}
    found = differences(runs).loc["poor"]
    assert (found[["samples", "of"]] == 0).all(axis=None)
    assert found.drop(columns=["samples", "of"]).isna().all(axis=None)
    last = compare.difference_text(runs).splitlines()[-1]
    assert last.split() == ["star", *"----"]


def test_runs_that_cannot_be_told_apart_are_refused(pair, tmp_path):
    with pytest.raises(InputError, match="must be 2 to 6 bags"):
        draw_comparison([pair[0]] * 7, tmp_path)


GAP_NS = 400_000_000


@pytest.fixture(scope="module")
def twice(tmp_path_factory, bags):
    """A run of 0.1 s, and the same again after a gap of which nothing is recorded."""
    once = bags.simulated(scene.load("example2"), 0.1)
    again = [one for one in once if one.sample >= 0]
    later = [
        dataclasses.replace(one, received_ns=one.received_ns + GAP_NS)
        for one in shifted(bags, again, GAP_NS)
    ]
    sent = [*once, *later]
    path = bags.write(tmp_path_factory.mktemp("twice") / "bag", sent)
    return recording.read_signals(path)


def crosses(line):
    """Whether a line is drawn from before 0.2 s to after it."""
    seconds, values = (np.asarray(one, dtype=float) for one in line.get_data())
    ends = np.stack([seconds[:-1], seconds[1:]])
    drawn = np.isfinite(values[:-1]) & np.isfinite(values[1:])
    return bool(np.any(drawn & (ends.min(axis=0) < 0.2) & (ends.max(axis=0) > 0.2)))


@pytest.mark.parametrize(
    "name", ["joint_angles", "position_of_E", "psi", "torques", "energy", "margins"]
)
def test_no_line_is_drawn_across_a_gap(twice, name):
    figure = pictures.RUN_PICTURES[name].make(twice, twice.scene)
    lines = [
        line
        for axes in figure.axes
        for line in axes.get_lines()
        if len(line.get_xdata()) > 2
    ]
    assert lines and not any(map(crosses, lines))
    last = max(np.nanmax(line.get_xdata()) for line in lines)
    assert last == pytest.approx(0.5, abs=0.01)  # what is after it is drawn


def test_the_path_of_a_run_is_broken_at_a_gap(twice):
    broken = np.isnan(pictures.directions(twice)).any(axis=1)
    assert np.flatnonzero(broken).tolist() == [51]
