# SPDX-License-Identifier: Apache-2.0
"""Coverage of the intervals of identify(): many simulated data sets of one motion.

Each set has the angles and torques of the same six seconds, with noise of both, angles
that are late, and friction, from a seed of its own. In `coverage.csv` a set is a row:
what was estimated less the truth, in standard deviations. Sets that are there are not
computed again, so that the study goes on where it was ended.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import binomtest, norm

from sst_ros.control.controller import InverseDynamics
from sst_ros.control.reference_motions import reference_motion
from sst_ros.errors import require
from sst_ros.identification import parameters
from sst_ros.identification.identify import TorqueFit, identify
from sst_ros.mechanism.geometry import Array
from sst_ros.progress import slices
from sst_ros.report.results import data_frame, markdown
from sst_ros.scene.loads import DesiredMotion, Sweep
from sst_ros.scene.scene import load
from studies import DOCS, run

if TYPE_CHECKING:
    from pandas import DataFrame

PERIOD = 2e-3  # between samples [s]
DELAY = 3.7e-3  # of the angles [s]
ANGLE_NOISE = 1e-4  # standard deviation [rad]
TORQUE_NOISE = 0.01  # standard deviation over the largest torque of the actuator
FIRST_SEED = 5000  # not used while the estimator was made
CHUNK = 20  # sets between two writings
NORMAL_95 = float(norm.ppf(0.975))  # half width of an interval in deviations
CERTAINTY = 0.95  # of the interval of a share
FRICTION = {
    "friction.gamma.viscous": 0.2,
    "friction.gamma.coulomb": 0.2,
    "friction.gamma.smoothing": 0.1,
}
GUESSED = {"friction.gamma.viscous": 0.1, "friction.gamma.coulomb": 0.1}
INERTIA_GUESS = 0.8  # of the model that is identified from, over the plant's
CHIRP = Sweep(
    amplitude=(0.2, 0.25, 0.22),
    frequency=(3.0, 4.3, 5.1),
    last_frequency=(5.0, 3.1, 7.0),
    fade=0.5,
    duration=6.0,
)


class Plant:
    """Chirps of `reach` with friction: exact angles and torques at any time."""

    def __init__(self) -> None:
        rubbing = load("reach").with_values(FRICTION)
        motion = DesiredMotion(sweep=CHIRP)
        self.scene = replace(
            rubbing, motion=motion, torque=None, duration=CHIRP.duration
        )
        self.motion = reference_motion(self.scene)
        self._inverse = InverseDynamics(self.scene)
        links = ("star", "actuated_links", "intermediate_links")
        names = parameters.select_names(self.scene, links)
        guesses = INERTIA_GUESS * parameters.values(self.scene, names)
        model = parameters.with_parameters(self.scene, names, guesses, "a guess")
        self.model = model.with_values(GUESSED)

    def gamma(self, times: Array) -> Array:
        """Return the angles [rad], shape (n, 3); at rest before and after."""
        inside = np.clip(times, 0.0, self.motion.duration)
        return np.array([self.motion.at(t).gamma for t in inside.tolist()])

    def torque(self, times: Array) -> Array:
        """Return the torques of the actuators [N m], shape (n, 3)."""
        references = [self.motion.at(t) for t in times.tolist()]
        return np.array([self._inverse.reference_torque(x) for x in references])

    def errors(self, fit: TorqueFit) -> Array:
        """Return estimates less truth, in standard deviations."""
        true = fit.base.transform @ parameters.values(self.scene, fit.names)
        return np.asarray((fit.estimate - true) / fit.deviation)


@cache
def plant() -> Plant:
    """Return the plant of all sets."""
    return Plant()


@cache
def exact() -> tuple[Array, Array, Array]:
    """Return times [s], late angles [rad] and torques [N m] without noise."""
    t: Array = np.arange(0.0, plant().motion.duration - PERIOD, PERIOD)
    return t, plant().gamma(t - DELAY), plant().torque(t)


def measure(seed: int, t: Array | None = None) -> dict[str, Any]:
    """Return one data set, by default at the times of `exact`."""
    random = np.random.default_rng(seed)
    if t is None:
        t, gamma, torque = exact()
    else:
        gamma, torque = plant().gamma(t - DELAY), plant().torque(t)
    torque_noise = TORQUE_NOISE * np.abs(torque).max(axis=0)
    return {
        "t": t,
        "gamma": gamma + ANGLE_NOISE * random.normal(size=gamma.shape),
        "torque": torque + torque_noise * random.normal(size=torque.shape),
    }


def score(seed: int) -> dict[str, float]:
    """Identify one data set: errors in standard deviations, by base parameter."""
    fit = identify(measure(seed), plant().model)
    if not isinstance(fit, TorqueFit) or fit.delay_deviation is None:
        raise TypeError("a fit of torques with a delay is expected")
    chosen = [fit.names[index] for index in fit.base.chosen]
    scores = dict(zip(chosen, plant().errors(fit).tolist(), strict=True))
    return {
        "seed": seed,
        "delay": (fit.delay - DELAY) / fit.delay_deviation,
        **scores,
    }


def extend_table(path: Path, seeds: Sequence[int]) -> DataFrame:
    """Score the seeds that a table does not have yet, and write it chunk by chunk."""
    pandas = require("pandas")
    frame = pandas.read_csv(path) if path.exists() else data_frame([])
    done = set(frame["seed"].tolist()) if len(frame) else set()
    missing = [seed for seed in seeds if seed not in done]
    for chunk in slices(len(missing), CHUNK, "data sets", True):
        scores = data_frame([score(seed) for seed in missing[chunk]])
        frame = pandas.concat([frame, scores], ignore_index=True)
        frame.to_csv(path, index=False, float_format="%.4f")
    return frame


def summarise(frame: DataFrame) -> DataFrame:
    """Return the coverage of each estimate [%], with its 95 % interval, and of all.

    The interval is that of Clopper and Pearson. That of all is missing: the estimates
    of a set are correlated.
    """
    scores = frame.drop(columns="seed")
    covered = scores.abs() < NORMAL_95
    rows = []
    for name in scores.columns:
        count = int(covered[name].sum())
        interval = binomtest(count, len(frame)).proportion_ci(CERTAINTY)
        rows.append(
            {
                "estimate": name,
                "covered": f"{100.0 * count / len(frame):.1f}",
                "from": f"{100.0 * interval.low:.1f}",
                "to": f"{100.0 * interval.high:.1f}",
                "RMS error over deviation": f"{(scores[name] ** 2).mean() ** 0.5:.3f}",
            }
        )
    base = covered.drop(columns="delay").to_numpy()
    rows.append({"estimate": "all parameters", "covered": f"{100.0 * base.mean():.1f}"})
    return data_frame(rows)


def report(options: argparse.Namespace) -> bool:
    """Extend `coverage.csv`; true where 93 to 97 % of the truths are covered."""
    seeds = range(options.seed, options.seed + options.count)
    frame = extend_table(options.out / "coverage.csv", seeds)
    table = summarise(frame)
    print(f"{len(frame)} data sets\n\n{markdown(table)}")
    return 93.0 <= float(table["covered"].iloc[-1]) <= 97.0


if __name__ == "__main__":
    count = {"type": int, "default": 400, "help": "data sets"}
    seed = {"type": int, "default": FIRST_SEED, "help": "of the first data set"}
    raise SystemExit(run(report, "coverage", DOCS, None, count=count, seed=seed))
