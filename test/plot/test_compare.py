# SPDX-License-Identifier: Apache-2.0
"""Several runs laid on each other: their differences against differences made by hand."""

import dataclasses
import math

import numpy as np
import pytest

from sst_ros import __main__ as cli
from sst_ros.errors import InputError
from sst_ros.plot import compare
from sst_ros.plot.compare import PICTURES, differences, draw_comparison
from sst_ros.recording.recording import read_signals


def shifted(bags, entries, by_ns, turn=0.0, keep=lambda sample: True):
    """The same run at another time, with gamma_1 of some samples changed by 1e-3 rad."""
    result = []
    for entry in entries:
        content = entry.content
        if hasattr(content, "header"):
            stamp = content.header.stamp.sec * 10**9 + content.header.stamp.nanosec
            if stamp:
                content = dataclasses.replace(content, header=bags.header(stamp + by_ns))
        if entry.topic == bags.JOINTS and entry.sample >= 0 and entry.sample % 2:
            position = np.array(content.position)
            position[0] += 1e-3
            content = dataclasses.replace(content, position=position)
        if entry.topic == bags.ORIENTATION:
            q, c, s = content.quaternion, math.cos(turn / 2), math.sin(turn / 2)
            x, y, z, w = c * q.x - s * q.y, c * q.y + s * q.x, c * q.z + s * q.w, c * q.w - s * q.z
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
    return [read_signals(bag) for bag in (first, bags.write(folder / "second", changed))]


def test_the_differences_are_those_that_were_made(pair):
    found = differences(pair).loc["second"]
    # 70 of the 141 samples are odd, and one of three angles is changed.
    rms = 1e-3 * math.sqrt(70 / 141 / 3)
    assert found.tolist() == pytest.approx([141, 141, 1e-3, rms, 0.0, 0.0, 0.02], rel=1e-9, abs=0.0)


def test_a_run_does_not_differ_from_itself(pair):
    assert differences([pair[0], pair[0]]).iloc[0].tolist() == [151, 151, *[0.0] * 5]


def test_samples_at_other_times_are_not_compared(pair, bags, example2, tmp_path):
    """Each sample but the first a nanosecond late: only the first is common."""
    late = [
        entry if entry.sample == 0 else shifted(bags, [entry], 1)[0]
        for entry in example2
        if entry.topic != bags.APPLIED
    ]
    other = read_signals(bags.write(tmp_path / "bag", late))
    assert other.start_ns == pair[0].start_ns
    assert differences([pair[0], other]).iloc[0].tolist()[:2] == [1, 151]


def test_the_command_draws_and_tells(pair, tmp_path, capsys, undrawn):
    words = ["plot", "--compare", *(str(run.bag.path) for run in pair), "--out", str(tmp_path)]
    assert cli.main(words) == 0
    said = capsys.readouterr().out
    assert "at samples that both have at the same time since the start of each run" in said
    assert "141 of 141" in said and "1.000e-03" in said
    drawn = {path.name for path in tmp_path.iterdir()}
    names = [name for name in PICTURES if name != "tracking_error"]
    assert drawn == {f"compare_{name}.{form}" for name in names for form in ("pdf", "png")}
    assert "tracking_error: not drawn: without first, second: no tracking_error there" in said


def test_a_run_that_lacks_a_topic_is_left_out_of_its_pictures(pair, bags, example2, tmp_path):
    poor = bags.write(tmp_path / "poor", [e for e in example2 if e.topic == bags.APPLIED])
    runs = [*pair, read_signals(poor)]
    paths, missing = draw_comparison(runs, tmp_path / "out", ["gamma", "torques"])
    assert [path.stem for path in paths[::2]] == ["compare_gamma", "compare_torques"]
    assert missing == {"gamma": "without poor: no joint_states there"}
    found = differences(runs).loc["poor"]
    assert found.tolist()[:2] == [0, 0] and found[2:].isna().all()
    last = compare.difference_text(runs).splitlines()[-1]
    assert last.split() == ["poor", "0", "of", "0", *"-----"]


def test_runs_that_cannot_be_told_apart_are_refused(pair, tmp_path):
    with pytest.raises(InputError, match="must be 2 to 6 bags"):
        draw_comparison([pair[0]] * 7, tmp_path)
