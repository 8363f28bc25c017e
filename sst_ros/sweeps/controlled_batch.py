# SPDX-License-Identifier: Apache-2.0
"""A batch under feedback: the controller is compiled into the loop, and acts once a period."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.control.controller import Controller
from sst_ros.dynamics.expression import Expression, Program, trace
from sst_ros.errors import InputError, Problem
from sst_ros.integration import codegen
from sst_ros.integration.batch import Batch
from sst_ros.integration.batch_result import BatchResult
from sst_ros.integration.batch_run import integrated
from sst_ros.integration.batch_source import SIMD_WIDTH, SampledFeedback, batch_source
from sst_ros.integration.methods import DOP853
from sst_ros.mechanism.geometry import Array
from sst_ros.sweeps.sweep_study import ControlledRun
from sst_ros.sweeps.traced_controller import (
    GAINS,
    REFERENCES,
    TracedController,
    divide,
    tabulate_references,
)

NOISE = (
    """\
def mixed(x):
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
""",
    """\
def gaussian(seed, row, counter):
    step = np.uint64(0x9E3779B97F4A7C15)
    stream = mixed(mixed(np.uint64(seed) + step) + np.uint64(row) * step)
    first = mixed(stream + np.uint64(2 * counter + 1) * step)
    second = mixed(stream + np.uint64(2 * counter + 2) * step)
    u = (np.float64(first >> np.uint64(11)) + 0.5) * 1.1102230246251565e-16
    v = (np.float64(second >> np.uint64(11)) + 0.5) * 1.1102230246251565e-16
    return sqrt(-2.0 * np.log(u)) * cos(6.283185307179586 * v)
""",
)
"""Normal noise from a counter: number c of row i depends on the seed, i and c alone.

The bits are those of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014), started anew for each number;
a pair of them becomes a normal number by the method of Box and Muller (1958)."""


_NOISE = 6
_NEVER = 2**62
"""Steps from one sample to the next while torques are held."""


class ControlledBatch:
    """A batch whose torques come from a controller with zero-order hold.

    Args:
        batch: of the plants, without torques of their own.
        loop: controller, channel and motion.
        length: of a run [s], a whole number of control periods.
        seed: of the noise.
        varied: keys control.* that differ between scenarios.

    Attributes:
        samples: control periods in a run.

    Raises:
        InputError: the length is no whole number of periods, or the gains are not allowed.

    """

    def __init__(
        self, batch: Batch, loop: ControlledRun, length: float, seed: int, varied: set[str]
    ) -> None:
        self._batch, self._loop, self._seed = batch, loop, seed
        period = loop.channel.period
        self.samples = round(length / period)
        if not self.samples or abs(self.samples * period - length) > 1e-9 * length:
            allowed = f"must be a whole number of control periods of {period:g} s"
            raise InputError("sweep", [Problem("duration", length, allowed)])
        controller = Controller(loop.model, loop.motion, loop.settings, period)
        self._inertia = np.array(controller.inertia)
        own = bool(loop.settings.torque_limit) or "control.torque_limit" in varied
        limited = own or any(
            plant.actuators is not None and plant.actuators.torque_limit
            for plant in (loop.model, batch.scene)
        )
        self._noisy = bool(
            loop.channel.angle_noise
            or loop.channel.rate_noise
            or varied & {"control.angle_noise", "control.rate_noise"}
        )
        integral = loop.settings.integral_rate > 0.0 or "control.integral_rate" in varied
        observes = loop.settings.mode in ("gravity_pd", "computed_torque")
        sizes = {
            "integral": 3 * integral,
            "queue": 3 * loop.channel.delay,
            "before": 3 * (loop.channel.counts > 0),
            "observed": 4 * observes,
            "squares": 3,
            "largest": 3,
            "limited": 1,
        }
        memory = tuple((name, int(size)) for name, size in sizes.items())
        self._controller = TracedController(loop, limited, memory)

    @cached_property
    def module(self) -> ModuleType:
        """The compiled loop."""
        model = self._batch.model
        text = batch_source(
            model.program, model.limit_distances, DOP853, len(model.ode.state), self._feedback
        )
        texts = [*NOISE, text]
        return codegen.load(texts, {"NODES": DOP853.c}, numba=True, nogil=True)

    def run(
        self,
        batch: Batch,
        given: dict[str, Array],
        rows: NDArray[np.int64],
        steps: int,
        kept: int = 0,
    ) -> tuple[BatchResult, dict[str, Array]]:
        """Run scenarios.

        Args:
            batch: of the scenarios.
            given: initial states and gains that differ, by key.
            rows: numbers of the scenarios in their study, which the noise depends on.
            steps: number of steps, a multiple of `samples`.
            kept: keep the states every so many steps; 0 keeps none.

        Returns:
            The result, and the tracking figures.

        """
        count, hold = len(rows), steps // self.samples
        start = self._loop.motion.at(0.0)
        gamma = given.get("initial.gamma", np.tile(start.gamma, (count, 1)))
        rate = given.get("initial.gamma_dot", np.tile(start.gamma_dot, (count, 1)))
        step = self.samples * self._loop.channel.period / steps
        memory, gains = self._memory(gamma, rate, count), self._gains(batch, given, count)

        def advance(first: int, count: int, step: float, *arrays: Any, rows: Any) -> None:
            own: list[Any] = [memory, gains, numbers]
            held, begin = hold, first
            if rows is not None:  # torques are held while a step is repeated, whenever it was
                own = [np.ascontiguousarray(array[..., rows]) for array in own]
                held, begin = _NEVER, 1
            blocks = -(-arrays[0].shape[1] // SIMD_WIDTH)
            more = held, self._references, *own, self._seed
            self.module.batch(step, begin, count, 0, blocks, *arrays, *more)
            if rows is not None:
                arrays[3][:] += (first - begin) * step

        numbers = rows.astype(np.int64)
        result = integrated(
            batch.model,
            batch.columns,
            batch.start(gamma, rate),
            batch.drives((0.0, 0.0, 0.0), count),
            advance,
            step=step,
            count=steps,
            keep_every=kept,
        )
        return result, self._tracking(result, memory, result.t)

    def _tracking(self, result: BatchResult, memory: Array, last: Array) -> dict[str, Array]:
        """Root of the mean square and largest error of gamma [rad] at the samples of a run."""
        found = divide(self._controller.memory, list(memory))
        final = self._references[-1, 1:4] - result.gamma
        complete = (result.code == 0)[:, None]
        squares = np.stack(found["squares"], axis=1) + np.where(complete, final**2, 0.0)
        largest = np.stack(found["largest"], axis=1)
        largest = np.where(complete, np.maximum(largest, np.abs(final)), largest)
        samples = np.floor(last / self._loop.channel.period + 1e-9) + 1
        rms = np.sqrt(squares / samples[:, None])
        columns = {f"error_rms_{k + 1}": rms[:, k].copy() for k in range(3)}
        columns |= {f"error_max_{k + 1}": largest[:, k].copy() for k in range(3)}
        return columns | {"limited_samples": found["limited"][0]}

    @cached_property
    def _references(self) -> Array:
        return tabulate_references(self._loop, self.samples)

    @cached_property
    def _feedback(self) -> SampledFeedback:
        model, controller = self._batch.model, self._controller
        drive, state = model.ode.drive[3:], model.ode.state
        noise = _NOISE if self._noisy else 0
        groups: dict[str, Sequence[tuple[str, int]]] = {
            "references": REFERENCES,
            "state": [(name, 1) for name in state],
            "memory": controller.memory,
            "noise": [("noise", noise)],
            "parameters": [(name, 1) for name in (*drive, *model.names)],
            "gains": GAINS,
        }
        sizes = {name: sum(n for _, n in parts) for name, parts in groups.items()}
        names = [
            f"{i}_{name}_{k}"
            for i, parts in enumerate(groups.values())
            for name, n in parts
            for k in range(n)
        ]

        def command(*inputs: Expression) -> tuple[Any, ...]:
            given = divide(list(sizes.items()), inputs)
            return controller(
                model.constants(given["parameters"][len(drive) :]).model,
                given["state"],
                divide(REFERENCES, given["references"]),
                divide(controller.memory, given["memory"]),
                divide(GAINS, given["gains"]),
                given["noise"],
            )

        program: Program = trace(command, names)
        return SampledFeedback(program, sizes["references"], sizes["memory"], noise, sizes["gains"])

    def _memory(self, gamma: Array, rate: Array, count: int) -> Array:
        """Return the memory before the first sample, a column a scenario."""
        start, channel = self._loop.motion.at(0.0), self._loop.channel
        columns = []
        for name, size in self._controller.memory:
            block = np.zeros((size, count))
            if name == "observed" and size:
                block[:] = np.array(start.quaternion)[:, None]
            if name == "before" and size:
                step = 2.0 * math.pi / channel.counts
                block[:] = step * np.rint((gamma - channel.period * rate) / step).T
            columns.append(block)
        return np.concatenate(columns)

    def _gains(self, batch: Batch, given: dict[str, Array], count: int) -> Array:
        """Return the gains, a column a scenario; see `Controller`."""
        settings, channel = self._loop.settings, self._loop.channel

        def value(name: str) -> Any:
            nominal = getattr(settings if hasattr(settings, name) else channel, name)
            found = given.get(f"control.{name}", np.array(nominal))
            return found.T if np.ndim(nominal) == 1 and found.ndim == 2 else found

        inertia = self._inertia[:, None]
        if settings.direct or {"control.stiffness", "control.damping"} & given.keys():
            stiffness, damping = value("stiffness"), value("damping")
            kp = stiffness.reshape(3, -1) / inertia
            kd = damping.reshape(3, -1) / inertia
        else:
            bandwidth = value("bandwidth")
            kp = np.broadcast_to(bandwidth**2, (3, count))
            kd = np.broadcast_to(2.0 * value("damping_ratio") * bandwidth, (3, count))
        limit = value("torque_limit")
        limit = np.where(limit > 0.0, limit, np.inf)
        actuators = self._loop.model.actuators
        if actuators is not None and actuators.torque_limit:
            limit = np.minimum(limit, actuators.torque_limit)
        rows = [
            np.atleast_2d(row)
            for row in (
                kp,
                kd,
                inertia,
                value("integral_rate"),
                limit,
                batch.columns.torque_limit,
                value("angle_noise"),
                value("rate_noise"),
            )
        ]
        return np.concatenate([np.broadcast_to(row, (len(row), count)) for row in rows])
