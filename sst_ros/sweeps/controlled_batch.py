# SPDX-License-Identifier: Apache-2.0
"""A batch under feedback: the controller is compiled into the loop, and acts once a period."""

from __future__ import annotations

import math
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
from sst_ros.sweeps import counter_noise
from sst_ros.sweeps.controlled import ControlledRun
from sst_ros.sweeps.reference_samples import REFERENCES, grouped, reference_table
from sst_ros.sweeps.traced_controller import GAINS, TracedController

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
        limits = np.isfinite(self._own_limit()) or "control.torque_limit" in varied
        plant = batch.scene.actuators is not None and batch.scene.actuators.torque_limit is not None
        self._noisy = bool(
            loop.channel.angle_noise
            or loop.channel.rate_noise
            or varied & {"control.angle_noise", "control.rate_noise"}
        )
        integral = loop.settings.integral_rate > 0.0 or "control.integral_rate" in varied
        observes = loop.settings.mode in ("gravity_pd", "computed_torque")
        sizes = {
            "integral": 3 * integral, "queue": 3 * loop.channel.delay,
            "before": 3 * (loop.channel.counts > 0), "observed": 4 * observes,
            "squares": 3, "largest": 3, "limited": 1,
        }  # fmt: skip
        memory = tuple((name, int(size)) for name, size in sizes.items())
        self._controller = TracedController(loop, bool(limits or plant), memory)

    @cached_property
    def module(self) -> ModuleType:
        """The compiled loop."""
        model = self._batch.model
        text = batch_source(
            model.program, model.limit_distances, DOP853, len(model.ode.state), self._feedback
        )
        texts = [counter_noise.SOURCE, counter_noise.GAUSSIAN, text]
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
            batch.model, batch.columns, batch.start(gamma, rate),
            batch.drives((0.0, 0.0, 0.0), count), advance,
            step=step, count=steps, keep_every=kept,
        )  # fmt: skip
        return result, self._tracking(result, memory, result.t)

    def _tracking(self, result: BatchResult, memory: Array, last: Array) -> dict[str, Array]:
        """Root of the mean square and largest error of gamma [rad] at the samples of a run."""
        found = grouped(self._controller.memory, list(memory))
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
        return reference_table(self._loop, self.samples)

    @cached_property
    def _feedback(self) -> SampledFeedback:
        model, controller = self._batch.model, self._controller
        drive, state = model.ode.drive[3:], model.ode.state
        noise = _NOISE if self._noisy else 0
        groups = [REFERENCES, ((s, 1) for s in state), controller.memory, (("noise", noise),),
                  ((s, 1) for s in (*drive, *model.names)), GAINS]  # fmt: skip
        names = [f"{i}_{name}_{k}" for i, group in enumerate(groups) for name, n in group
                 for k in range(n)]  # fmt: skip
        sizes = [
            sum(n for _, n in REFERENCES), len(state), sum(n for _, n in controller.memory), noise,
            len(drive) + len(model.names), sum(n for _, n in GAINS),
        ]  # fmt: skip

        def command(*inputs: Expression) -> tuple[Any, ...]:
            parts, at = [], 0
            for size in sizes:
                parts.append(inputs[at : at + size])
                at += size
            references, y, memory, normals, parameters, gains = parts
            plant = model.constants(parameters[len(drive) :]).model
            return controller(
                plant, y, grouped(REFERENCES, references), grouped(controller.memory, memory),
                grouped(GAINS, gains), normals,
            )  # fmt: skip

        program: Program = trace(command, names)
        return SampledFeedback(program, sizes[0], sizes[2], noise, sizes[5])

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
            kp, kd, np.broadcast_to(inertia, (3, count)), value("integral_rate"), limit,
            batch.columns.torque_limit, value("angle_noise"), value("rate_noise"),
        ]  # fmt: skip
        return np.concatenate(
            [np.broadcast_to(np.atleast_2d(row), (len(np.atleast_2d(row)), count)) for row in rows]
        )

    def _own_limit(self) -> float:
        limits = [self._loop.settings.torque_limit or math.inf]
        if self._loop.model.actuators is not None:
            limits.append(self._loop.model.actuators.torque_limit or math.inf)
        return min(limits)
