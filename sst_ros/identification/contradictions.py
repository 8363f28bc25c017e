# SPDX-License-Identifier: Apache-2.0
"""Measured data that contradict themselves: jumps, other units, wrong signs or legs.

A wrong sign or unit need not show in the residuals: negated torques are fitted as well
as the right ones, by bodies of negative inertia. What shows it is physics:

- An encoder does not jump between two samples and move slowly beside them.
- Measured rates are the derivatives of the measured angles.
- The kinetic energy is positive, and about that of the given scene.
- Where no bodies fit the torques, but bodies fit them after one sign is changed or
  columns are exchanged, that sign or order was wrong.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.signal import detrend

from sst_ros.errors import refusal
from sst_ros.identification.measured_motion import MeasuredMotion
from sst_ros.mechanism.geometry import Array

JUMP = 0.02  # least step of an encoder between two samples that may be a fault [rad]
# Times the median rate of the samples around it from which such a step is one.
ABRUPT = 20.0
WINDOW = 9  # intervals of that median
MOST_TRAVEL = np.pi  # range of an angle [rad] that no leg of a manipulator has
# Share of the change of an angle by which the integral of its rate may be off. Noise
# and offsets of rates stay far below, other units and legs do not.
RATE_SHARE = 0.25
LEAST_TRAVEL = 1e-3  # range of an angle [rad] below which its rate is not checked
CERTAIN = 5.0  # standard deviations
LEAST_ENERGY = 0.1  # share of the scene's kinetic energy that is more than none
STRANGE = 30.0  # ratio of energies from which the units are worth a look
IMPOSSIBLE = 1e5  # ratio of energies that another unit makes: milliseconds make 1e6
OPPOSED = -0.8  # correlation of measured torques and those of the scene


class Relabelling(NamedTuple):
    """Torques of other legs, or with another sign.

    Columns are counted from 1, as in [1, -2, 3]; a negative one changes its sign.
    """

    columns: list[int]

    def apply(self, torque: Array) -> Array:
        """Return the torques [N m] in this order and with these signs, shape (n, 3)."""
        places = [abs(column) - 1 for column in self.columns]
        return np.asarray(torque[:, places] * np.sign(self.columns))


RELABELLINGS = (
    Relabelling([-1, 2, 3]),
    Relabelling([1, -2, 3]),
    Relabelling([1, 2, -3]),
    Relabelling([2, 1, 3]),
    Relabelling([1, 3, 2]),
    Relabelling([3, 2, 1]),
    Relabelling([2, 3, 1]),
    Relabelling([3, 1, 2]),
)
"""What is easily mistaken: the sign of a leg, or the order of the legs."""


def check_angles(motion: MeasuredMotion) -> list[str]:
    """Return notes on strange columns of a motion whose wraps are taken out.

    Raises InputError, which names the row, where an angle jumps, and where angles are
    not in radians or rates are not those of the angles.
    """
    travel = np.ptp(motion.gamma, axis=0)
    leg = int(np.argmax(travel))
    if travel[leg] > MOST_TRAVEL:
        requirement = f"must be less than {MOST_TRAVEL:.3g} rad: angles are in radians"
        key = f"range of gamma_{leg + 1}"
        raise refusal("identify", key, float(travel[leg]), requirement)
    _refuse_jumps(motion)
    if motion.gamma_dot is not None:
        _refuse_other_rates(motion, motion.gamma_dot)
    notes = []
    for name, values in (("gamma", motion.gamma), ("torque", motion.torque)):
        constant = np.ptp(values, axis=0) == 0.0
        if constant.all():
            continue
        for k in np.flatnonzero(constant).tolist():
            notes.append(
                f"{name}_{k + 1} is {values[0, k]:g} in each sample: is it measured?"
            )
    return notes


def _refuse_jumps(motion: MeasuredMotion) -> None:
    """Raise InputError where an angle steps while its neighbours move slowly."""
    steps = np.diff(motion.gamma, axis=0)
    if len(steps) < WINDOW:
        return
    rates = np.abs(steps) / np.diff(motion.t)[:, None]
    half = WINDOW // 2
    padded = np.pad(rates, ((half, half), (0, 0)), mode="reflect")
    usual = np.median(sliding_window_view(padded, WINDOW, axis=0), axis=-1)
    jumps = np.argwhere((np.abs(steps) > JUMP) & (rates > ABRUPT * usual))
    if len(jumps):
        row, leg = jumps[0].tolist()
        requirement = (
            f"jumps by {steps[row, leg]:+.3f} rad at row {row + 1}, between samples "
            "that move slowly: must be without faults of the encoder"
        )
        angle = float(motion.gamma[row + 1, leg])
        raise refusal("identify", f"gamma_{leg + 1}", angle, requirement)


def _refuse_other_rates(motion: MeasuredMotion, rates: Array) -> None:
    """Raise InputError where rates are not the derivatives of the angles by t."""
    steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(motion.t)[:, None]
    travelled = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    # A constant error of a rate is an offset of its sensor: it is let pass.
    by_rates = detrend(travelled, axis=0)
    by_angles = detrend(motion.gamma, axis=0)
    for k in range(3):
        integral = by_rates[:, k]
        angle = by_angles[:, k]
        off = np.linalg.norm(integral - angle)
        size = max(np.linalg.norm(integral), np.linalg.norm(angle))
        range_by_rates = float(np.ptp(integral))
        range_by_angles = float(np.ptp(angle))
        moves = max(range_by_rates, range_by_angles) > LEAST_TRAVEL
        if moves and off > RATE_SHARE * size:
            requirement = (
                f"must be that of gamma_{k + 1}, {range_by_angles:.3g} rad, and alike: "
                "rates are in rad/s, times in s"
            )
            key = f"range of the integral of gamma_dot_{k + 1}"
            raise refusal("identify", key, range_by_rates, requirement)


def check_energy(energy: float, deviation: float, expected: float) -> list[str]:
    """Compare the kinetic energy [J] by the estimates with that of the given scene.

    Returns a note where they are far apart. Raises InputError where the energy is
    negative, or is another by so much that t or the torques are in other units.
    """
    if expected <= 0.0:
        return []
    most = energy + CERTAIN * deviation
    if most < -LEAST_ENERGY * expected:
        requirement = (
            "must be > 0 J: the torques give bodies of negative inertia, so that the "
            "signs of torque and gamma contradict each other"
        )
        raise refusal("identify", "mean kinetic energy", energy, requirement)
    least = energy - CERTAIN * deviation
    ratio = energy / expected
    if least > IMPOSSIBLE * expected or most < expected / IMPOSSIBLE:
        requirement = "must be about 1: t is in s, torque in N m"
        raise refusal("identify", "inertia over that of the scene", ratio, requirement)
    if least > STRANGE * expected or most < expected / STRANGE:
        return [
            f"bodies have {ratio:.2g} times the inertia of the scene: is t in s, and "
            "torque in N m?"
        ]
    return []
