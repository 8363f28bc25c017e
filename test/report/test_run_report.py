# SPDX-License-Identifier: Apache-2.0
"""The report of a recorded run: numbers, verdict, tables, pictures, tracking.

Lies in it.
"""

import base64
import dataclasses
import json
import re

import numpy as np
import pytest
from matplotlib import image

from benchmark.plain_python import without_llvmlite
from sst_ros import __main__ as cli
from sst_ros.errors import InputError
from sst_ros.mechanism.geometry import angle_between
from sst_ros.recording import recording
from sst_ros.report import reference
from sst_ros.report.reference import TickStepper
from sst_ros.report.results import render
from sst_ros.report.run import evaluate_run, measure_timing, summary_table, summary_text
from sst_ros.report.run_page import draw_overview, write_run_report
from sst_ros.report.tracking import read_tracking, write_tracking_report
from sst_ros.scene import scene
from sst_ros.scene.loads import Initial

LATENCY_NS = 400_000
SENT_NS = 50_000
PROFILE = scene.load("example2").torque.at


@pytest.fixture(scope="module")
def lively(bags, example2):
    """Receptions with a known jitter, and the command of every tick 0.4 ms before its
    step.
    """
    entries = []
    for entry in example2:
        late = 30_000 if entry.sample > 0 and entry.sample % 10 == 0 else 0
        entries.append(dataclasses.replace(entry, received_ns=entry.received_ns + late))
    # The step of a tick begins when it ends, which is told SENT_NS later.
    entries += commands(bags, 1, bags.TICK_NS + SENT_NS - LATENCY_NS)
    return sorted(entries, key=lambda entry: entry.received_ns)


def commands(bags, period, received_ns):
    """A command every `period` ticks with the torque of the tick, received so much
    after it.
    """
    for tick in range(0, 300, period):
        received = bags.START_NS + tick * bags.TICK_NS + received_ns
        yield bags.command_entry(received, PROFILE(tick * bags.TICK_NS / 1e9))


def more_effort(by):
    """Change the efforts of a message, or of the first tick in it."""

    def change(message):
        if hasattr(message, "effort"):
            return dataclasses.replace(message, effort=message.effort + by)
        first, *rest = message.points
        first = dataclasses.replace(first, effort=first.effort + by)
        return dataclasses.replace(message, points=[first, *rest])

    return change


@pytest.fixture(scope="module")
def whole(tmp_path_factory, bags, example2):
    """Report of a whole run: summary and folder."""
    folder = tmp_path_factory.mktemp("report")
    return write_run_report(
        bags.record(folder / "bag", example2), folder / "out"
    ), folder / "out"


def test_the_summary_is_written_whole_and_finite(whole):
    summary, out = whole
    text = (out / "summary.json").read_text(encoding="utf-8")
    assert json.loads(text, parse_constant=pytest.fail) == summary
    counts = {
        "ticks": 300,
        "ticks_missed": 0,
        "samples_published": 151,
        "samples_recorded": 151,
    }
    periods = {"sample_period_s": 0.002, "tick_period_s": 0.001, "step_mean_us": 160.5}
    none = {
        "samples_lost": 0,
        "stamp_gaps": 0,
        "effort_difference_max_N_m": 0.0,
        "fault": "",
    }
    texts = {
        "scene": "example2",
        "phase": "finished",
        "notes": [],
        "topics_missing": [],
    }
    expected = counts | periods | none | texts | {"samples_recorded_percent": 100.0}
    assert {key: summary[key] for key in expected} == expected
    assert summary["integration_error_gamma_rad"] < 1e-11
    assert 0.0 < summary["integration_reference_error_gamma_rad"] < 1e-11
    assert 1e-6 < summary["ideal_difference_gamma_rad"] < 1e-2


def test_the_table_says_it_all_in_line(whole):
    summary, _ = whole
    bag = summary["bag"]
    text = summary_table(summary).replace(bag, "BAG")  # its folder may be long
    for word in (
        "ticks done",
        "ticks missed",
        "real-time factor",
        "samples lost",
        "(a)",
        "(b)",
    ):
        assert word in text
    assert f"{summary['integration_error_gamma_rad']:.2e}" in text
    assert f"{summary['ideal_difference_gamma_dot_rad_per_s']:.2e}" in text
    assert "NumPy" in text.split("\n\n")[-1]
    assert all(len(line) < 140 and line == line.rstrip() for line in text.splitlines())


def test_the_pictures_are_pictures(whole):
    """Those of `plot` show their curves in test_pictures.py."""
    summary, out = whole
    figures = ("10_path_of_E", "11_position_of_E", "12_theta", "13_phi", "14_psi")
    assert summary["pictures"] == [
        *(f"fig{name}.png" for name in figures),
        "torques.png",
        "error.png",
    ]
    pixels = image.imread(out / "error.png")
    assert pixels.shape[0] > 500 and pixels.shape[1] > 800
    assert (np.ptp(pixels[:, :, :3], axis=2) > 0.2).sum() > 500


@pytest.mark.slow
def test_the_page_is_whole_and_needs_nothing_beside_it(tmp_path, bags, lively):
    out = tmp_path / "out"
    kept = bags.without(lively, bags.DIAGNOSTICS, bags.EULER)
    summary = write_run_report(bags.write(tmp_path / "bag", kept), out)
    assert summary["page"] == ["page.png", "page.html"]
    pixels = image.imread(out / "page.png")
    assert (np.ptp(pixels[:, :, :3], axis=2) > 0.2).sum() > 5000
    text = (out / "page.html").read_text(encoding="utf-8")
    pictures = re.findall(r"src='data:image/png;base64,([^']+)'", text)
    assert len(pictures) == 1 + len(summary["pictures"])
    assert base64.b64decode(pictures[0]) == (out / "page.png").read_bytes()
    assert "http" not in re.sub(r"base64,[^']+", "", text)
    assert "command to its step, mean" in text
    assert "What the recording does not contain" in text
    assert "Not known: no diagnostics" in summary_table(summary)


def test_the_page_shows_text_as_text(whole):
    """The name of a scene is a stranger's: it must be no HTML."""
    summary = whole[0] | {"scene": "<script>", "unknown": ["<b>"]}
    page = render(
        "run.html", s=summary, table="<i>", overview=whole[1] / "page.png", pictures=[]
    )
    assert "&lt;script&gt;" in page and not re.search("<script>|<b>|<i>", page)


def test_loss_is_counted_and_survived(read, bags, lively):
    lost = {20, 21, 60, 150}  # the last one can only be missed by what was published
    found = evaluate_run(read([e for e in lively if e.sample not in lost]))
    summary = found.summary
    assert summary["samples_published"] == 151 and summary["samples_recorded"] == 147
    assert (summary["samples_lost"], summary["stamp_gaps"]) == (4, 2)
    assert summary["samples_missing_between_stamps"] == 3
    assert summary["samples_recorded_percent"] == pytest.approx(100.0 * 147 / 151)
    assert summary["restarts_at_s"] == [0.044, 0.122]
    assert summary["integration_error_gamma_rad"] < 1e-11
    assert any("began again 2 times" in note for note in summary["notes"])
    assert "Note: torques are missing" in summary_table(summary)
    assert summary["energy_residual_max_J"] < 1e-12
    assert found.timing.lost_s == pytest.approx([0.040, 0.042, 0.120])
    assert found.timing.gaps_s == pytest.approx([0.038, 0.118])
    assert len(found.timing.period_us) == 144


def test_what_is_not_recorded_is_unknown(read, bags, example2):
    kept = bags.without(example2, bags.DIAGNOSTICS, bags.EULER, bags.COMMANDS)
    summary = evaluate_run(read(kept)).summary
    unknown = ("ticks", "real_time_factor", "phase", "command_latency_mean_us")
    assert [summary[key] for key in unknown] == [None] * 4
    assert summary["samples_lost"] == summary["commands_followed"] == 0
    assert summary["topics_missing"] == ["euler_zyz", "diagnostics", "commands"]
    for words, where in (
        ("no diagnostics", "notes"),
        ("euler_zyz is not recorded", "notes"),
        ("no commands are recorded", "unknown"),
        ("no diagnostics", "unknown"),
    ):
        assert any(words in line for line in summary[where])
    line = next(
        line for line in summary_table(summary).splitlines() if "ticks done" in line
    )
    assert line.split()[-1] == "-"


def test_a_fault_is_told_and_the_run_judged_up_to_it(tmp_path, bags, undrawn):
    start = Initial(gamma=(1.5, 0.785, 0.785), gamma_dot=(1.0, 0.0, 0.0))
    near = dataclasses.replace(
        scene.load("example2_heavy"), name="near_the_end", initial=start
    )
    summary = write_run_report(
        bags.write(tmp_path / "bag", bags.simulated(near, 0.3)), tmp_path / "out"
    )
    assert summary["phase"] == "fault" and summary["fault"].startswith(
        "stopped at t = 0.0"
    )
    # at 0, 2, 4 and 5 ms
    assert summary["ticks"] == 5 and summary["samples_recorded"] == 4
    assert summary["sample_period_s"] == 0.002 and summary["stamp_gaps"] == 0
    assert summary["integration_error_gamma_rad"] < 1e-11
    assert any("ended by a fault" in note for note in summary["notes"])
    assert summary["fault"] in summary_table(summary)
    # no figure number outside the examples
    assert "path_of_E.png" in summary["pictures"]


def test_a_folder_that_cannot_be_written_is_refused(tmp_path, written, example2):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(
        InputError, match=r"out = .*must be a folder that can be written"
    ):
        write_run_report(written(example2), tmp_path / "file")


@pytest.fixture
def commanded(read, bags, example2):
    """Summary and text of a run with a command every so many ticks, received so much
    after it.
    """

    def evaluate(period, received_ns):
        plain = bags.without(example2, bags.COMMANDS)
        summary = evaluate_run(
            read([*plain, *commands(bags, period, received_ns)])
        ).summary
        return summary, text_of(summary)

    return evaluate


def text_of(summary):
    return summary_text(summary | {"page": ["page.png"], "pictures": []}, "out")


def test_a_good_run_is_ok_in_few_lines(commanded):
    summary, said = commanded(1, 600_000)
    lines = said.splitlines()
    assert (summary["verdict"], summary["reasons"]) == ("OK", [])
    assert lines[0] == "OK: example2" and 12 <= len(lines) <= 18
    assert lines[-1].startswith("Files: out: page.png")
    assert any(line.split()[:2] == ["peak", "torques"] for line in lines)
    assert "negative" not in said and "minimum -" not in said


def test_a_slow_controller_and_a_negative_delay_are_explained(commanded):
    summary, said = commanded(40, 600_000)
    assert said.startswith(
        "WARNING: example2: commands answered 5.33 % of samples, mean age 1"
    )
    assert summary["command_age_mean_s"] == pytest.approx(0.0187, abs=0.002)
    summary, said = commanded(1, 1_900_000)
    assert summary["command_latency_min_us"] < 0.0
    assert "the recorder received a command after the step that applied it" in said


def test_altered_effort_and_lost_samples_are_reasons_with_times(read, bags, example2):
    change = more_effort(1e-9 * np.eye(9)[1])
    entries = bags.edited(
        bags.without(example2, bags.COMMANDS), bags.JOINTS, 75, change
    )
    run = read([e for e in entries if e.sample not in {20, 21, 60}])
    off, summary = run.effort_difference, evaluate_run(run).summary
    assert np.isnan(off[0]) and run.seconds[off > 0.0].tolist() == [0.15]
    assert summary["effort_difference_max_N_m"] == pytest.approx(1e-9, rel=1e-6)
    assert summary["effort_difference_largest_at_s"] == 0.15
    assert "(at 0.15 s)" in summary_table(summary)
    said = "; ".join(summary["reasons"])
    assert summary["verdict"] == "WARNING" and "3 samples lost" in said
    assert "2 gaps between applied torques" in said and "efforts differ" in said


def test_tracking_figures_are_there_where_there_is_a_reference(read, bags, example2):
    start = np.array(scene.load("example2").initial.gamma)
    run = read(bags.tracked(example2, lambda _: (start, np.zeros(3))))
    lines = [line.strip() for line in text_of(evaluate_run(run).summary).splitlines()]
    assert any(line.startswith("tracking error, RMS") for line in lines)
    assert any(line.startswith("settling time") for line in lines)


def test_the_command_prints_verdict_and_files_and_all_when_asked(
    tmp_path, bags, example2, capsys, undrawn
):
    bag = bags.record(tmp_path / "bag", example2)
    assert cli.main(["report", "run", str(bag)]) == 0
    short = capsys.readouterr().out
    assert short.startswith("OK: example2\n") and len(short.splitlines()) < 20
    assert short.splitlines()[-1].startswith(f"Files: {tmp_path / 'bag_report'}")
    assert cli.main(["report", "run", str(bag), "--force", "--verbose"]) == 0
    assert "Largest over the run" in capsys.readouterr().out


@pytest.mark.parametrize("clock_ns", [0, -(10**15)])
def test_periods_and_latency_are_as_made_by_any_clock(read, lively, clock_ns):
    entries = [
        dataclasses.replace(e, received_ns=e.received_ns + clock_ns) for e in lively
    ]
    found = measure_timing(read(entries))
    numbers = found.numbers
    assert len(found.period_us) == 150
    assert numbers["period_min_us"] == 1970.0 and numbers["period_max_us"] == 2030.0
    assert numbers["period_mean_us"] == pytest.approx(2000.0, abs=0.5)
    assert numbers["period_p99_9_us"] == pytest.approx(2030.0)
    assert numbers["commands_followed"] == 300
    assert numbers["command_latency_min_us"] == pytest.approx(400.0, abs=1e-2)
    # a late sample's
    assert numbers["command_latency_max_us"] == pytest.approx(430.0, abs=1e-2)
    assert numbers["command_latency_mean_us"] == pytest.approx(403.0, abs=0.1)
    assert numbers["command_stamp_to_tick_mean_us"] is None
    assert found.pace.to_numpy() == pytest.approx(np.ones(len(found.pace)), abs=0.02)
    assert not len(found.lost_s) and not len(found.gaps_s) and found.missing == []
    assert np.abs(reference.integration(read(entries)).energy).max() < 1e-12


def test_a_dropped_tick_shows(read, bags, example2):
    """A tick that the simulator left out: the motion goes on as if it had been, and is
    caught.
    """

    def shortened(message):
        return dataclasses.replace(message, points=message.points[:1])

    run = read(bags.edited(example2, bags.APPLIED, 75, shortened))
    assert measure_timing(run).gaps_s == pytest.approx([0.149])
    assert reference.integration(run).restarts_ns == (150_000_000,)


def test_an_altered_torque_shows_when_it_was(read, bags, example2):
    """One torque that is not what was applied: error and energy jump at its tick."""
    run = read(
        bags.edited(example2, bags.APPLIED, 75, more_effort(1e-3 * np.eye(3)[0]))
    )
    found = reference.integration(run)
    error, energy = found.error.gamma_dot, np.abs(found.energy)
    assert np.flatnonzero(error > 1e-9)[0] == 75 and run.seconds[75] == 0.15
    assert error[:75].max() < 1e-11 and error[75:].min() > 1e-8
    assert np.flatnonzero(energy > 1e-9)[0] == 75


def test_stamped_commands_tell_the_age_of_the_answered_sample(read, bags, example2):
    """The torque of every other tick answers the sample of 2 ms before it."""
    entries = list(example2)
    for tick in range(2, 300, 2):
        stamp, torque = (
            bags.START_NS + (tick - 2) * bags.TICK_NS,
            PROFILE(tick * bags.TICK_NS / 1e9),
        )
        command = bags.joint_state(
            stamp, np.zeros(3), np.zeros(3), np.array(torque)[[1, 0, 2]]
        )
        command = dataclasses.replace(command, name=["gamma_2", "gamma_1", "gamma_3"])
        received = bags.START_NS + tick * bags.TICK_NS
        entries.append(bags.Entry(bags.STAMPED, received, command))
    numbers = measure_timing(read(entries)).numbers
    assert numbers["commands_followed"] == 149
    for word in ("min", "mean", "max"):
        assert numbers[f"command_stamp_to_tick_{word}_us"] == 2000.0
    assert numbers["command_latency_mean_us"] == pytest.approx(1050.0, abs=1e-2)


def panel_of(run, title):
    """A panel of the overview."""
    drawn = draw_overview(run, evaluate_run(run))
    return next(axes for axes in drawn.axes if axes.get_title("left").startswith(title))


def test_error_estimates_are_drawn_over_the_computing_time(read, bags, example2):
    entries = list(example2)
    for k in (1, 2):
        said = {"phase": "running", "ticks": 100 * k, "step_mean_us": 50.0}
        said |= {"error_estimate": 10.0 ** -(12 - k), "hold_error_start": 1e-3 * k}
        entries.append(bags.diagnostics_entry(bags.START_NS + k * 100_000_000, **said))
    panel = panel_of(read(entries), "Error against computing time used, over the run")
    curves = {line.get_label(): line.get_xydata() for line in panel.lines}
    error = curves["integration error"]
    estimate = curves["its estimate by the simulator"]
    assert (
        len(error) > 100 and error[0, 0] == 0.0 and (np.diff(error[:, 0]) >= 0.0).all()
    )
    assert error[-1, 0] == pytest.approx(np.nanmax(estimate[:, 0]))
    # 100 and 200 steps of 50 us, in ms
    assert estimate[:2, 0] == pytest.approx([5.0, 10.0])
    assert estimate[:2, 1] == pytest.approx([1e-11, 1e-10])
    assert curves["hold error if torques are those of the start"][
        1, 1
    ] == pytest.approx(2e-3)


def test_a_slow_run_shows_its_real_time_factor_beside_one(read, bags, example2):
    """At a thousandth of real time numbers are what they are, and the line at 1 is in
    sight.
    """
    start = bags.START_NS
    slow = [
        dataclasses.replace(e, received_ns=start + 2000 * (e.received_ns - start))
        for e in example2
    ]
    panel = panel_of(read(slow), "Real-time factor")
    assert panel.lines[0].get_ydata() == pytest.approx(1 / 2000, rel=0.1)
    low, high = panel.get_ylim()
    assert low < 1 / 2000 and high > 1.0


def test_ticks_that_were_missed_show_when_they_were(read, bags, example2):
    """At 0.1 s the simulator falls behind by seven ticks, and says so from then on."""
    entries = [
        dataclasses.replace(
            e, received_ns=e.received_ns + 7 * bags.TICK_NS * (e.sample > 50)
        )
        for e in bags.without(example2, bags.DIAGNOSTICS)
    ]
    reports = {0.04: 0, 0.08: 0, 0.12: 7, 0.16: 7, 0.2: 7}
    for seconds, missed in reports.items():
        received = (
            bags.START_NS + round(seconds * 1e9) + SENT_NS + missed * bags.TICK_NS
        )
        entries.append(
            bags.diagnostics_entry(received, phase="running", ticks_missed=missed)
        )
    run = read(entries)
    found = measure_timing(run)
    at, missed = found.reported[["time_s", "ticks_missed"]].to_numpy().T
    assert at == pytest.approx(list(reports), abs=1e-9)
    assert missed.tolist() == list(reports.values())
    assert not len(found.lost_s)
    assert evaluate_run(run).summary["ticks_missed"] == 7


@pytest.fixture(scope="module")
def long_run(tmp_path_factory):
    pytest.importorskip("rclpy", reason="needs rclpy: pip install .[ros]")
    from benchmark import long_bag

    return recording.read(long_bag.write(tmp_path_factory.mktemp("long") / "bag", 20.0))


@pytest.mark.slow
def test_a_long_run_is_reported_whole(long_run, monkeypatch):
    """The work a report does for it, which is what its time and memory come from."""
    follow, calls = TickStepper.follow, []
    monkeypatch.setattr(
        TickStepper, "follow", lambda *given: calls.append(0) or follow(*given)
    )
    integration, ideal, summary = evaluate_run(long_run)[1:]
    assert len(calls) == 2  # both references, in one call each
    assert summary["samples_recorded"] == summary["samples_compared"] == 10_001
    assert (summary["ticks_recorded"], summary["commands_followed"]) == (20_000, 10_000)
    assert summary["command_latency_mean_us"] == pytest.approx(750.0)
    assert integration.error.gamma.max() < 1e-12 and integration.own.gamma.max() < 1e-13
    assert ideal.error.gamma.max() < 1e-2 and summary["energy_residual_max_J"] < 1e-11


@pytest.mark.slow
def test_machine_code_and_plain_python_tell_the_same(long_run):
    pytest.importorskip("llvmlite", reason="needs llvmlite: pip install .[fast]")
    compiled = reference.integration(long_run)
    with without_llvmlite():
        plain = reference.integration(long_run)
    assert plain.compared == compiled.compared == 10_001
    # Rounding differs, and grows with the motion.
    one, other = (found.error.gamma[:201].to_numpy() for found in (plain, compiled))
    assert one == pytest.approx(other, abs=1e-15)
    assert plain.energy[:201] == pytest.approx(compiled.energy[:201], abs=1e-13)


HOME = np.array(scene.load("example2").initial.gamma)
OFF = np.array([0.01, -0.02, 0.03])
STILL = np.zeros(3)


@pytest.fixture(scope="module")
def followed(bags):
    plain = bags.simulated(scene.load("example2"), 0.1)
    return bags.tracked(plain, lambda _: (HOME + OFF, STILL))


def test_the_track_is_what_was_written(followed, written):
    bag = written(followed)
    found = read_tracking(bag)
    run, track = recording.read(bag), found.track
    assert len(track.time) == 51 and track.time[-1] == pytest.approx(0.1)
    assert track.gamma == pytest.approx(np.tile(HOME + OFF, (51, 1)))
    assert track.gamma - track.error == pytest.approx(run.gamma)
    # The torque of a sample is that of the tick that begins there; after the last there
    # is none.
    begins = np.isin(run.ticks.start_ns, run.time_ns)
    assert np.array_equal(track.torque[:-1], run.ticks.torque[begins])
    assert not track.torque[-1].any()
    largest = np.abs(HOME + OFF - run.gamma).max(axis=0)
    assert found.metrics.largest == pytest.approx(largest)


def test_the_orientations_error_is_the_angle_to_the_reference(bags, followed, written):
    plain = bags.without(followed, bags.DESIRED, bags.ERROR)
    found = read_tracking(written(bags.tracked(plain, lambda _: (HOME, STILL))))
    q = found.recording.quaternion
    assert found.orientation_error.max() > 1e-3
    assert found.orientation_error == pytest.approx(angle_between(q, q[0]), abs=1e-12)


def test_the_last_report_says_how_often_a_torque_was_limited(bags, followed, written):
    said = bags.diagnostics_entry(followed[-1].received_ns + 1, samples_limited=7)
    said.content.status[0].name = "/sst_inverse_dynamics: control"
    assert read_tracking(written([*followed, said])).metrics.limited == 7


@pytest.mark.slow
def test_the_report_writes_a_table_and_a_picture(followed, written, tmp_path):
    told = write_tracking_report(written(followed), tmp_path)
    assert (tmp_path / "tracking.txt").read_text(encoding="utf-8") == told
    assert "error, largest" in told and "nan" not in told
    for name in ("tracking", "tracking_error", "control_torques"):
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000


def test_a_recording_without_reference_or_our_joints_is_refused(
    bags, followed, written, tmp_path
):
    with pytest.raises(InputError, match="reference"):
        write_tracking_report(written(bags.without(followed, bags.DESIRED)), tmp_path)
    names = {"name": ["a", "b", "c"]}
    renamed = bags.edited(
        followed, bags.ERROR, 3, lambda one: dataclasses.replace(one, **names)
    )
    with pytest.raises(InputError, match="tracking_error"):
        read_tracking(written(renamed))
