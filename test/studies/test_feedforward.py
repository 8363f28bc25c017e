# SPDX-License-Identifier: Apache-2.0
"""The study of feedforward: it finds what theory predicts, and it repeats to the last
bit.
"""

import csv
import dataclasses
import io
import json

import numpy as np
import pytest
from matplotlib import image

from sst_ros.control.law import MODES
from sst_ros.control.reference_motions import reference_motion
from sst_ros.report.results import publish
from sst_ros.scene.scene import load
from sst_ros.sweeps.sweep_study import SampledControl
from studies import feedforward
from studies.control_loop import (
    SHARE,
    ControlLoop,
    ideal_plant,
    is_stable,
    model_errors,
    run_loop,
)
from studies.feedforward import (
    COLUMNS,
    RESTLESS,
    FeedforwardPlan,
    document,
    draw_study,
    feedforward_study,
    page,
    title,
)
from studies.sampled_data import ORDERS, stability_limit

REACH = load("reach")
SPIRAL = dataclasses.replace(
    REACH.motion.spiral, phi=0.1, theta=3.0, psi=0.2, duration=0.4
)
SHORT = dataclasses.replace(
    REACH, motion=dataclasses.replace(REACH.motion, spiral=SPIRAL)
)
PERIOD_NS = 1_000_000


def errors(*names):
    return tuple(error for error in model_errors() if error.name in ("nominal", *names))


def held(scene, delay, damping=1.0):
    settings = SampledControl(
        mode="computed_torque",
        damping_ratio=damping,
        period=1e-9 * PERIOD_NS,
        delay=delay,
    )
    return ControlLoop(scene, reference_motion(scene), settings, scene)


def by_bandwidth(loop, bandwidth):
    settings = dataclasses.replace(loop.settings, bandwidth=bandwidth)
    return dataclasses.replace(loop, settings=settings)


@pytest.fixture(scope="module")
def small():
    """A study of 0.4 s with one failure in it: delay 5 at 180 rad/s."""
    pytest.importorskip("llvmlite", reason="takes minutes without: pip install .[fast]")
    plan = FeedforwardPlan(
        SHORT, bandwidths=(180.0,), delays=(0,),
        errors=errors("inertia +20%", "inertia -20%", "delay 5"),
    )  # fmt: skip
    return feedforward_study(plan, workers=1)


@pytest.mark.slow
def test_a_small_study_finds_what_theory_says(small):
    """Of torques that are not held, error and estimate are rounding: 1e4 operations at
    1e-16 each.

    A wrong model is helped by 1 / SHARE, less what the hold adds; the curvature may
    take 5 %.
    """
    assert small.orders() == pytest.approx(ORDERS, abs=0.1)
    error, estimate = small.unheld
    assert error < 1e-12 and estimate < 1e-11
    assert error < 10.0 * estimate + 1e-14
    for name in ("inertia +20%", "inertia -20%"):
        benefit, bound = small.benefit(name, 180.0), small.least_benefit(name, 180.0)
        assert 4.5 < bound < 1.0 / SHARE
        assert 0.95 * bound < benefit < 1.1 / SHARE
    found = small.limits.iloc[0]
    assert found.theory == pytest.approx(1e9 / PERIOD_NS, rel=1e-5)  # Jury: 1 / zeta
    assert found.ideal == pytest.approx(found.theory, rel=0.02)


def test_with_delay_the_limit_lies_where_theory_says():
    loop, bound = held(ideal_plant(SHORT), 2), stability_limit(1.0, 2) * 1e9 / PERIOD_NS
    assert is_stable(loop, 0.97 * bound) and not is_stable(loop, 1.03 * bound)


@pytest.mark.slow
@pytest.mark.parametrize("delay", range(6))
def test_the_motion_is_followed_near_the_limit_and_lost_beyond(delay):
    bound = stability_limit(1.0, delay) * 1e9 / PERIOD_NS
    loop = dataclasses.replace(held(ideal_plant(SHORT), delay), lost=0.05)
    near, beyond = (run_loop(by_bandwidth(loop, share * bound)) for share in (0.9, 1.2))
    assert not near[2] and np.abs(near[0].error).max() < 1e-3
    assert beyond[2]


@pytest.mark.slow
def test_a_loop_that_is_lost_says_so():
    loop = dataclasses.replace(held(SHORT, 5), lost=0.01, offset=1e-3)
    track, limited, failure = run_loop(by_bandwidth(loop, 400.0))
    assert failure.endswith("off by more than 0.01 rad")
    assert len(track.time) == len(limited) < 400


@pytest.mark.slow
def test_the_same_bits_on_any_number_of_workers():
    plan = FeedforwardPlan(
        SHORT, 4 * PERIOD_NS, (40.0,), errors=errors("noise"), multiples=(1, 2),
        delays=(),
    )  # fmt: skip
    first, second = (feedforward_study(plan, workers=n) for n in (1, 2))
    assert first.loops.to_csv() == second.loops.to_csv()
    assert first.holds.equals(second.holds) and first.unheld == second.unheld
    other = feedforward_study(dataclasses.replace(plan, seed=9), workers=1)
    assert (
        first.loops.drop(columns="seed").to_csv()
        != other.loops.drop(columns="seed").to_csv()
    )


@pytest.mark.slow
def test_its_files_can_be_read_and_failures_keep_their_reason(small, tmp_path):
    drawn = draw_study(small, title(small))
    files = {".csv": small.loops, ".json": document(small), "picture.png": drawn}
    publish(tmp_path, "feedforward", files)
    rows = list(csv.DictReader(io.StringIO((tmp_path / "feedforward.csv").read_text())))
    assert list(rows[0]) == list(COLUMNS) and len(rows) == 4 * len(MODES)
    written = json.loads((tmp_path / "feedforward.json").read_text())
    assert [float(row["rms_rad"] or "nan") for row in rows] == pytest.approx(
        [row["rms_rad"] or np.nan for row in written["loops"]], nan_ok=True
    )
    assert {row["seed"] for row in written["loops"]} == {8}
    assert written["report"]["numpy"] == np.__version__
    failed = small.loops[small.loops.failure != ""]
    assert set(failed.error) == {"delay 5"} and set(failed.bandwidth_rad_per_s) == {
        180.0
    }
    assert set(failed["mode"]) == set(MODES) - {"feedforward"} and len(failed) == 4
    assert failed.failure.str.contains(f"{RESTLESS}|stopped").all()
    said = page(small)
    assert (
        f"[{len(failed)}] delay 5, gravity_pd at 180 rad/s: {failed.failure.iloc[-1]}"
        in said
    )
    assert "seed 8" in said and f"NumPy {np.__version__}" in said and "theory 2" in said
    pixels = image.imread(tmp_path / "picture.png")
    assert (np.ptp(pixels[:, :, :3], axis=2) > 0.2).sum() > 2000


def test_a_scene_without_a_motion_is_refused_without_a_traceback(capsys):
    assert feedforward.main(["--scene", "example2_heavy"]) == 1
    error = capsys.readouterr().err
    assert "the scene has no desired motion" in error and "Traceback" not in error
