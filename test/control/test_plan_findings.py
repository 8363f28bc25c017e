# SPDX-License-Identifier: Apache-2.0
"""What `plan check` concludes: findings, and the speeds at which a plan is feasible."""

from types import SimpleNamespace as Stub

import pytest

from sst_ros.cli.motions import describe_speeds, find_plan_findings
from sst_ros.control.plan import TimeScaling
from sst_ros.report.results import Severity


def stub_plan(*, least=0.5, problems=(), topic=False, lags=False):
    """Make a plan of 2 s with one distance that counts and one that does not."""
    moment = Stub(topic=True) if topic else None
    distances = [Stub(least=least, refused=True), Stub(least=-1.0, refused=False)]
    return Stub(
        problems=problems,
        distances=distances,
        motion=Stub(duration=2.0),
        trajectory=Stub(scene=Stub(moment=moment, lags=lags)),
    )


def test_findings_are_refusals_first_then_notes():
    plan = stub_plan(problems=["torque_1 = 3: must be < 2"], topic=True, lags=True)
    refused, moment, lag = find_plan_findings(plan)
    assert refused == (Severity.WARNING, "refused: torque_1 = 3: must be < 2")
    assert moment.severity is lag.severity is Severity.NOTE
    assert moment.text.endswith("it counts as zero here.")
    assert lag.text.startswith("The actuators lag;")
    assert find_plan_findings(stub_plan()) == []


@pytest.mark.parametrize(
    ("least", "speeds", "statements"),
    [
        (
            -0.1,
            TimeScaling(None, 0.0, "torque"),
            ["At no speed: the path itself leaves what is allowed."],
        ),
        (
            0.1,
            TimeScaling(None, 0.0, "torque"),
            ["At no speed: the torque limit is too small for this path."],
        ),
        (
            0.1,
            TimeScaling(float("inf"), 0.0, ""),
            ["At any speed: the scene has no limit that it could meet."],
        ),
        (
            0.1,
            TimeScaling(4.0, 0.0, "velocity"),
            [
                "Highest speed 4 times as planned, in 0.5 s; then the velocity limit is"
                " met."
            ],
        ),
        (
            0.1,
            TimeScaling(4.0, 0.25, "torque"),
            [
                "Highest speed 4 times as planned, in 0.5 s; then the torque limit is"
                " met.",
                "Slower than 0.25 times as planned it is not feasible either: the"
                " torque limit is too small to rest everywhere on this path.",
            ],
        ),
    ],
)
def test_speeds_are_described_by_the_limit_that_ends_them(least, speeds, statements):
    assert describe_speeds(stub_plan(least=least), speeds) == statements
