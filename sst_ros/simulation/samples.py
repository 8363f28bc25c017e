# SPDX-License-Identifier: Apache-2.0
"""Samples of a motion: times and states that are noted as it runs, and computed at its end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sst_ros.integration.method_steps import MethodSteps
from sst_ros.integration.stepper import Step, Stepper
from sst_ros.scene.torque_profile import SineTorque, Torque
from sst_ros.state import Array

_STATE = 7
"""Numbers of a sample's state: quaternion and body rate."""


class SampleTable(NamedTuple):
    """Samples as arrays, n of them."""

    t: Array  # times [s], shape (n,)
    quaternion: Array  # (n, 4)
    body_rate: Array  # [rad/s], (n, 3)
    torque: Array  # that acts at the actuators [N m], (n, 3)
    joints: Array  # nine angles [rad] and nine rates [rad/s], (n, 18)


class _Inside(NamedTuple):
    """A sample inside a step: the state is one shorter step from its begin."""

    number: int
    step: Step
    x: float  # after the begin of the step [s]


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
        self._torques: list[Torque] = []
        self._states: list[Sequence[float]] = []
        self._inside: list[_Inside] = []
        self._no_state = (0.0,) * len(stepper.ode.state)
        self.evaluations = 0

    def add(self, time: float, torque: Torque, y: Sequence[float]) -> None:
        """Note a state at a time [s], unless the last sample is not earlier."""
        if self._times and self._times[-1] >= time:
            return
        self._times.append(time)
        self._torques.append(torque)
        self._states.append(y)

    def add_inside(self, time: float, torque: Torque, step: Step, x: float) -> None:
        """Note a time [s] that is x [s] after the begin of a step."""
        if self._times and self._times[-1] >= time:
            return
        if isinstance(step.steps, MethodSteps):
            self.evaluations += step.steps.cost
            self._inside.append(_Inside(len(self._times), step, x))
            self.add(time, torque, self._no_state)
        else:
            self._stepper.budget.charge(step.steps.cost)
            self.add(time, torque, step.inside(x))

    def table(self) -> SampleTable:
        """Compute all samples."""
        states = np.array(self._states).reshape(len(self._times), -1)
        self._step_to(states)
        joints = self._stepper.dynamics.joints_of_rows(states[:, :_STATE])
        t = np.array(self._times)
        torque = self._torque_at(t, states)
        return SampleTable(t, states[:, :4], states[:, 4:_STATE], torque, joints)

    def _step_to(self, states: Array) -> None:
        """Fill in the states inside of steps."""
        by_steps: dict[int, list[_Inside]] = {}
        for sample in self._inside:
            by_steps.setdefault(id(sample.step.steps), []).append(sample)
        for samples in by_steps.values():
            steps = samples[0].step.steps
            assert isinstance(steps, MethodSteps)
            rows = [
                (s.step.t, s.x, *s.step.begin.y, *s.step.drive.numbers) for s in samples
            ]
            states[[s.number for s in samples]] = steps.states_after(np.array(rows))

    def _torque_at(self, t: Array, states: Array) -> Array:
        """Return the torques that act, shape (n, 3)."""
        # the actuators lag: they are part of the state
        if states.shape[1] > _STATE + 1:
            return states[:, _STATE : _STATE + 3]
        times, rows = t.tolist(), list[Sequence[float]]()
        for time, torque, y in zip(times, self._torques, states.tolist(), strict=True):
            if isinstance(torque, SineTorque):
                rows.append(())
            elif callable(torque):
                rows.append(self._stepper.torque.at(torque, time, y))
            else:
                rows.append(torque)
        sines = [
            k
            for k, torque in enumerate(self._torques)
            if isinstance(torque, SineTorque)
        ]
        if sines:  # one, traced into the program
            values = self._torques[sines[0]].values(t[sines])  # type: ignore[union-attr]
            for k, row in zip(sines, values.tolist(), strict=True):
                rows[k] = row
        return np.array(rows).reshape(-1, 3)
