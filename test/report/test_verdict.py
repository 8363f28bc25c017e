# SPDX-License-Identifier: Apache-2.0
"""The verdict of a report: OK, or a WARNING with the reasons; the figures; delays explained."""

import dataclasses

import numpy as np
import pytest

from sst_ros import __main__ as cli
from sst_ros.recording import recording
from sst_ros.report.run import evaluate, summary_text
from sst_ros.scene import scene


def commands(bags, period, received_ns):
    """A command every `period` ticks with the torque of the tick, received so much after it."""
    profile = scene.load("example2").torque.at
    for tick in range(0, 300, period):
        content = bags.make(
            "std_msgs/Float64MultiArray",
            layout=bags.make("std_msgs/MultiArrayLayout", dim=[], data_offset=0),
            data=np.array(profile(tick * bags.TICK_NS / 1e9)),
        )
        yield bags.Entry(bags.COMMANDS, bags.START_NS + tick * bags.TICK_NS + received_ns, content)


def summary_of(bags, folder, entries):
    entries = sorted(entries, key=lambda entry: entry.received_ns)
    found = evaluate(recording.read(bags.record(folder / "bag", entries))).summary
    return found | {"page": ["page.png"], "pictures": []}


def test_a_good_run_is_ok_in_few_lines(tmp_path, bags, example2):
    plain = bags.without(example2, bags.COMMANDS)
    summary = summary_of(bags, tmp_path, [*plain, *commands(bags, 1, 600_000)])
    lines = summary_text(summary, "out").splitlines()
    assert (summary["verdict"], summary["reasons"]) == ("OK", [])
    assert lines[0] == "OK: example2" and 12 <= len(lines) <= 18
    assert lines[-1].startswith("Files: out: page.png")
    assert any(line.split()[:2] == ["peak", "torques"] for line in lines)
    assert "negative" not in summary_text(summary, "out") and "minimum -" not in summary_text(
        summary, "out"
    )


def test_a_slow_controller_is_warned_of(tmp_path, bags, example2):
    plain = bags.without(example2, bags.COMMANDS)
    summary = summary_of(bags, tmp_path, [*plain, *commands(bags, 40, 600_000)])
    first = summary_text(summary, "out").splitlines()[0]
    assert first.startswith("WARNING: example2: commands answered 5.33 % of samples, mean age 1")
    assert summary["command_age_mean_s"] == pytest.approx(0.0187, abs=0.002)


def test_a_negative_delay_has_its_meaning(tmp_path, bags, example2):
    plain = bags.without(example2, bags.COMMANDS)
    summary = summary_of(bags, tmp_path, [*plain, *commands(bags, 1, 1_900_000)])
    assert summary["command_latency_min_us"] < 0.0
    assert "the recorder received a command after the step that applied it" in summary_text(
        summary, "out"
    )


def test_losses_and_errors_are_reasons(tmp_path, bags, example2):
    lost = {20, 21, 60}

    def altered(message):
        return dataclasses.replace(message, effort=message.effort + 1e-9 * np.eye(9)[1])

    entries = bags.edited(bags.without(example2, bags.COMMANDS), bags.JOINTS, 75, altered)
    summary = summary_of(bags, tmp_path, [e for e in entries if e.sample not in lost])
    said = "; ".join(summary["reasons"])
    assert summary["verdict"] == "WARNING" and "3 samples lost" in said
    assert "2 gaps between applied torques" in said and "efforts differ" in said


def test_tracking_figures_are_there_where_there_is_a_reference(tmp_path, bags, example2):
    start = np.array(scene.load("example2").initial.gamma)
    entries = bags.tracked(example2, lambda _: (start, np.zeros(3)))
    summary = summary_of(bags, tmp_path, entries)
    lines = summary_text(summary, "out").splitlines()
    assert any(line.strip().startswith("tracking error, RMS") for line in lines)
    assert any(line.strip().startswith("settling time") for line in lines)


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
