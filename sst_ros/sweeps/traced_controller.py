# SPDX-License-Identifier: Apache-2.0
"""The schemes of `control.controller` as traced code: a torque for each sample, without branches.

The controller is a function of the sampled state and of a memory: the integral, the queue of
delayed commands, the last encoder angles, the observed orientation, and sums of tracking errors.
What the scheme does not use has no operation.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from sst_ros.control.actuator_space import ActuatorSpaceMap
from sst_ros.control.inverse_dynamics import InverseDynamics
from sst_ros.control.reference import REST
from sst_ros.dynamics import kernel
from sst_ros.dynamics.expression import Expression
from sst_ros.mechanism.generic_math import (
    ZERO,
    add,
    atan2,
    axpy,
    cross,
    dot,
    positive,
    quaternion_product,
    rotation_rows,
    sin,
    sqrt,
)
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.sweeps.sweep_study import ControlledRun

NEWTON_STEPS = 5
"""Of the observer at a sample. They square the error; from one sample to the next it is small."""

_ROUND = 1.5 * 2.0**52
"""Added and subtracted, it rounds to whole numbers, halves to even."""

REFERENCES = (
    ("first", 1), ("gamma", 3), ("gamma_dot", 3), ("gamma_ddot", 3), ("feedforward", 3),
    ("held_feedforward", 3), ("quaternion", 4), ("body_rate", 3), ("body_acceleration", 3),
)  # fmt: skip

"""Names and sizes of what a sample is given."""

GAINS = (
    ("kp", 3), ("kd", 3), ("inertia", 3), ("integral_rate", 1), ("limit", 1), ("plant_limit", 1),
    ("angle_noise", 1), ("rate_noise", 1),
)  # fmt: skip

Group = dict[str, Any]
"""Tuples of numbers by name."""


def tabulate_references(loop: ControlledRun, samples: int) -> Array:
    """Return the references of samples 0 to `samples`, shape (samples + 1, n)."""
    inverse, period = InverseDynamics(loop.model), loop.channel.period
    feeding = loop.settings.mode not in ("pd", "gravity_pd")
    middle = loop.settings.feedforward_at == "middle"
    rows = []
    for k in range(samples + 1):
        time = k * round(period * 1e9) / 1e9
        at = loop.motion.at(time)
        torque = inverse.reference_torque(at) if feeding else REST
        held = torque
        if feeding and middle:
            held = inverse.reference_torque(loop.motion.at(time + 0.5 * period))
        joints = (*at.gamma, *at.gamma_dot, *at.gamma_ddot)
        star = (*at.quaternion, *at.body_rate, *at.body_acceleration)
        rows.append((float(k == 0), *joints, *torque, *held, *star))
    return np.array(rows)


def divide(names: Sequence[tuple[str, int]], numbers: Sequence[Any]) -> Group:
    """Divide numbers into groups of the sizes given."""
    found, at = {}, 0
    for name, size in names:
        found[name] = tuple(numbers[at : at + size])
        at += size
    return found


class _Sample(NamedTuple):
    """What the controller has at a sample: references, measurement, errors, memory, gains."""

    given: Group
    gamma: Any
    gamma_dot: Any
    error: Any
    rates: Any
    observed: Any
    memory: Group
    gains: Group


class TracedController(NamedTuple):
    """A control loop's controller and channel, as a function of expressions.

    Attributes:
        loop: settings and motion.
        limited: whether torques have a limit.
        memory: names and numbers of what it remembers.

    """

    loop: ControlledRun
    limited: bool
    memory: tuple[tuple[str, int], ...]

    def __call__(
        self,
        model: kernel.Model,
        state: Sequence[Any],
        given: Group,
        memory: Group,
        gains: Group,
        noise: Sequence[Any],
    ) -> tuple[Any, ...]:
        """Return three torques and the new memory.

        Args:
            model: constants of the plant, for its encoders.
            state: of the plant.
            given: the references of the sample, by the names in REFERENCES.
            memory: by the names in `memory`.
            gains: by the names in GAINS.
            noise: six standard normal numbers, or none.

        """
        joints = kernel.joints(model, tuple(state))
        true = _tuple(joints.gamma)
        gamma, gamma_dot, before = self._measure(
            true, _tuple(joints.gamma_dot), memory, gains, noise
        )
        error = axpy(1.0, given["gamma"], -1.0, gamma)
        rates = axpy(1.0, given["gamma_dot"], -1.0, gamma_dot)
        observed = self._observe(gamma, memory)
        command, limited, integral = self._command(
            _Sample(given, gamma, gamma_dot, error, rates, observed, memory, gains)
        )
        queue = memory.get("queue", ())
        first = given["first"][0]
        if queue:  # until the first command arrives it acts already
            commands = command * (len(queue) // 3)
            pairs = zip(queue, commands, strict=True)
            filled = [first * c + (1.0 - first) * q for q, c in pairs]
            torque, queue = _tuple(filled[:3]), (*filled[3:], *command)
        else:
            torque = command
        if self.limited:
            torque = _tuple(_clamp(tau, gains["plant_limit"][0]) for tau in torque)
        off = axpy(1.0, given["gamma"], -1.0, true)
        new: Group = {
            "integral": integral,
            "queue": tuple(queue),
            "before": before,
            "observed": observed,
            "squares": tuple(s + e * e for s, e in zip(memory["squares"], off, strict=True)),
            "largest": tuple(
                s + positive(_size(e) - s) for s, e in zip(memory["largest"], off, strict=True)
            ),
            "limited": (memory["limited"][0] + limited,),
        }
        return (*torque, *(number for name, _ in self.memory for number in new[name]))

    def _measure(
        self, gamma: Any, gamma_dot: Any, memory: Group, gains: Group, noise: Sequence[Any]
    ) -> tuple[Any, Any, Any]:
        """Angles and rates that the controller receives, and counted angles to remember."""
        channel, before = self.loop.channel, ()
        if channel.counts:
            step = 2.0 * math.pi / channel.counts
            gamma = before = _tuple(step * ((angle / step + _ROUND) - _ROUND) for angle in gamma)
            pairs = zip(gamma, memory["before"], strict=True)
            gamma_dot = _tuple((x - y) / channel.period for x, y in pairs)
        if noise:
            angle, rate = gains["angle_noise"][0], gains["rate_noise"][0]
            gamma = _tuple(x + n * angle for x, n in zip(gamma, noise[:3], strict=True))
            gamma_dot = _tuple(x + n * rate for x, n in zip(gamma_dot, noise[3:], strict=True))
        return gamma, gamma_dot, before

    def _observe(self, gamma: Any, memory: Group) -> tuple[Any, ...]:
        """Quaternion at the measured angles in the last assembly mode; none if not needed."""
        if not memory["observed"]:
            return ()
        geometry = Geometry.of(self.loop.model)
        space = ActuatorSpaceMap(geometry)
        across = np.cross(geometry.w, geometry.v)
        carriages: list[Any] = []
        for k, angle in enumerate(gamma):
            c, s = angle.apply("cos"), sin(angle)
            pairs = zip(geometry.v[k].tolist(), across[k].tolist(), strict=True)
            carriages += [c * x + s * y for x, y in pairs]
        q: tuple[Any, ...] = memory["observed"]
        for _ in range(NEWTON_STEPS):
            q = space.newton_step(*q, *carriages)[:4]
        return q

    def _command(self, at: _Sample) -> tuple[Any, Any, Any]:
        """Return the limited command, whether it was limited, and the new integral."""
        settings, mode = self.loop.settings, self.loop.settings.mode
        feedforward, feedback, summed = ZERO, ZERO, ZERO
        model = kernel.model_of(self.loop.model)
        if mode == "gravity_pd":
            feedforward, _ = kernel.actuator_torque(model, at.observed, REST, REST)
        elif mode != "pd":
            feedforward = at.given["feedforward"]
        if mode == "computed_torque":
            total, summed = self._compute_torque(model, at)
            feedback = axpy(1.0, total, -1.0, feedforward)
        elif mode != "feedforward":
            acceleration, summed = _feedback(at.error, at.rates, at)
            feedback = _tuple(m * a for m, a in zip(at.gains["inertia"], acceleration, strict=True))
        if settings.feedforward_at == "middle" and mode not in ("pd", "gravity_pd"):
            feedforward = at.given["held_feedforward"]
        total = add(feedforward, feedback)
        torque, limited, free = total, 0.0, 1.0
        if self.limited:
            torque = _tuple(_clamp(tau, at.gains["limit"][0]) for tau in total)
            cut = axpy(1.0, total, -1.0, torque)
            free = 1.0 - _is_above(dot(cut, at.error))
            limited = _is_above(dot(cut, cut))
        rate = free * self.loop.channel.period
        integral = at.memory.get("integral", ())
        if integral:
            integral = tuple(s + rate * x for s, x in zip(integral, summed, strict=True))
        return torque, limited, integral

    def _compute_torque(self, model: kernel.Model, at: _Sample) -> tuple[Any, Any]:
        """Torque of computed_torque, and the error to integrate."""
        acceleration, summed = _feedback(at.error, at.rates, at)
        asked = add(at.given["gamma_ddot"], acceleration)
        space = ActuatorSpaceMap(Geometry.of(self.loop.model))
        now = space.star_accelerations(*at.observed, *at.gamma_dot, *asked)
        body_rate, body_acceleration = _tuple(now[:3]), _tuple(now[3:])
        if self.loop.settings.space == "so3":
            x, y, z, w = at.observed
            between = quaternion_product((-x, -y, -z, w), at.given["quaternion"])
            turn = rotation_rows(between)
            rate, forward = (
                _tuple(dot(row, at.given[name]) for row in turn)
                for name in ("body_rate", "body_acceleration")
            )
            moving = axpy(1.0, forward, -1.0, cross(body_rate, rate))
            summed = _rotation_vector(between)
            slope = axpy(1.0, rate, -1.0, body_rate)
            acceleration, summed = _feedback(summed, slope, at)
            body_acceleration = add(moving, acceleration)
        torque, _ = kernel.actuator_torque(model, at.observed, body_rate, body_acceleration)
        return torque, summed


def _feedback(error: Any, rates: Any, at: _Sample) -> tuple[Any, Any]:
    """Acceleration kp e + kd e_dot with integral action, and the error to integrate."""
    leaning, gains = error, at.gains
    if at.memory.get("integral"):
        leaning = axpy(1.0, error, gains["integral_rate"][0], at.memory["integral"])
    proportional = _tuple(k * e for k, e in zip(gains["kp"], leaning, strict=True))
    derivative = _tuple(k * e for k, e in zip(gains["kd"], rates, strict=True))
    return add(proportional, derivative), error


def _rotation_vector(q: tuple[Any, ...]) -> Any:
    """Axis times angle of a rotation of less than half a turn; as `rotation_vector`."""
    sign = 2.0 * _is_above(q[3]) - 1.0
    x, y, z, w = (sign * part for part in q)
    sine = sqrt(x * x + y * y + z * z + 1e-300)
    factor = 2.0 * atan2(sine, w) / sine
    return factor * x, factor * y, factor * z


def _clamp(value: Any, limit: Any) -> Any:
    return value - positive(value - limit) + positive(-limit - value)


def _size(value: Any) -> Any:
    return positive(value) + positive(-value)


def _is_above(value: Any) -> Any:
    """1 where a number is positive, else 0."""
    return value.apply("step") if isinstance(value, Expression) else float(value > 0.0)


def _tuple(values: Iterable[Any]) -> Any:
    return tuple(values)  # of any type: mypy knows no length of it
