# SPDX-License-Identifier: Apache-2.0
"""Samples of a motion: times and states, noted as it runs, computed at its end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sst_ros.dynamics.traced_dynamics import STATE_SIZE
from sst_ros.integration.point import Step
from sst_ros.integration.stepper import Stepper
from sst_ros.scene.torque_profile import Torque
from sst_ros.state import LAGGED_TORQUES, QUATERNION, STAR, STAR_RATE, Array, Vector3


class SampleTable(NamedTuple):
    """Samples as arrays, n of them."""

    t: Array  # times [s], shape (n,)
    quaternion: Array  # (n, 4)
    body_rate: Array  # [rad/s], (n, 3)
    torque: Array  # that acts at the actuators [N m], (n, 3)
    joints: Array  # nine angles [rad] and nine rates [rad/s], (n, 18)


class _StepSamples(NamedTuple):
    """Consecutive samples inside one step, each by one shorter step from its begin."""

    step: Step
    begin: float  # time at which the step begins [s]
    first: int  # place of the first sample among all
    number: int  # of samples


class Samples:
    """Samples of a motion of a stepper.

    Those inside of steps are computed together at the end, by a compiled step over
    rows.

    Attributes:
        evaluations: that this takes. A motion's budget does not have them: they do not
            grow without bound.

    """

    def __init__(self, stepper: Stepper) -> None:
        self._stepper = stepper
        self._times: list[float] = []
        self._torques: list[tuple[int, Torque]] = []  # each from its sample on
        self._states: list[tuple[int, Sequence[float]]] = []  # of some samples
        self._step_samples: list[_StepSamples] = []  # the others
        self.evaluations = 0

    def add(self, time: float, torque: Torque, y: Sequence[float]) -> None:
        """Note a state at a time [s], unless the last sample is not earlier."""
        if self._times and self._times[-1] >= time:
            return
        self._states.append((len(self._times), y))
        self._note((time,), torque)

    def add_inside(
        self, times: Sequence[float], torque: Torque, step: Step, begin: float
    ) -> None:
        """Note later times [s] inside a compiled step that begins at `begin` [s]."""
        if not times:
            return
        self.evaluations += len(times) * step.steps.cost
        first = len(self._times)
        self._step_samples.append(_StepSamples(step, begin, first, len(times)))
        self._note(times, torque)

    def _note(self, times: Sequence[float], torque: Torque) -> None:
        """Note times of samples, and the torque that acts at them."""
        if not self._torques or self._torques[-1][1] is not torque:
            self._torques.append((len(self._times), torque))
        self._times += times

    def table(self) -> SampleTable:
        """Compute all samples."""
        t = np.array(self._times)
        states = np.empty((len(t), len(self._stepper.ode.state)))
        if self._states:
            places, noted_states = zip(*self._states, strict=True)
            states[list(places)] = noted_states
        self._step_to(t, states)
        joints = self._stepper.dynamics.joints_of_rows(states[:, STAR])
        torque = self._torque_at(t, states, joints)
        return SampleTable(
            t, states[:, QUATERNION], states[:, STAR_RATE], torque, joints
        )

    def _step_to(self, t: Array, states: Array) -> None:
        """Fill in the states inside of steps."""
        groups: dict[int, list[_StepSamples]] = {}  # those of one program together
        for samples in self._step_samples:
            groups.setdefault(id(samples.step.steps), []).append(samples)
        for group in groups.values():
            steps, begins, firsts, counts = zip(*group, strict=True)
            # The samples of a step are consecutive, from its first one on.
            number = np.arange(sum(counts))
            skipped = np.subtract(firsts, np.cumsum(counts) - counts)
            places = number + np.repeat(skipped, counts)
            x = t[places] - np.repeat(begins, counts)
            states[places] = steps[0].steps.states_inside(steps, counts, x)

    def _torque_at(self, t: Array, states: Array, joints: Array) -> Array:
        """Return the torques that act, shape (n, 3)."""
        has_lag = states.shape[1] > STATE_SIZE + 1  # beside the star and the work
        if has_lag:
            return states[:, LAGGED_TORQUES]
        torques = np.empty((len(t), 3))
        end = len(t)
        for first, torque in reversed(self._torques):
            span = slice(first, end)
            torques[span] = self._evaluate(torque, t[span], states[span], joints[span])
            end = first
        return torques

    def _evaluate(
        self, torque: Torque, t: Array, states: Array, joints: Array
    ) -> Vector3 | Sequence[Vector3] | Array:
        """Return a torque at consecutive samples, or the one of all that is held."""
        if isinstance(torque, tuple):
            return torque
        if self._stepper.traced_sine(torque) is not None:
            return torque.values(t)
        times = t.tolist()
        applied = self._stepper.torque
        if not torque.feedback:
            return applied.at_times(torque, times)
        torques = []
        for time, y, angles in zip(
            times, states.tolist(), joints.tolist(), strict=True
        ):
            torques.append(applied.of_state(torque, time, y, angles))
        return torques
