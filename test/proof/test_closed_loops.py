# SPDX-License-Identifier: Apache-2.0
"""Sampled loops lie inside of their proven tubes: by mpmath, and by runs with noise."""

import numpy as np
import pytest
from mpmath import mp, mpf
from slow_cases import slow_except

from sst_ros import (
    Controller,
    ControllerSettings,
    InputError,
    certify,
    load_scene,
    reference_motion,
    simulate,
)
from sst_ros.__main__ import main
from sst_ros.control.controller import Measurement
from sst_ros.control.law import MODES
from sst_ros.proof import balls, closed_loop, enclosure
from sst_ros.proof.balls import arb
from studies.sixty_digits import Motion

PERIOD, END = 5e-3, 0.015
OF_RUN = 2e-11  # error of runs at a tolerance of 1e-12 [rad]


def controller(scene, **settings):
    return Controller(
        scene, reference_motion(scene), ControllerSettings(**settings), PERIOD
    )


def prove(scene, loop, **options):
    given = {"control_period": PERIOD, "bound": 1e-4, "t_eval": [END]}
    return certify(scene, loop, END, **given, **options)


class Noisy:
    """A controller whose measurements are off by any numbers within the noise."""

    def __init__(self, loop, noise, seed):
        self.loop, self.noise = loop, noise
        self.random = np.random.default_rng(seed)
        self.errors = []

    def __call__(self, time, state):
        signs = self.random.choice((-1.0, 1.0), (2, 3))
        joints = state.joints
        desired = self.loop.desire(time)[0].gamma
        self.errors.append((time, np.subtract(desired, joints.gamma)))
        angles = joints.gamma + signs[0] * self.noise[0]
        rates = joints.gamma_dot + signs[1] * self.noise[1]
        measured = Measurement(tuple(angles.tolist()), tuple(rates.tolist()))
        return self.loop.command(time, measured).torque


def ratios(proven, plant, loop, noise, seed):
    """Tracking errors of a run from the middle of the tube, over its bounds."""
    loop.reset()
    run = Noisy(loop, noise, seed)
    simulate(plant, run, END, control_period=PERIOD, tolerance=1e-12, t_eval=[END])
    table = proven.tracking
    worst = 0.0
    for row, (time, error) in enumerate(run.errors):
        assert table["t"][row] == time
        for leg in range(3):
            off = abs(error[leg] - table[f"error_{leg + 1}"][row])
            bound = table[f"error_{leg + 1}_bound"][row]
            worst = max(worst, (off - OF_RUN) / bound)
    return worst


CASES = [{"mode": mode} for mode in MODES]
CASES += [
    {"mode": "computed_torque", "space": "so3"},
    {"mode": "pd", "integral_rate": 5.0},
    {"mode": "computed_torque", "integral_rate": 5.0},
    {"mode": "feedforward_pd", "feedforward_at": "middle"},
    {"mode": "pd", "integral_rate": 5.0, "torque_limit": 0.02},
]
QUICK = [CASES[-1]]


@pytest.mark.parametrize("settings", slow_except(QUICK, CASES), ids=str)
def test_runs_with_noise_and_another_plant_stay_in_the_tube(settings):
    scene, noise = load_scene("reach"), (1e-6, 1e-4)
    loop = controller(scene, **settings)
    ranges = {"star.inertia.zz": 1e-3, "star.mass": 0.01}
    proven = prove(scene, loop, noise=noise, ranges=ranges)
    assert not proven.reason and len(proven.tracking["t"]) == 4
    found = []
    for seed, sign in enumerate((1.0, -1.0, 1.0, -1.0)):
        values = {
            "star.inertia.zz": scene.star.inertia.zz + sign * 1e-3,
            "star.mass": scene.star.mass - sign * 0.01,
        }
        plant = scene.with_values(values)
        found.append(ratios(proven, plant, loop, noise, seed))
    assert max(found) <= 1.0
    if settings["mode"] != "feedforward":
        assert max(found) > 0.2  # not wider than needed by much


@pytest.mark.slow
def test_a_loop_of_60_digits_lies_inside():
    scene = load_scene("reach")
    loop = controller(scene, mode="pd")
    proven, motion = prove(scene, loop), Motion(scene, (0.0, 0.0, 0.0))
    scheme = loop.law_with(None, None)
    table = proven.tracking
    for row, time in enumerate(table["t"]):
        with mp.workdps(40):
            joints = motion.joints(motion.at(float(time)))
            gamma, rates = joints[:3], joints[9:12]
            desired = loop.desire(float(time))[0]
            torque = []
            for leg in range(3):
                error = mpf(desired.gamma[leg]) - gamma[leg]
                error_rate = mpf(desired.gamma_dot[leg]) - rates[leg]
                feedback = (
                    mpf(scheme.kp[leg]) * error + mpf(scheme.kd[leg]) * error_rate
                )
                torque.append(mpf(scheme.inertia[leg]) * feedback)
                for name, true in (("error", error), ("torque", torque[leg])):
                    off = abs(true - mpf(table[f"{name}_{leg + 1}"][row]))
                    assert off <= mpf(table[f"{name}_{leg + 1}_bound"][row])
                    assert table[f"{name}_{leg + 1}_bound"][row] < 1e-9
            motion.torque = tuple(torque)


@pytest.mark.slow
def test_a_wrong_slope_of_the_law_misses_a_run(monkeypatch):
    scene = load_scene("reach")
    loop, noise = controller(scene, mode="pd"), (1e-6, 1e-4)
    answer = closed_loop.SampledLoop._answer

    def without_noise(self, *given):
        response = answer(self, *given)
        return response._replace(
            by_noise=[[x / 4 for x in r] for r in response.by_noise]
        )

    assert ratios(prove(scene, loop, noise=noise), scene, loop, noise, 1) <= 1.0
    monkeypatch.setattr(closed_loop.SampledLoop, "_answer", without_noise)
    assert ratios(prove(scene, loop, noise=noise), scene, loop, noise, 1) > 1.0


def test_a_jump_in_a_set_is_one_at_its_middle_too():
    record = enclosure.SideRecord()
    with balls.precision():
        with record.within(replay=False):
            assert enclosure._step(arb(0.1, 0.2)).contains(arb(1))
            assert enclosure._step(arb(0)) == 0
        with record.within(replay=True):
            assert enclosure._step(arb(0.1)).contains(arb(0))
            assert enclosure._step(arb(0)) == 0


@pytest.mark.parametrize(
    "vector", [(0.0, 0.0, 0.0), (1e-9, -2e-9, 3e-9), (0.3, 0.1, -0.2)]
)
def test_the_vector_of_a_small_turn_is_enclosed(vector):
    with balls.precision():
        q = tuple(map(arb, (*vector, 0.9)))
        found = closed_loop.turn_near_zero(q, arb(0, 1))
        with mp.workdps(40):
            v = list(map(mpf, vector))
            sine = mp.sqrt(sum(x * x for x in v))
            factor = 2 * mp.atan2(sine, mpf(0.9)) / sine if sine else 2 / mpf(0.9)
            for x, ball in zip(v, found, strict=True):
                off = abs(mpf(arb(ball).mid().str(38, radius=False)) - factor * x)
                assert off <= mpf(balls.upper(arb(ball).rad())) + mpf(10) ** -36
                assert balls.upper(arb(ball).rad()) < 1e-15


def test_the_command_proves_a_loop_and_writes_its_tube(tmp_path, capsys):
    out = tmp_path / "tube.csv"
    given = ["certify", "reach", "--duration", "0.02", "--bound", "1e-3"]
    given += ["--control", "pd", "--gain", "bandwidth=40", "integral_rate=3"]
    given += ["--control-period", "5e-3", "--noise", "1e-6", "1e-4"]
    given += ["--range", "star.mass=0.01", "star.inertia.zz=0.207..0.209"]
    assert main([*given, "--tracking", str(out)]) == 0
    said = capsys.readouterr().out
    line = next(line for line in said.splitlines() if "tracking error" in line)
    rows = np.genfromtxt(out, delimiter=",", names=True)
    most = max(
        (abs(rows[f"error_{leg}"]) + rows[f"error_{leg}_bound"]).max()
        for leg in (1, 2, 3)
    )
    assert most * (1.0 - 1e-15) <= float(line.split()[-5]) < 1.2 * most


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"noise": (-1e-6, 0.0), "control_period": PERIOD}, "half-widths >= 0"),
        ({"noise": (1e-6, 0.0)}, "control_period"),
    ],
)
def test_what_is_no_sampled_loop_is_refused(options, word):
    scene = load_scene("reach")
    with pytest.raises(InputError, match=word):
        certify(scene, controller(scene, mode="pd"), 0.01, **options)


def test_noise_needs_a_controller():
    with pytest.raises(InputError, match="Controller measures"):
        certify("reach", duration=0.01, noise=(1e-6, 0.0))
