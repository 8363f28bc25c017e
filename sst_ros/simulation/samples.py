# SPDX-License-Identifier: Apache-2.0
"""Samples of a motion: times and states, noted as it runs, computed at its end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sst_ros.dynamics.traced_dynamics import STATE_SIZE
from sst_ros.integration.function_steps import TimeSteps
from sst_ros.integration.method_steps import MethodSteps
from sst_ros.integration.point import Step
from sst_ros.integration.stepper import Stepper
from sst_ros.scene.torque_profile import Torque
from sst_ros.state import LAGGED_TORQUES, QUATERNION, STAR, STAR_RATE, Array


class SampleTable(NamedTuple):
    """Samples as arrays, n of them."""

    t: Array  # times [s], shape (n,)
    quaternion: Array  # (n, 4)
    body_rate: Array  # [rad/s], (n, 3)
    torque: Array  # that acts at the actuators [N m], (n, 3)
    joints: Array  # nine angles [rad] and nine rates [rad/s], (n, 18)


class _Run(NamedTuple):
    """Consecutive samples inside one step.

    Each state is one shorter step from its begin.
    """

    first: int  # number of the first sample
    step: Step
    begin: float  # time at which the step begins [s]
    number: int  # of samples


class Samples:
    """Samples of a motion of a stepper.

    Those inside of steps are computed together, by the program of a step over rows.

    Attributes:
        evaluations: that this takes; they are no part of a motion's budget, as they
            have a bound.

    """

    def __init__(self, stepper: Stepper) -> None:
        self._stepper = stepper
        self._times: list[float] = []
        self._torques: list[tuple[int, Torque]] = []  # each from its sample on
        self._states: list[tuple[int, Sequence[float]]] = []
        self._runs: list[_Run] = []
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
        """Note times [s] that lie inside a step which begins at `begin` [s].

        Raises BudgetSpent where the torque is a function, which is called for each.
        """
        if self._times and self._times[-1] >= times[0]:
            return
        if isinstance(step.steps, (MethodSteps, TimeSteps)):
            self.evaluations += len(times) * step.steps.cost
            self._runs.append(_Run(len(self._times), step, begin, len(times)))
            self._note(times, torque)
            return
        for time in times:
            self._stepper.budget.charge(step.steps.cost)
            self.add(time, torque, step.inside(time - begin))

    def _note(self, times: Sequence[float], torque: Torque) -> None:
        if not self._torques or self._torques[-1][1] is not torque:
            self._torques.append((len(self._times), torque))
        self._times += times

    def table(self) -> SampleTable:
        """Compute all samples."""
        t = np.array(self._times)
        states = np.empty((len(t), len(self._stepper.ode.state)))
        if self._states:
            rows, noted_states = zip(*self._states, strict=True)
            states[list(rows)] = noted_states
        self._step_to(t, states)
        joints = self._stepper.dynamics.joints_of_rows(states[:, STAR])
        torque = self._torque_at(t, states, joints)
        return SampleTable(
            t, states[:, QUATERNION], states[:, STAR_RATE], torque, joints
        )

    def _step_to(self, t: Array, states: Array) -> None:
        """Fill in the states inside of steps."""
        by_steps: dict[int, list[_Run]] = {}
        for run in self._runs:
            by_steps.setdefault(id(run.step.steps), []).append(run)
        for runs in by_steps.values():
            taken = [run.step for run in runs]
            counts = [run.number for run in runs]
            before = np.cumsum([0, *counts[:-1]])
            offsets = np.array([run.first for run in runs]) - before
            numbers = np.arange(sum(counts)) + offsets.repeat(counts)
            x = t[numbers] - np.array([run.begin for run in runs]).repeat(counts)
            states[numbers] = taken[0].steps.states_inside(taken, counts, x)

    def _torque_at(self, t: Array, states: Array, joints: Array) -> Array:
        """Return the torques that act, shape (n, 3)."""
        # the actuators lag: they are part of the state
        if states.shape[1] > STATE_SIZE + 1:
            return states[:, LAGGED_TORQUES]
        torques = np.empty((len(t), 3))
        applied = self._stepper.torque
        ends = [first for first, _ in self._torques[1:]]
        for (first, torque), end in zip(self._torques, [*ends, len(t)], strict=True):
            if isinstance(torque, tuple):
                torques[first:end] = torque
            elif torque.feedback:
                span = slice(first, end)
                rows = (array[span].tolist() for array in (t, states, joints))
                torques[span] = [
                    applied.of_state(torque, time, state, angles)
                    for time, state, angles in zip(*rows, strict=True)
                ]
            elif self._stepper.traced_sine(torque) is not None:
                torques[first:end] = torque.values(t[first:end])
            else:
                torques[first:end] = applied.at_times(torque, t[first:end].tolist())
        return torques
