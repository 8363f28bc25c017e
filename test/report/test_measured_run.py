# SPDX-License-Identifier: Apache-2.0
"""Runs whose joint states are measured: truth and measurement are told apart."""

import dataclasses
import itertools
import sys

import numpy as np
import pytest
from slow_cases import slow_except

from sst_ros import __main__ as cli
from sst_ros import identify, read_bag
from sst_ros.figures import DEGREES
from sst_ros.identification.parameters import values
from sst_ros.plot import pictures
from sst_ros.report.run import evaluate_run
from sst_ros.scene import scene
from sst_ros.state import nanoseconds

TRUE = "/sst_simulator/true_joint_states"
NOISE, RATE_NOISE, COUNT, DELAY, DROPPED = 1e-3, 0.05, 2.0 * np.pi / 4096, 3, 0.2
KINDS = ("noise", "quantised", "delayed", "dropped")
COMBINATIONS = [
    kinds for count in range(1, 5) for kinds in itertools.combinations(KINDS, count)
]
QUICK = ("noise",), ("quantised", "delayed")


@pytest.fixture(scope="module")
def exact(bags):
    return bags.simulated(scene.load("example2"), 0.1)


def measure(bags, entries, kinds, monkeypatch, *, truth):
    """Messages as a robot with sensors sends them, with the true ones beside or
    without.
    """
    monkeypatch.setitem(bags.KINDS, TRUE, bags.KINDS[bags.JOINTS])
    random = np.random.default_rng(5)
    samples = [one for one in entries if one.topic == bags.JOINTS and one.sample >= 0]
    others = [
        one for one in entries if not (one.topic == bags.JOINTS and one.sample >= 0)
    ]
    found = []
    for k, entry in enumerate(samples):
        if truth:
            found.append(dataclasses.replace(entry, topic=TRUE))
        late = DELAY if "delayed" in kinds else 0
        source = samples[max(k - late, 0)].content
        position, velocity = source.position.copy(), source.velocity.copy()
        if "noise" in kinds:
            position += NOISE * random.normal(size=9)
            velocity += RATE_NOISE * random.normal(size=9)
        if "quantised" in kinds:
            position = COUNT * np.round(position / COUNT)
        if "dropped" in kinds and random.random() < DROPPED:
            continue
        content = dataclasses.replace(
            entry.content, position=position, velocity=velocity
        )
        found.append(dataclasses.replace(entry, content=content))
    return sorted([*others, *found], key=lambda one: one.received_ns)


@pytest.mark.parametrize("kinds", slow_except(QUICK, COMBINATIONS), ids="-".join)
def test_with_the_truth_a_measured_run_is_evaluated_as_exact(
    read, bags, exact, monkeypatch, kinds
):
    run = read(measure(bags, exact, kinds, monkeypatch, truth=True))
    found = evaluate_run(run).summary
    expected = evaluate_run(read(exact)).summary
    assert found["verdict"] == "OK", found["reasons"]
    for key in (
        "integration_error_gamma_rad",
        "energy_residual_max_J",
        "samples_recorded",
    ):
        assert found[key] == expected[key]
    assert found["motion_of"] == "true_joint_states"
    assert any(
        "(true_joint_states), tracking is that of the measured" in x
        for x in found["notes"]
    )
    kept = {nanoseconds(one.content.header.stamp) for one in exact if one.sample >= 0}
    assert len(run.time_ns) == 51 and len(run.measured.time_ns) <= len(kept)
    assert run.motion.gamma is run.gamma and run.measured.gamma is not run.gamma
    assert (len(run.measured.time_ns) < 51) == ("dropped" in kinds)
    off = found["measurement_error_max_rad"]
    if kinds == ("dropped",):
        assert off == 0.0
    elif kinds == ("quantised",):
        assert 0.3 * COUNT < off <= 0.5 * COUNT * (1.0 + 1e-9)
    else:
        assert off > 1e-4


@pytest.mark.parametrize("kinds", slow_except(QUICK, COMBINATIONS), ids="-".join)
def test_without_the_truth_a_measured_run_is_judged_by_its_own(
    read, bags, exact, monkeypatch, kinds
):
    run = read(measure(bags, exact, kinds, monkeypatch, truth=False))
    found = evaluate_run(run).summary
    # Who dropped a sample, the sensor or the recorder, only the truth can tell.
    lost = [one for one in found["reasons"] if "samples lost" not in one]
    assert lost == [] and ("dropped" in kinds) == bool(found["reasons"])
    assert found["integration_error_gamma_rad"] < 1e-11
    assert found["integration_error_orientation_rad"] < 1e-11
    if kinds == ("dropped",):
        assert (
            found["motion_of"] == "joint_states"
            and found["energy_residual_max_J"] < 1e-9
        )
        return
    assert run.motion is None and found["motion_of"] is None
    assert found["energy_residual_max_J"] is None
    assert found["integration_error_gamma_dot_rad_per_s"] is None
    assert any("true_joint_states are not recorded" in note for note in found["notes"])
    assert found["measurement_error_max_rad"] > 1e-4


def test_measured_angles_alone_show_that_the_rates_are_measured(
    read, bags, exact, monkeypatch
):
    """Angles are exact, rates have noise: the energy of such rates is no fault of the
    run.
    """
    random = np.random.default_rng(3)

    def shake(message):
        noise = RATE_NOISE * random.normal(size=9)
        return dataclasses.replace(message, velocity=message.velocity + noise)

    found = evaluate_run(read(bags.edited(exact, bags.JOINTS, None, shake))).summary
    assert found["verdict"] == "OK" and found["energy_residual_max_J"] is None


def test_a_single_wrong_sample_is_an_error_and_no_measurement(read, bags, exact):
    def move(message):
        return dataclasses.replace(message, position=message.position + 1e-6)

    run = read(bags.edited(exact, bags.JOINTS, 30, move))
    found = evaluate_run(run).summary
    assert run.motion is run.measured
    assert (
        found["verdict"] == "WARNING"
        and "integration error 1.0e-06 rad" in found["reasons"][0]
    )


def test_pictures_show_the_truth_and_what_was_measured(
    written, bags, exact, monkeypatch, tmp_path, undrawn
):
    path = written(measure(bags, exact, ("noise",), monkeypatch, truth=True))
    run = read_bag(path).signals
    figure = pictures.RUN_PICTURES["joint_angles"].make(run, run.scene)
    dots, lines = figure.axes[0].lines[:3], figure.axes[0].lines[3:]
    for leg in range(3):
        measured, true = run.legs("gamma")[:, leg], run.legs("true_gamma")[:, leg]
        np.testing.assert_allclose(dots[leg].get_ydata(), np.degrees(measured))
        np.testing.assert_allclose(lines[leg].get_ydata(), np.degrees(true))
    kinetic, _ = pictures.energies(run, run.scene)
    left = kinetic - kinetic[0] - pictures.work(run).sum(axis=1)
    assert np.abs(left).max() < 1e-9 * kinetic.max()
    assert cli.main(["plot", str(path), "--out", str(tmp_path / "plots")]) == 0


@pytest.mark.parametrize("kinds", slow_except(QUICK, COMBINATIONS), ids="-".join)
def test_pictures_of_each_combination_show_truth_and_measurement(
    written, bags, exact, monkeypatch, kinds
):
    path = written(measure(bags, exact, kinds, monkeypatch, truth=True))
    run = read_bag(path).signals
    for name in ("joint_angles", "joint_rates", "power", "margins"):
        figure = pictures.RUN_PICTURES[name].make(run, run.scene)
        assert figure.axes[0].get_lines()
    dots = pictures.RUN_PICTURES["joint_angles"].make(run, run.scene).axes[0].lines[:3]
    true = DEGREES * run.true_legs("gamma")
    apart = [
        np.nanmax(np.abs(dot.get_ydata() - column))
        for dot, column in zip(dots, true.T, strict=True)
    ]
    same = set(kinds) == {"dropped"}
    assert max(apart) < 1e-9 if same else min(apart) > 1e-3  # deg
    assert np.isfinite(true).all()


@pytest.fixture(scope="module")
def longer(bags):
    return bags.simulated(scene.load("example2_heavy"), 1.2)


@pytest.mark.parametrize("truth", [True, False], ids=["with the truth", "without"])
@pytest.mark.parametrize("kinds", slow_except(QUICK, COMBINATIONS), ids="-".join)
def test_each_combination_is_identified(read, bags, longer, monkeypatch, kinds, truth):
    """By what was measured: the delay, and inertias within five deviations."""
    monkeypatch.setattr(sys.modules[__name__], "NOISE", 2e-5)
    monkeypatch.setattr(sys.modules[__name__], "COUNT", 2.0 * np.pi / 65536)
    run = read(measure(bags, longer, kinds, monkeypatch, truth=truth))
    found = identify(run, parameters=["star.inertia"])
    if "delayed" in kinds:
        assert found.delay == pytest.approx(DELAY * 2e-3, abs=4e-4)
    else:
        assert abs(found.delay) < 4e-4
    true = found.base.transform @ values(run.scene, found.names)
    size = np.abs(true).max()
    # Without noise the deviations are those of nothing: what is left is interpolation.
    allowed = 5.0 * found.deviation + 1e-4 * size
    assert np.all(np.abs(found.estimate - true) < allowed)
    assert found.deviation.max() < 0.1 * size
