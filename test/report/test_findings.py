# SPDX-License-Identifier: Apache-2.0
"""Findings of a run: which numbers are warned of, in what order, and what is a note."""

from types import SimpleNamespace

import pytest

from sst_ros.report import reference
from sst_ros.report.results import Severity, texts_of, verdict_of
from sst_ros.report.run import find_findings

GOOD = {
    "phase": "finished",
    "fault": None,
    "damage": [],
    "samples_lost": 0,
    "samples_recorded_percent": 100.0,
    "tick_gaps": 0,
    "ticks_missed": 0,
    "samples_answered_percent": 100.0,
    "command_age_mean_s": 0.0012,
    "error_limit_rad": 1e-9,
    "integration_error_gamma_rad": 1e-12,
    "simulator_error_estimate": 1e-12,
    "effort_difference_max_N_m": 0.0,
    "actuators_lag": False,
    "motion_of": "joint_states",
    "measurement_error_rms_rad": None,
    "measurement_error_max_rad": None,
    "foreign_states": 0,
}
RUN = SimpleNamespace(
    diagnostics={"phase": "finished"},
    seconds=[0.0, 0.3],
    scene=SimpleNamespace(moment=None, torque=object(), lags=False),
    ticks=SimpleNamespace(moment=None),
    time_ns=range(4),
    signals=SimpleNamespace(bag=SimpleNamespace(unverified=0)),
    missing=[],
)
WHOLE = SimpleNamespace(compared=4, restarts_ns=[])


@pytest.fixture
def find(monkeypatch):
    monkeypatch.setattr(reference, "begins", lambda _: True)

    def find_of(**changed):
        return find_findings(RUN, WHOLE, object(), GOOD | changed)

    return find_of


def test_a_good_run_has_no_finding_and_the_verdict_ok(find):
    assert find() == [] and verdict_of([]) == "OK"


@pytest.mark.parametrize(("share", "warned"), [(89.9, True), (90.0, False)])
def test_answers_to_nine_samples_of_ten_are_enough(find, share, warned):
    found = find(samples_answered_percent=share)
    assert verdict_of(found) == ("WARNING" if warned else "OK")


def test_warnings_come_by_weight_and_notes_make_no_verdict(find):
    found = find(tick_gaps=2, samples_lost=3, fault="singular", foreign_states=5)
    assert texts_of(found, Severity.WARNING) == [
        "fault: singular",
        "3 samples lost (100.00 % recorded)",
        "2 gaps between applied torques",
    ]
    notes = ["5 joint states of other robots are left out"]
    assert texts_of(found, Severity.NOTE) == notes
    assert verdict_of(find(foreign_states=5)) == "OK"


def test_errors_are_held_against_the_limit_of_the_run(find):
    found = find(integration_error_gamma_rad=2e-9, simulator_error_estimate=3e-9)
    assert texts_of(found, Severity.WARNING) == [
        "integration error 2.0e-09 rad above 1e-09 rad",
        "error estimate 3.0e-09 rad above 1e-09 rad",
    ]
    assert find(integration_error_gamma_rad=None) == []
