# SPDX-License-Identifier: Apache-2.0
"""Contacts, clamps and turns under friction happen when the proof says, and only then.

The truth has 30 digits and is independent of the package: see `quad_truth`.
"""

import sys
from pathlib import Path

import pytest
from mpmath import mp, mpf

from sst_ros import certify, load_scene

sys.path.insert(0, __file__.rpartition("/")[0])
import quad_truth as truth

SCENES = Path(__file__).parents[2] / "config" / "scenes"
NARROW = 1e-8  # widest span of an event [s]


def documents(name, changes=None):
    """A scene and its document in texts, with other texts where some are given."""
    texts = truth.read((SCENES / f"{name}.yaml").read_text(encoding="utf-8"))
    changes = changes or {}
    for key, value in changes.items():
        texts[key] = value
    scene = load_scene(name).with_values(truth.read_values(changes))
    return scene, texts


def true_motion(proven, texts, times):
    near = proven.trajectory.quaternion[0]
    with mp.workdps(truth.DIGITS):
        exact = truth.numbers(texts)
    return truth.motion(exact, near, times)


def compare_rows(proven, states):
    """Largest true error over its bound at the rows of a table."""
    worst = 0.0
    for row, state in enumerate(states):
        worst = max(worst, *truth.ratios(proven, row, state).values())
    return worst


def compare_events(proven, events):
    """Each event lies in a span of its name, and each span of these has one."""
    spans = {name: list(some) for name, some in proven.limits.items()}
    for event in events:
        if event.name not in spans:
            continue  # a stop that no longer pushes is no contact that ends
        with mp.workdps(truth.DIGITS):
            around = [
                span
                for span in spans[event.name]
                if mpf(span[0]) <= event.time <= mpf(span[1])
            ]
        assert len(around) == 1, event
        spans[event.name].remove(around[0])
    return {
        name: some
        for name, some in spans.items()
        if some and ("contact" in name or "torque" in name)
    }


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_contacts_of_the_whole_motion_are_those_of_the_truth():
    scene, texts = documents("elastic_stops")
    times = [0.5, 0.95, 1.25, 1.5]
    proven = certify(scene, t_eval=times)
    assert proven.success and proven.until == 1.5
    states, events = true_motion(proven, texts, times)
    contacts = [event for event in events if "contact" in event.name]
    assert len(contacts) >= 2
    assert 0.0 < compare_rows(proven, states) <= 1.0
    assert not compare_events(proven, events)
    for spans in proven.limits.values():
        assert all(end - begin < NARROW for begin, end in spans)


def test_a_contact_begins_and_ends_when_it_is_said():
    changes = {
        "initial": {
            "gamma": ["0.002", "0.11", "0.09"],
            "gamma_dot": ["-1.2", "0.3", "-0.2"],
        },
        "stroke": {"at_end": "elastic", "stiffness": "9000", "damping": "0.3"},
        "workspace": {"at_edge": "ignore"},
    }
    scene, texts = documents("elastic_stops", changes)
    proven = certify(scene, duration=0.03125, t_eval=[0.03125])
    states, events = true_motion(proven, texts, [0.03125])
    contacts = [event for event in events if event.name == "contact of gamma_1 at 0"]
    assert len(contacts) >= 2 and proven.success
    assert 0.0 < compare_rows(proven, states) <= 1.0
    assert not compare_events(proven, events)
    assert all(end - begin < NARROW for begin, end in spans_of(proven, contacts))


def spans_of(proven, events):
    return [span for event in events for span in proven.limits[event.name]]


@pytest.mark.slow
def test_a_clamp_begins_and_ends_when_it_is_said():
    changes = {"actuators": {"torque_limit": "2.0"}}
    scene, texts = documents("elastic_stops", changes)
    proven = certify(scene, duration=0.125, t_eval=[0.125])
    states, events = true_motion(proven, texts, [0.125])
    clamps = [event for event in events if "torque" in event.name]
    assert len(clamps) >= 3 and proven.success
    assert 0.0 < compare_rows(proven, states) <= 1.0
    assert not compare_events(proven, events)
    assert all(end - begin < NARROW for begin, end in spans_of(proven, clamps))


@pytest.mark.slow
def test_a_joint_turns_back_under_friction_when_it_is_said():
    law = {"coulomb": "0.3", "static": "0.45", "stribeck": "0.4", "smoothing": "0.1"}
    changes = {
        "friction": {"gamma": law | {"viscous": "0.2"}},
        "initial": {
            "gamma": ["0.7", "0.8", "0.75"],
            "gamma_dot": ["0.3", "-0.2", "-0.25"],
        },
    }
    scene, texts = documents("friction", changes)
    proven = certify(scene, duration=0.1875, t_eval=[0.1875])
    states, _ = true_motion(proven, texts, [0.1875])
    assert proven.success and 0.0 < compare_rows(proven, states) <= 1.0
    names = [f"gamma_{leg} turns back under dry friction" for leg in (1, 2, 3)]
    ends = {end for name in names for span in proven.limits[name] for end in span}
    times = sorted([*ends, *(0.1875 * k / 20 for k in range(1, 21))])
    states, _ = true_motion(proven, texts, times)
    times = [0.0, *times]
    turns = 0
    for leg, name in enumerate(names):
        with mp.workdps(truth.DIGITS):
            rates = [mpf(texts["initial"]["gamma_dot"][leg])]
        rates += [state.joints[9 + leg] for state in states]
        for k in range(1, len(times)):
            begin, end = times[k - 1 : k + 1]
            turned = rates[k] * rates[k - 1] < 0
            inside = any(a <= begin and end <= b for a, b in proven.limits[name])
            assert turned <= inside, (name, begin, end)
        for begin, end in proven.limits[name]:
            before, after = rates[times.index(begin)], rates[times.index(end)]
            assert before * after < 0 and end - begin < NARROW
            turns += 1
    assert turns >= 3
