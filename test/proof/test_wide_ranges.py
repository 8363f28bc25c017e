# SPDX-License-Identifier: Apache-2.0
"""Ranges of any number: proven, or refused with the width that would do."""

import math
import re

import pytest
from slow_cases import slow_after

from sst_ros import InputError, certify, load_scene
from sst_ros.proof import certify as certify_module
from sst_ros.proof.balls import precision
from sst_ros.proof.scene_balls import WrittenDocument, range_balls
from sst_ros.scene.schema import key_of, leaves

HUGE = (0.9, 1e3, 1e150)  # half-widths
TIME = 2.0**-10  # s
EVERYTHING = {
    "base": {"arcs_deg": [88.3, 91.7, 90.4], "radius": 0.35},
    "actuators": {
        "torque_limit": 2.0,
        "time_constant": 0.02,
        "rotor_inertia": 1e-5,
        "gear_ratio": 10.0,
        "idle_damping": 0.1,
    },
    "friction": {
        "gamma": {"viscous": 0.1, "coulomb": 0.1, "smoothing": 0.5},
        "beta": {"coulomb": 0.1, "smoothing": 0.5, "static": 0.2, "stribeck": 0.4},
    },
    "springs": [{"joint": "gamma_1", "stiffness": 3.0, "rest": 0.7}],
    "gravity": {"acceleration": [1.0, -2.0, -9.81]},
    "moment": {"value": [0.1, 0.2, -0.1]},
    "payload": {
        "mass": 0.3,
        "centre": [0.0, 0.01, 0.05],
        "inertia": {"xx": 1e-3, "yy": 1e-3, "zz": 1e-3},
    },
    "stroke": {
        "at_end": "elastic",
        "stiffness": 900.0,
        "restitution": 0.8,
        "impact_rate": 1.0,
    },
    "workspace.at_edge": "ignore",
    "torque": {
        "amplitude": [1.0, -0.5, 2.0],
        "frequency": [15.0, 12.0, 20.0],
        "phase": [0.1, 1.0, 0.5],
    },
    "initial.orientation": None,
    "initial.gamma": (0.75, 0.7, 0.75),
    "initial.gamma_dot": (0.2, -0.3, 0.1),
}


def everything():
    return load_scene("general").with_values(EVERYTHING)


def every_key():
    with precision():
        document = WrittenDocument.of(everything()).scene
    return [key_of(place) for place in leaves(document)]


def answer(key, width):
    """What certify says of a range: a reason, "" for a whole proof, or a refusal."""
    times = {"t_eval": [TIME], "max_steps": 30}
    try:
        proven = certify(everything(), duration=TIME, ranges={key: width}, **times)
    except InputError as refused:
        assert key.split("[")[0].split(".")[0] in str(refused)
        return str(refused)
    finite = [math.isfinite(x) for x in proven.columns["angle"]]
    assert all(finite) and (proven.reason or finite)
    return proven.reason


def test_every_number_is_a_range_or_refused_by_name():
    keys = every_key()
    assert len(keys) > 90
    refused = []
    with precision():
        document = WrittenDocument.of(everything())
        for key in keys:
            try:
                (ball,) = range_balls(
                    document, {key: 1e3}, own_torque=True, origin="certify"
                ).values()
            except InputError as error:
                assert key in str(error)
                refused.append(key.split("[")[0])
            else:
                assert ball.rad() >= 1e3
    assert sorted(set(refused)) == [
        "actuators.idle_damping", "base.radius", "duration", "star.radius",
    ]  # fmt: skip


@pytest.mark.parametrize(
    "key",
    slow_after(
        1,
        [
            "base.arcs_deg[0]",
            "star.alpha_deg[0]",
            "star.inertia.zz",
            "payload.mass",
            "friction.beta.stribeck",
            "stroke.restitution",
            "initial.gamma[0]",
        ],
    ),
)
def test_what_is_too_wide_says_so(monkeypatch, key):
    monkeypatch.setattr(certify_module.ProofTask, "_needed_halvings", lambda *_: 9)
    assert "0.00195 of their width would do" in answer(key, 1e3)


@pytest.mark.slow
def test_no_width_of_some_numbers_ends_in_another_error(monkeypatch):
    monkeypatch.setattr(certify_module.ProofTask, "_needed_halvings", lambda *_: 9)
    for number, key in enumerate(every_key()[::20]):
        answer(key, HUGE[number % len(HUGE)])


@pytest.mark.slow
@pytest.mark.search
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("width", HUGE)
def test_no_width_of_any_number_ends_in_another_error(monkeypatch, width):
    """A width that would do, which takes up to 32 proofs, is sought for some."""
    for number, key in enumerate(every_key()):
        with monkeypatch.context() as patch:
            if number % 32 != 0:
                patch.setattr(
                    certify_module.ProofTask, "_needed_halvings", lambda *_: 9
                )
            answer(key, width)


@pytest.mark.parametrize(
    "width",
    [10**400, -(10**400), math.inf, (-math.inf, math.inf), (0.1, 10**400), True, (0,)],
)
def test_what_is_no_finite_range_is_refused(width):
    with pytest.raises(InputError, match=r"ranges\[star.mass\].*half-width >= 0"):
        certify("example2", ranges={"star.mass": width})


@pytest.mark.slow
def test_a_geometry_that_is_none_is_refused_with_a_width():
    times = {"duration": 0.02, "t_eval": [0.02]}
    with pytest.raises(
        InputError, match=r"ranges = 'base\.v': must be narrower"
    ) as told:
        certify("general", ranges={"base.v": 0.9}, **times)
    share = float(re.search(r"([\d.]+) of their width would do", str(told.value))[1])
    proven = certify("general", ranges={"base.v": 0.9 * share}, **times)
    assert not proven.reason and 0.0 < share < 0.1
    wider = certify("general", ranges={"base.v": 2.1 * 0.9 * share}, **times)
    assert "too wide" in wider.reason


@pytest.mark.slow
def test_the_width_and_split_that_are_advised_would_do():
    times = {"duration": 0.1, "t_eval": [0.1]}
    proven = certify("general", ranges={"star.alpha_deg[0]": 0.2}, **times)
    found = re.search(
        r"([\d.]+) of their width would do, or split=(\d+)", proven.reason
    )
    share, parts = float(found[1]), int(found[2])
    assert parts == round(1.0 / share)
    narrow = certify("general", ranges={"star.alpha_deg[0]": 0.2 * share}, **times)
    split = certify("general", ranges={"star.alpha_deg[0]": 0.2}, split=parts, **times)
    assert not narrow.reason and not split.reason
    assert split.columns["angle"][0] > narrow.columns["angle"][0]
