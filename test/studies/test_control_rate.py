# SPDX-License-Identifier: Apache-2.0
"""Study of control rates: orders of the hold, whatever the method, in runs of the run
loop.
"""

import dataclasses

import numpy as np
import pytest

from sst_ros.errors import InputError
from sst_ros.mechanism.geometry import angle_between
from sst_ros.scene import scene
from sst_ros.simulation.simulate import simulate
from sst_ros.state import NANOSECONDS
from studies.control_rate import (
    EXACT,
    HOLDS,
    MIDDLE,
    START,
    advice,
    control_study,
    figure,
    grid,
    page,
    run_controlled,
)

BRIEF = dataclasses.replace(scene.load("example2"), duration=0.2)
RATES, METHODS = (100, 200, 500), ("rk4", "dop853")


@pytest.fixture(scope="module")
def brief():
    return control_study(BRIEF, rates=RATES, methods=METHODS)


def test_the_orders_are_the_theorys_whatever_the_method(brief):
    assert brief.order(START) == pytest.approx(1.0, abs=0.02)
    assert brief.order(MIDDLE) == pytest.approx(2.0, abs=0.02)
    assert max(brief.spread(START), brief.spread(MIDDLE)) < 1.001
    assert advice(brief).startswith(
        "raise the rate or command the torque of the middle"
    )
    exact = brief.rows[(brief.rows.hold == EXACT) & (brief.rows.method == "dop853")]
    assert exact.largest_rad.max() < 1e-12
    rows = brief.rows
    times_ns, states, *_ = run_controlled(BRIEF, 0.2, 500, "rk4", EXACT)
    truth = simulate(BRIEF, tolerance=1e-12, t_eval=times_ns / NANOSECONDS)
    at_ticks = angle_between(states[:, :4], truth.quaternion)
    row = rows[(rows.rate_Hz == 500) & (rows.method == "rk4") & (rows.hold == EXACT)]
    assert row.largest_rad.item() == pytest.approx(at_ticks.max(), rel=1e-4)
    # fewer instants would show less
    assert at_ticks[::10].max() < 0.999 * at_ticks.max()
    assert len(rows) == len(RATES) * len(METHODS) * len(HOLDS)
    assert (rows.tick_us > 0.0).all() and (rows.estimate_rad < 2e-7).all()
    assert (rows.final_rad <= rows.largest_rad).all()
    np.testing.assert_allclose(rows.core_share, 1e-6 * rows.tick_us * rows.rate_Hz)
    said = page([brief])
    assert "theory 2." in said and advice(brief) in said and "WARNING" not in said
    assert "| 500 | middle |" in said
    assert len(grid(brief)) == len(RATES) * len(HOLDS)
    assert any("slope 2" in text.get_text() for text in figure(brief).axes[0].texts)


def test_a_rate_counts_only_if_every_higher_one_does(brief):
    """Of rk4 at 100 Hz the error of the method and that of the hold cancel.

    At 200 Hz not.
    """
    rows = brief.rows.copy()
    own = (rows.method == "rk4") & (rows.hold == EXACT)
    held = (rows.method == "rk4") & (rows.hold == MIDDLE)
    rows.loc[own & (rows.rate_Hz == 200), "largest_rad"] = 1.0
    rows.loc[held & (rows.rate_Hz == 100), "largest_rad"] *= 1e-3
    rows.loc[held & (rows.rate_Hz == 200), "largest_rad"] *= 1.4
    lucky = dataclasses.replace(brief, rows=rows)
    assert lucky.least_rates == {"rk4": 500, "dop853": 100}
    assert max(lucky.spread(START), lucky.spread(MIDDLE)) < 1.001
    assert lucky.order(MIDDLE) == pytest.approx(2.0, abs=0.02)
    assert "; rk4, below 500 Hz, has errors of its own" in advice(lucky)
    rows.loc[rows.hold == EXACT, "largest_rad"] = 1.0
    assert "choose a finer method" in advice(dataclasses.replace(brief, rows=rows))


def test_a_scene_without_torques_is_refused():
    with pytest.raises(InputError, match="torque"):
        control_study(scene.load("swing"), rates=(100,))
