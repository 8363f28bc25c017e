# SPDX-License-Identifier: Apache-2.0
"""Feedback in the compiled loop: at each sample the torque of the Python controller."""

import numpy as np
import pytest
from scipy import stats
from slow_cases import slow_after, slow_except

from sst_ros import load_scene, sweep
from sst_ros.control.controller import Controller, Measurement, TrackingMetrics
from sst_ros.control.law import MODES, ControlChannel, ControllerSettings
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.errors import InputError
from sst_ros.sweeps.controlled_batch import (
    ControlledBlock,
    normal_number,
    streams,
    uniform_numbers,
)
from sst_ros.sweeps.sweep import PreparedSweep, run_study
from sst_ros.sweeps.sweep_study import SweepStudy
from studies.control_loop import ChannelState, ControlLoop, run_loop

for module in ("pandas", "pyarrow"):
    pytest.importorskip(module, reason="a sweep needs it")

SCENE = load_scene("reach")
VARY = {"star.mass": ("uniform", 2.4, 2.8)}
PERIOD, SAMPLES = 2e-3, 25


CASES = [
    *({"mode": mode} for mode in MODES),
    {"mode": "computed_torque", "space": "so3", "integral_rate": 3.0},
    {"mode": "feedforward_pd", "feedforward_at": "middle", "delay": 2, "counts": 4096},
    {"mode": "pd", "stiffness": (300.0, 200.0, 100.0), "damping": (10.0, 8.0, 5.0),
     "integral_rate": 2.0, "torque_limit": 4.0, "angle_noise": 1e-4,
     "rate_noise": 1e-2},
    {"mode": "computed_torque", "counts": 20_000, "delay": 1, "angle_noise": 1e-5,
     "feedforward_at": "middle", "torque_limit": 6.0, "integral_rate": 4.0},
]  # fmt: skip
CHANNEL = ("delay", "counts", "angle_noise", "rate_noise")


def gaussian(seed, rows, counter):
    """Standard normal numbers `counter` of rows."""
    sample, number = divmod(counter, 6)
    uniform = uniform_numbers(streams(seed, np.asarray(rows)), sample)
    return normal_number(*uniform[2 * number : 2 * number + 2])


@pytest.mark.parametrize("by", slow_except(["machine code"], ["NumPy", "machine code"]))
@pytest.mark.parametrize(
    "case", slow_after(1, CASES), ids=lambda case: "-".join(map(str, case.values()))
)
def test_each_torque_is_that_of_the_python_controller(
    monkeypatch, without_machine_code, case, by
):
    if by == "NumPy":
        without_machine_code()
    else:
        pytest.importorskip("llvmlite", reason="needs llvmlite: pip install .[fast]")
    study = SweepStudy(
        SCENE, VARY, n=3, seed=11, steps=2 * SAMPLES,
        control={"period": PERIOD, **case}, duration=SAMPLES * PERIOD,
    )  # fmt: skip
    ready = PreparedSweep(study)
    torques, prepare_step = [], ControlledBlock.prepare_step

    def one_step(block, number):
        prepare_step(block, number)
        if number % 2 == 0:
            torques.append(block.given[:3, :3].copy())

    monkeypatch.setattr(ControlledBlock, "prepare_step", one_step)
    rows = np.arange(5, 8)
    scenarios, starts, _ = ready.scenarios(study.draw(0, 3))
    start = study.motion.at(0.0)
    # Off the reference, for feedback to act.
    off = np.array([0.01, -0.02, 0.005])
    starts["initial.gamma"] = np.tile(start.gamma + off, (3, 1))
    batch = ready.batch.with_parameters(scenarios)
    result, _ = ready.controlled.run(batch, starts, rows, 2 * SAMPLES, 2)
    assert result.success.all()
    channel = {key: case[key] for key in CHANNEL if key in case}
    settings = ControllerSettings(**{k: v for k, v in case.items() if k not in CHANNEL})
    joints = Dynamics.of(SCENE).joints
    for lane in range(3):
        controller = Controller(SCENE, study.motion, settings, PERIOD)
        quiet = {key: channel.get(key, 0) for key in ("delay", "counts")}
        encoders = ChannelState(ControlChannel(period=PERIOD, **quiet), 0)
        noise = channel.get("angle_noise", 0.0), channel.get("rate_noise", 0.0)
        for k in range(SAMPLES):
            q, rate = result.kept.quaternion[k, lane], result.kept.body_rate[k, lane]
            at = joints(*q.tolist(), *rate.tolist())
            measured = encoders.measure(at[0:3], at[9:12])
            gamma, gamma_dot = measured.gamma, measured.gamma_dot
            if any(noise):
                drawn = [
                    gaussian(11, rows[lane : lane + 1], 6 * k + j)[0] for j in range(6)
                ]
                gamma = tuple(np.add(gamma, noise[0] * np.array(drawn[:3])).tolist())
                gamma_dot = tuple(
                    np.add(gamma_dot, noise[1] * np.array(drawn[3:])).tolist()
                )
            command = controller.command(k * PERIOD, Measurement(gamma, gamma_dot))
            expected = encoders.transmit(command.torque)
            scale = max(1.0, np.abs(command.feedback).max())
            np.testing.assert_allclose(
                torques[k][:, lane], expected, rtol=0, atol=1e-12 * scale
            )


@pytest.mark.slow
def test_a_closed_loop_tracks_as_that_of_the_simulation():
    """Whole runs, each integrated by steps of its own."""
    control = {"mode": "feedforward_pd", "bandwidth": 40.0, "period": 0.01, "delay": 1}
    study = SweepStudy(
        SCENE, {"star.mass": [2.6, 2.0]}, control=control, tolerance=1e-10
    )
    found = run_study(study, None)
    for row, mass in enumerate((2.6, 2.0)):
        plant = SCENE.with_values({"star.mass": mass})
        loop = ControlLoop(SCENE, study.motion, study.control, plant)
        track, limited, failure = run_loop(loop)
        assert failure == ""
        rms = np.sqrt(np.mean(track.error**2, axis=0))
        for name, errors in (("rms", rms), ("max", np.abs(track.error).max(axis=0))):
            columns = [f"error_{name}_{k}" for k in (1, 2, 3)]
            assert found.loc[row, columns].tolist() == pytest.approx(errors, abs=1e-8)
        torque, last = track.torque[:-1], TrackingMetrics(track)
        for name, torques in (
            ("rms", np.sqrt(np.mean(torque**2, axis=0))),
            ("max", np.abs(torque).max(axis=0)),
        ):  # fmt: skip
            columns = [f"torque_{name}_{k}" for k in (1, 2, 3)]
            assert found.loc[row, columns].tolist() == pytest.approx(torques, rel=1e-6)
        inside = np.abs(track.error).max(axis=1) <= last.band
        since = len(inside) - np.argmin(inside[::-1]) if not inside.all() else 0
        expected = since * 0.01 if inside[-1] else np.nan
        assert found["settling_time"][row] == pytest.approx(expected, nan_ok=True)
        assert found["limited_samples"][row] == limited[:-1].sum()


@pytest.mark.slow
def test_gains_vary_by_row():
    control = {"mode": "pd", "period": 0.01, "bandwidth": 30.0}
    vary = {"control.bandwidth": [20.0, 40.0], "control.damping_ratio": [0.7, 1.0]}
    both = run_study(
        SweepStudy(SCENE, vary, control=control, steps=400, duration=1.0), None
    )
    alone = SweepStudy(
        SCENE, {"star.mass": [2.6]}, steps=400, duration=1.0,
        control=control | {"bandwidth": 40.0, "damping_ratio": 0.7},
    )  # fmt: skip
    expected = run_study(alone, None)
    assert both["control.bandwidth"].tolist() == [20.0, 20.0, 40.0, 40.0]
    assert both["error_max_1"][2] == pytest.approx(
        expected["error_max_1"][0], rel=1e-12
    )
    assert both["error_max_1"][0] > 1.5 * both["error_max_1"][2]


def test_noise_is_normal_and_depends_on_row_counter_and_seed():
    rows = np.arange(20_000)
    drawn = gaussian(3, rows, 5)
    assert stats.kstest(drawn, "norm").pvalue > 1e-3
    others = gaussian(3, rows, 6), gaussian(4, rows, 5), gaussian(3, rows + 1, 5)
    for other in others:
        assert abs(np.corrcoef(drawn[:-1], other[:-1])[0, 1]) < 0.03
    assert np.array_equal(others[2][:-1], drawn[1:])


@pytest.mark.parametrize(
    ("period", "message"),
    [
        (0.3, r"= 1\.0: must be a whole number of control periods"),
        (0.1, "steps = 25: must be a multiple of 10, the control periods"),
    ],
)
def test_a_duration_or_steps_of_no_whole_periods_are_refused(period, message):
    study = SweepStudy(
        SCENE, VARY, n=2, control={"period": period}, duration=1.0, steps=25
    )
    with pytest.raises(InputError, match=message):
        PreparedSweep(study)


@pytest.mark.slow
def test_when_a_controlled_run_leaves_is_independent_of_steps():
    rates = [[rate, 0.0, 0.0] for rate in (0.0, 12.0, 20.0, -20.0)]
    control = {"mode": "gravity_pd", "bandwidth": 5.0, "period": 0.01, "delay": 1}
    coarse, fine = (
        sweep("reach", {"initial.gamma_dot": rates}, duration=0.1, control=control,
              steps=steps, outputs=("gamma", "extremes"))
        for steps in (40, 160)
    )  # fmt: skip
    assert np.all(coarse["gamma_max_1"] >= coarse["gamma_1"])
    assert coarse["reason"].tolist() == fine["reason"].tolist()
    assert coarse["status"].tolist() == [0, 1, 1, 1]
    np.testing.assert_allclose(
        coarse["fault_time"], fine["fault_time"], rtol=0.0, atol=1e-8
    )
