# SPDX-License-Identifier: Apache-2.0
"""The page of a recorded run: jitter, losses, latency, energy; and lies in the recording."""

import base64
import dataclasses
import re

import numpy as np
import pytest
from matplotlib import image

from sst_ros.recording import recording
from sst_ros.report import overview, reference, timing
from sst_ros.report.run import evaluate, report, summary_table
from sst_ros.scene import scene

LATENCY_NS = 400_000
SENT_NS = 50_000


@pytest.fixture(scope="module")
def lively(bags, example2):
    """Receptions with a known jitter, and the command of every tick 0.4 ms before its step."""
    entries = []
    for entry in example2:
        late = 30_000 if entry.sample > 0 and entry.sample % 10 == 0 else 0
        entries.append(dataclasses.replace(entry, received_ns=entry.received_ns + late))
    profile = scene.load("example2").torque.at
    for tick in range(300):
        command = bags.make(
            "std_msgs/Float64MultiArray",
            layout=bags.make("std_msgs/MultiArrayLayout", dim=[], data_offset=0),
            data=np.array(profile(tick * bags.TICK_NS / 1e9)),
        )
        # The step of a tick begins when it ends, which is told SENT_NS later.
        received = bags.START_NS + (tick + 1) * bags.TICK_NS + SENT_NS - LATENCY_NS
        entries.append(bags.Entry(bags.COMMANDS, received, command))
    return sorted(entries, key=lambda entry: entry.received_ns)


def _timing(bags, folder, entries):
    return timing.measure(recording.read(bags.write(folder / "bag", entries)))


def test_periods_and_latency_are_what_they_were_made(tmp_path, bags, lively):
    found = _timing(bags, tmp_path, lively)
    numbers = timing.numbers(found)
    assert found.nominal_us == 2000.0 and len(found.period_us) == 150
    assert numbers["period_min_us"] == 1970.0 and numbers["period_max_us"] == 2030.0
    assert numbers["period_mean_us"] == pytest.approx(2000.0, abs=0.5)
    assert numbers["period_p99_9_us"] == pytest.approx(2030.0)
    assert numbers["commands_followed"] == 300
    assert numbers["command_latency_min_us"] == pytest.approx(400.0, abs=1e-2)
    assert numbers["command_latency_max_us"] == pytest.approx(430.0, abs=1e-2)  # a late sample's
    assert numbers["command_latency_mean_us"] == pytest.approx(403.0, abs=0.1)
    assert numbers["command_stamp_to_tick_mean_us"] is None
    assert found.pace == pytest.approx(np.ones(len(found.pace)), abs=0.02)
    assert numbers["energy_residual_max_J"] < 1e-12
    assert not len(found.lost_s) and not len(found.gaps_s) and numbers["unknown"] == []


def test_lost_samples_and_dropped_ticks_have_their_times(tmp_path, bags, lively):
    kept = [entry for entry in lively if entry.sample not in (20, 21, 60)]
    found = _timing(bags, tmp_path, kept)
    assert found.lost_s == pytest.approx([0.040, 0.042, 0.120])
    assert found.gaps_s == pytest.approx([0.038, 0.118])
    assert len(found.period_us) == 145
    assert timing.numbers(found)["energy_residual_max_J"] < 1e-12


def test_a_dropped_tick_shows(tmp_path, bags, example2):
    """A tick that the simulator left out: the motion goes on as if it had been, and is caught."""

    def shortened(message):
        return dataclasses.replace(message, points=message.points[:1])

    entries = bags.edited(example2, bags.APPLIED, 75, shortened)
    run = recording.read(bags.write(tmp_path / "bag", entries))
    assert timing.measure(run).gaps_s == pytest.approx([0.149])
    assert reference.integration(run).restarts_ns == (150_000_000,)


def test_an_altered_effort_shows_when_it_was(tmp_path, bags, example2):
    """One torque that is not what was applied: error and energy jump at its tick."""

    def altered(message):
        points = list(message.points)
        points[0] = dataclasses.replace(points[0], effort=points[0].effort + np.eye(3)[0] * 1e-3)
        return dataclasses.replace(message, points=points)

    entries = bags.edited(example2, bags.APPLIED, 75, altered)
    run = recording.read(bags.write(tmp_path / "bag", entries))
    error = reference.integration(run).error.gamma_dot
    assert np.flatnonzero(error > 1e-9)[0] == 75 and run.seconds[75] == 0.15
    energy = np.abs(timing.measure(run).energy)
    assert np.flatnonzero(energy > 1e-9)[0] == 75


def test_the_page_is_whole_and_needs_nothing_beside_it(tmp_path, bags, lively):
    out = tmp_path / "out"
    kept = bags.without(lively, bags.DIAGNOSTICS, bags.EULER)
    summary = report(bags.write(tmp_path / "bag", kept), out)
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


def test_what_is_missing_is_said(tmp_path, bags, example2):
    kept = bags.without(example2, bags.DIAGNOSTICS, bags.EULER, bags.COMMANDS)
    numbers = timing.numbers(_timing(bags, tmp_path, kept))
    assert numbers["command_latency_mean_us"] is None and numbers["commands_followed"] == 0
    assert any("no commands are recorded" in words for words in numbers["unknown"])
    assert any("no diagnostics" in words for words in numbers["unknown"])


def test_stamps_of_another_clock_do_not_matter(tmp_path, bags, lively):
    entries = [dataclasses.replace(e, received_ns=e.received_ns - 10**15) for e in lively]
    numbers = timing.numbers(_timing(bags, tmp_path, entries))
    assert numbers["command_latency_min_us"] == pytest.approx(400.0, abs=1e-2)
    assert numbers["period_max_us"] == 2030.0


def test_stamped_commands_tell_how_old_the_sample_was_that_they_answer(tmp_path, bags, example2):
    """The torque of every other tick answers the sample of two milliseconds before it."""
    profile, entries = scene.load("example2").torque.at, list(example2)
    for tick in range(2, 300, 2):
        command = bags.make(
            "sensor_msgs/JointState",
            header=bags.header(bags.START_NS + (tick - 2) * bags.TICK_NS),
            name=["gamma_2", "gamma_1", "gamma_3"],
            position=np.empty(0),
            velocity=np.empty(0),
            effort=np.array(profile(tick * bags.TICK_NS / 1e9))[[1, 0, 2]],
        )
        received = bags.START_NS + tick * bags.TICK_NS
        entries.append(bags.Entry(bags.STAMPED, received, command))
    found = _timing(bags, tmp_path, sorted(entries, key=lambda entry: entry.received_ns))
    numbers = timing.numbers(found)
    assert numbers["commands_followed"] == 149
    for word in ("min", "mean", "max"):
        assert numbers[f"command_stamp_to_tick_{word}_us"] == 2000.0
    assert numbers["command_latency_mean_us"] == pytest.approx(1050.0, abs=1e-2)


def test_error_estimates_are_drawn_against_the_computing_time_used(tmp_path, bags, example2):
    entries = list(example2)
    for k in (1, 2):
        entries.append(bags.diagnostics_entry(
            bags.START_NS + k * 100_000_000, phase="running", ticks=100 * k, step_mean_us=50.0,
            error_estimate=10.0 ** -(12 - k), hold_error_start=1e-3 * k,
        ))  # fmt: skip
    run = recording.read(bags.write(tmp_path / "bag", sorted(entries, key=lambda e: e.received_ns)))
    found = evaluate(run)
    drawn = overview.draw_overview(run, found.integration, found.timing, found.summary)
    titles = {axes.get_title("left"): axes for axes in drawn.axes}
    panel = titles["Error against computing time used, over the run"]
    curves = {line.get_label(): line.get_xydata() for line in panel.lines}
    error = curves["integration error"]
    estimate = curves["its estimate by the simulator"]
    assert len(error) > 100 and error[0, 0] == 0.0 and (np.diff(error[:, 0]) >= 0.0).all()
    assert error[-1, 0] == pytest.approx(np.nanmax(estimate[:, 0]))
    assert estimate[:2, 0] == pytest.approx([5.0, 10.0])  # 100 and 200 steps of 50 us, in ms
    assert estimate[:2, 1] == pytest.approx([1e-11, 1e-10])
    assert curves["hold error if torques are those of the start"][1, 1] == pytest.approx(2e-3)


def test_ticks_that_were_missed_show_when_they_were(tmp_path, bags, example2):
    """At 0.1 s the simulator falls behind by seven ticks, and says so from then on."""
    entries = [
        dataclasses.replace(e, received_ns=e.received_ns + 7 * bags.TICK_NS * (e.sample > 50))
        for e in bags.without(example2, bags.DIAGNOSTICS)
    ]
    reports = {0.04: 0, 0.08: 0, 0.12: 7, 0.16: 7, 0.2: 7}
    for seconds, missed in reports.items():
        received = bags.START_NS + round(seconds * 1e9) + SENT_NS + missed * bags.TICK_NS
        entries.append(bags.diagnostics_entry(received, phase="running", ticks_missed=missed))
    found = _timing(bags, tmp_path, sorted(entries, key=lambda entry: entry.received_ns))
    at, missed = found.reported[:, :2].T
    assert at == pytest.approx(list(reports), abs=1e-9)
    assert missed.tolist() == list(reports.values())
    assert found.late_us == pytest.approx(np.where(np.arange(151) > 50, 7000.0, 0.0))
    assert not len(found.lost_s)
    assert numbers_of_run(tmp_path)["ticks_missed"] == 7


def numbers_of_run(folder):
    return evaluate(recording.read(folder / "bag")).summary


def test_an_altered_effort_of_joint_states_shows_when_it_was(tmp_path, bags, example2):
    def altered(message):
        return dataclasses.replace(message, effort=message.effort + 1e-9 * np.eye(9)[1])

    path = bags.write(tmp_path / "bag", bags.edited(example2, bags.JOINTS, 75, altered))
    off = recording.read(path).effort_difference
    assert np.isnan(off[0]) and np.flatnonzero(off > 0.0).tolist() == [75]
    summary = numbers_of_run(tmp_path)
    assert summary["effort_difference_max_N_m"] == pytest.approx(1e-9, rel=1e-6)
    assert summary["effort_difference_largest_at_s"] == 0.15
    assert "(at 0.15 s)" in summary_table(summary)
