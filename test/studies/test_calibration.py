# SPDX-License-Identifier: Apache-2.0
"""The studies of the error estimate and of orders: a case of each class, a method of
each order.
"""

import pickle

import pytest
from slow_cases import slow_except

from sst_ros.errors import InputError, Problem, RunStopped, SingularConfiguration
from sst_ros.mechanism.geometry import angle_between
from sst_ros.report.results import data_frame
from studies.estimate import CLASSES, compare_bounds, measure
from studies.orders import (
    MOTIONS,
    ORDER,
    measure_steps,
    measure_tolerance,
    order_table,
    truth,
)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(c, marks=pytest.mark.slow)
        if c in ("sharp_friction", "elastic_stops")
        else c
        for c in CLASSES
    ],
)
def test_the_estimate_holds_in_a_case_of_each_class(name):
    row = next(
        row
        for row in (measure((name, 5, k)) for k in range(6))
        if row["state"] == "resolved"
    )
    assert row["error"] <= 3.0 * row["estimate"]
    assert row["status"] == 2 or row["error"] <= 3.0 * row["tolerance"]


@pytest.mark.slow
def test_a_proven_bound_is_above_the_true_error():
    row = compare_bounds((5, 0))
    assert row["error"] <= row["bound"] < 2.0 * row["error"]


def test_a_case_depends_on_its_seed_and_number_alone():
    one, other = (measure(("jump", 5, 3)) for _ in range(2))
    assert one == other


@pytest.mark.parametrize("method", slow_except(["dop853"], ["rk4", "dopri5", "dop853"]))
def test_a_method_has_its_order_on_a_smooth_motion(method):
    table = order_table(
        data_frame(row._asdict() for row in measure_steps(("lag", method)))
    )
    found = float(table["order, shortest steps"][0])
    assert ORDER[method] - 0.2 < found < 1.4 * ORDER[method]


def test_the_implicit_method_keeps_its_order_past_a_torque_limit():
    """A step begins at each kink; the rate of the torque is that behind it."""
    exact, motion = truth("clamp")[0], MOTIONS["clamp"]
    runs = [motion.run("rodas5p", 1e3, max_step=0.4 / steps) for steps in (8, 16, 32)]
    errors = [angle_between(run.quaternion[-1], exact.quaternion[-1]) for run in runs]
    assert errors[0] / errors[1] > 20.0 < errors[1] / errors[2]


@pytest.mark.slow
def test_events_and_samples_have_errors_below_the_tolerance():
    for name in ("stop", "contact", "friction"):
        rows = measure_tolerance((name, "dop853", 1e-7))
        assert rows and all(row.known < row.error < 1e-7 for row in rows)


@pytest.mark.parametrize(
    "error",
    [
        InputError("a", [Problem("k", 1, "no")]),
        RunStopped("r", 0.1, None),
        SingularConfiguration("m", 1.0),
    ],
)
def test_an_error_goes_from_a_worker_to_its_parent(error):
    again = pickle.loads(pickle.dumps(error))
    assert (
        type(again) is type(error)
        and str(again) == str(error)
        and vars(again) == vars(error)
    )
