# SPDX-License-Identifier: Apache-2.0
"""A batch under feedback: the control law acts on all scenarios once a period.

At a sample the law and its channel are a function of the state of the plant and of a
memory: the integral, the queue of delayed commands, the last encoder angles, the
observed orientation, and sums of tracking errors. It is traced, without branches: what
the settings do not use has no operation. It becomes machine code as the step does, and
is called before the steps of a period, in which the torques are held.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sst_ros.control import law
from sst_ros.control.actuator_space import (
    REFERENCE_SIZES,
    ActuatorSpaceMap,
    Reference,
    ReferenceMotion,
)
from sst_ros.control.controller import SETTLING_BAND, Controller
from sst_ros.dynamics import kernel
from sst_ros.errors import refuse_unless
from sst_ros.integration.batch import Batch, BatchResult, block_width
from sst_ros.integration.batch_step import Block, ColumnStep, advance_blocks, fill
from sst_ros.mechanism.generic_math import axpy, cos, dot3, log, positive, select, sqrt
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.programs.columns import ColumnFunction, compile_columns
from sst_ros.programs.expression import Expression, divide, trace
from sst_ros.state import cached_property
from sst_ros.sweeps.sweep_study import SampledControl, SweepStudy

CONTROL_NEWTON_STEPS = 5
"""Newton steps of the observer at a sample.

Each squares the error, which is small from one sample to the next.
"""

REFERENCES = {"first": 1, **REFERENCE_SIZES, "feedforward": 3, "held": 3}
"""Sizes of a sample's inputs: whether it is the first, the reference, its torques."""

GAINS = {
    "kp": 3,
    "kd": 3,
    "inertia": 3,
    "rate": 1,
    "limit": 1,
    "plant_limit": 1,
    "noise": 2,
}
"""Sizes of what may differ between scenarios; `rate` is that of the integral."""

_NOISE = 6
"""Normal numbers that a sample takes: of three angles and three rates."""


# Normal noise from a counter: number c of row i depends on the seed, i and c alone. The
# bits are those of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014), started anew for
# each number; a pair of them becomes a normal number by the method of Box and Muller
# (1958).

_SPLITMIX_STEP = np.uint64(0x9E3779B97F4A7C15)


def streams(seed: int, rows: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Return where the random bits of rows begin, shape (N,)."""
    first = _mix(np.array([seed], dtype=np.uint64) + _SPLITMIX_STEP)
    return _mix(first + rows.astype(np.uint64) * _SPLITMIX_STEP)


def uniform_numbers(
    starts: NDArray[np.uint64], sample: int, normal: int = _NOISE
) -> Array:
    """Return what `normal` numbers a row are made of at a sample, shape (2 normal, N).

    They are uniform between 0 and 1, a pair for each normal number.
    """
    numbers = np.arange(1, 2 * normal + 1, dtype=np.uint64) + np.uint64(
        2 * normal * sample
    )
    bits = _mix(starts + (numbers * _SPLITMIX_STEP)[:, None])
    uniform: Array = ((bits >> np.uint64(11)).astype(float) + 0.5) * 2.0**-53
    return uniform


def normal_number(u: Any, v: Any) -> Any:
    """Return a normal number of mean 0 and deviation 1, of two uniform ones."""
    return sqrt(-2.0 * log(u)) * cos(2.0 * math.pi * v)


def _mix(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    mixed: NDArray[np.uint64] = x ^ (x >> np.uint64(31))
    return mixed


class Feedback(NamedTuple):
    """What the control of some scenarios needs; arrays have a column a scenario."""

    answer: ColumnFunction  # the control law, see `ControlledBatch.answer`
    references: Sequence[tuple[float, ...]]  # of each sample
    hold: int  # steps from a sample to the next
    memory: Array  # changes
    gains: Array
    starts: NDArray[np.uint64]  # of the noise; none without noise


class ControlledBlock(Block):
    """Columns whose torques the control law gives at a sample and holds to the next.

    Which columns they are is known from `load` on.
    """

    def __init__(self, step: ColumnStep, width: int, feedback: Feedback) -> None:
        super().__init__(step, width)
        self._feedback = feedback
        self._memory = np.zeros((len(feedback.memory), width))
        self._gains = np.zeros((len(feedback.gains), width))
        noise = 2 * _NOISE if len(feedback.starts) else 0
        self._uniform = np.zeros((noise, width))
        self._starts = np.zeros((1, width), dtype=np.uint64)
        inputs = [
            *self._memory,
            *self._uniform,
            *self.given,
            *self._gains,
            self.running,
        ]
        results = [*self.given[:3], *self._memory]
        self._answer = [
            feedback.answer.bind([*self.states(which), *inputs], results)
            for which in (0, 1)
        ]

    def load(self, columns_of_block: slice, *columns: NDArray[Any]) -> None:
        """Take over columns, their memory, gains and noise too."""
        super().load(columns_of_block, *columns)
        fill(self._memory, self._feedback.memory[:, columns_of_block])
        fill(self._gains, self._feedback.gains[:, columns_of_block])
        if len(self._uniform):
            fill(self._starts, self._feedback.starts[None, columns_of_block])

    def store(self, columns_of_block: slice, *columns: NDArray[Any]) -> None:
        """Put states, errors, torques and memory back."""
        super().store(columns_of_block, *columns)
        given = columns[1]
        memory = self._feedback.memory
        number = len(columns[2][columns_of_block])
        given[:3, columns_of_block] = self.given[:3, :number]
        memory[:, columns_of_block] = self._memory[:, :number]

    def prepare_step(self, number: int) -> None:
        """Give new torques where a step begins at a sample."""
        sample, since = divmod(number, self._feedback.hold)
        if since:
            return
        if len(self._uniform):
            self._uniform[:] = uniform_numbers(self._starts[0], sample)
        self._answer[self.now](*self._feedback.references[sample])


class ControlledBatch:
    """A batch of plants under the controller of a study, with zero-order hold.

    The controller's model of the plant is the scene of the study, which does not vary.
    A run has `samples` control periods; a length or a number of steps that does not fit
    them is refused.
    """

    def __init__(self, batch: Batch, study: SweepStudy) -> None:
        assert study.motion is not None and study.control is not None
        self._batch = batch
        self._scene = study.scene
        self._seed = study.seed
        self._motion: ReferenceMotion = study.motion
        self._control: SampledControl = study.control
        control = self._control
        period = control.period
        length = study.length
        self.samples = round(length / period)
        fits = self.samples > 0 and abs(self.samples * period - length) <= 1e-9 * length
        requirement = f"must be a whole number of control periods of {period:g} s"
        refuse_unless("sweep", ("duration", length, fits, requirement))
        fits_samples = not study.steps or study.steps % self.samples == 0
        requirement = (
            f"must be a multiple of {self.samples}, the control periods of a run"
        )
        refuse_unless("sweep", ("steps", study.steps, fits_samples, requirement))
        self._controller = Controller(self._scene, self._motion, control, period)
        varied = {variation.key for variation in study.variations}

        def has(*names: str) -> bool:
            return any(
                getattr(control, name) or f"control.{name}" in varied for name in names
            )

        limits = self._scene.torque_limit, batch.scene.torque_limit
        self._limited = has("torque_limit") or any(limits)
        self._noise = _NOISE if has("angle_noise", "rate_noise") else 0
        self._memory_sizes = {
            "integral": 3 if has("integral_rate") else 0,
            "queue": 3 * control.delay,
            "before": 3 if control.counts else 0,
            "observed": 4 if control.observes else 0,
            "squares": 6,  # of the error and of the torque
            "largest": 6,
            "limited": 1,
            "samples": 1,
            "unsettled": 1,  # samples to the last one outside of the band
        }

    @cached_property
    def answer(self) -> ColumnFunction:
        """The control law and its channel: torques and new memory at a sample.

        The reference is shared by all columns. A column that has ended keeps what it
        has.
        """
        model = self._batch.model
        drives = len(model.ode.drive)
        sizes = {
            "references": sum(REFERENCES.values()),
            "y": len(model.ode.state),
            "memory": sum(self._memory_sizes.values()),
            "uniform": 2 * self._noise,
            "given": drives + len(model.names),
            "gains": sum(GAINS.values()),
            "running": 1,
        }

        def respond(*inputs: Expression) -> tuple[Any, ...]:
            of = divide(sizes, inputs)
            plant = model.constants(of["given"][drives:]).model
            new = self._command(kernel.joints(plant, of["y"]), of)
            old = (*of["given"][:3], *of["memory"])
            running = of["running"][0]
            return tuple(
                select(running, *choices) for choices in zip(new, old, strict=True)
            )

        program = trace(respond, [f"i{j}" for j in range(sum(sizes.values()))])
        return compile_columns({"answer": program}, sizes["references"])["answer"]

    def _command(self, joints: Any, of: Mapping[str, Any]) -> tuple[Any, ...]:
        """Return what law and channel send, three torques, and the new memory."""
        control = self._control
        space = ActuatorSpaceMap(Geometry.of(self._scene))
        reference = divide(REFERENCES, of["references"])
        gains = divide(GAINS, of["gains"])
        memory = divide(self._memory_sizes, of["memory"])
        new = dict(memory)
        angle, rate = gains["noise"]
        pairs = zip(of["uniform"][::2], of["uniform"][1::2], strict=True)
        noise = (normal_number(u, v) for u, v in pairs)
        deviations = (angle,) * 3 + (rate,) * 3
        scaled = [n * by for n, by in zip(noise, deviations, strict=False)]
        exact = joints.gamma, joints.gamma_dot
        gamma, gamma_dot, new["before"] = control.measure(
            *exact, memory["before"], scaled
        )
        if observed := memory["observed"]:  # in the last assembly mode
            carriages = space.carriages(gamma)
            for _ in range(CONTROL_NEWTON_STEPS):
                observed = space.newton_step(*observed, *carriages)[:4]
        desired = Reference(**{name: reference[name] for name in REFERENCE_SIZES})
        limit = gains["limit"][0] if self._limited else None
        numbers = gains["kp"], gains["kd"], gains["inertia"], gains["rate"][0], limit

        def torque(*at: Any) -> Any:
            return kernel.actuator_torque(kernel.model_of(self._scene), *at)[0]

        scheme = law.ControlLaw(
            control, torque, space.star_accelerations, *numbers, control.period
        )
        ahead = reference["feedforward"], reference["held"]
        answer = scheme.answer(
            desired, ahead, gamma, gamma_dot, observed, memory["integral"]
        )
        sent, new["queue"] = control.transmit(
            answer.torque, memory["queue"], reference["first"][0]
        )
        if self._limited:
            cut = axpy(1.0, answer.total, -1.0, answer.torque)
            new["limited"] = (memory["limited"][0] + law.is_above(dot3(cut, cut)),)
            sent = law.bound(sent, gains["plant_limit"][0])
        off = axpy(1.0, desired.gamma, -1.0, joints.gamma)
        new |= {"observed": observed, "integral": answer.integral}
        squares = zip(memory["squares"], (*off, *sent), strict=True)
        new["squares"] = tuple(s + e * e for s, e in squares)
        # The larger of the largest yet and of |e|, without a branch.
        largest = zip(memory["largest"], (*off, *sent), strict=True)
        new["largest"] = tuple(
            s + positive(positive(e) + positive(-e) - s) for s, e in largest
        )
        count = memory["samples"][0]
        last = memory["unsettled"][0]
        beyond = [positive(e - self._band) + positive(-e - self._band) for e in off]
        new["samples"] = (count + 1.0,)
        new["unsettled"] = (last + law.is_above(sum(beyond)) * (count + 1.0 - last),)
        return (*sent, *(number for name in self._memory_sizes for number in new[name]))

    def run(
        self,
        batch: Batch,
        varied: dict[str, Array],
        rows: NDArray[np.int64],
        steps: int,
        kept: int,
    ) -> tuple[BatchResult, dict[str, Array]]:
        """Run the scenarios of a batch; return their results and tracking figures.

        Initial states and gains that differ are given by key. The noise depends on the
        rows of the scenarios in their study; `steps` is a multiple of `samples`.
        """
        count = len(rows)
        hold = steps // self.samples
        start = self._motion.at(0.0)
        control = self._control
        gamma = varied.get("initial.gamma", np.tile(start.gamma, (count, 1)))
        rate = varied.get("initial.gamma_dot", np.tile(start.gamma_dot, (count, 1)))
        memory = np.zeros((sum(self._memory_sizes.values()), count))
        blocks = divide(self._memory_sizes, memory)  # views of its rows
        earlier: Any = ()
        if control.counts:  # encoder angles a period before the start
            earlier = control.count(gamma - control.period * rate).T
        for name, values in (("observed", start.quaternion), ("before", earlier)):
            for place, value in zip(blocks[name], values, strict=False):
                place[:] = value
        noise = np.zeros(0, dtype=np.uint64)
        if self._noise:
            noise = streams(self._seed, rows)
        samples = [tuple(row) for row in self._references.tolist()]
        gains = self._make_gains(batch, varied, count)
        feedback = Feedback(self.answer, samples, hold, memory, gains, noise)
        width = block_width(count)
        drives = [np.zeros((3, count))]  # torques that were sent before each kept state

        def advance(
            first: int, number: int, step: float, *arrays: Any, rows: Any
        ) -> None:
            if rows is not None:  # torques are held while a step is repeated
                batch.advance(first, number, step, *arrays, threads=1)
                return
            block = ControlledBlock(batch.programs, width, feedback)
            advance_blocks(block, range(0, count, width), first, number, step, *arrays)
            if kept and (first + number) % kept == 0:
                drives.append(arrays[1][:3].copy())

        step = self.samples * control.period / steps
        result = batch.run(
            gamma, rate, step=step, count=steps, keep_every=kept, advance=advance
        )
        if result.kept is not None:
            result.kept.sent = np.moveaxis(np.stack(drives), 1, -1)
        # Root of the mean square and largest error of gamma [rad] at the samples of a
        # run and its end, and of the torque [N m]; when the error of all joints is in
        # the band for good [s].
        final = (
            np.array(divide(REFERENCES, self._references[-1])["gamma"]) - result.gamma
        )
        complete = result.success[:, None]
        last = np.hstack([np.where(complete, final, 0.0), np.zeros((count, 3))])
        largest = np.maximum(np.stack(blocks["largest"], axis=1), np.abs(last))
        squares = np.stack(blocks["squares"], axis=1) + last**2
        begun = np.floor(result.t / control.period + 1e-9)[:, None]
        sample_counts = np.hstack([begun + 1.0] * 3 + [begun + ~complete] * 3)
        figures = {"rms": np.sqrt(squares / sample_counts), "max": largest}
        table = {
            f"{quantity}_{name}_{k + 1}": x[:, 3 * offset + k]
            for offset, quantity in enumerate(("error", "torque"))
            for name, x in figures.items()
            for k in range(3)
        }
        settled = result.success & (np.abs(final).max(axis=1) <= self._band)
        since = blocks["unsettled"][0] * control.period
        table["settling_time"] = np.where(settled, since, np.nan)
        return result, table | {"limited_samples": blocks["limited"][0]}

    @cached_property
    def _band(self) -> float:
        """Settling band [rad]: a share of the largest range of a desired angle."""
        desired = [divide(REFERENCES, row)["gamma"] for row in self._references]
        return SETTLING_BAND * float(np.ptp(desired, axis=0).max())

    @cached_property
    def _references(self) -> Array:
        """References of all samples of a run, shape (samples + 1, n)."""
        rows = []
        for k in range(self.samples + 1):
            time = k * round(self._control.period * 1e9) / 1e9
            desired_state, *torques = self._controller.desire(time)
            desired = (
                number
                for name in REFERENCE_SIZES
                for number in getattr(desired_state, name)
            )
            rows.append((float(k == 0), *desired, *torques[0], *torques[1]))
        return np.array(rows)

    def _make_gains(self, batch: Batch, varied: dict[str, Array], count: int) -> Array:
        """Return the gains, a column a scenario; see GAINS."""

        def value(name: str) -> Any:
            nominal = getattr(self._control, name)
            values = varied.get(f"control.{name}", np.array(nominal))
            return values.T if np.ndim(nominal) == 1 and values.ndim == 2 else values

        inertia = np.array(self._controller.inertia)[:, None]
        varies = {"control.stiffness", "control.damping"} & varied.keys()
        rows = (
            *law.feedback_gains(inertia, value, self._control.direct or bool(varies)),
            inertia,
            value("integral_rate"),
            law.command_limit(value("torque_limit"), self._scene),
            batch.columns.torque_limit,
            value("angle_noise"),
            value("rate_noise"),
        )
        shaped = (np.atleast_2d(row) for row in rows)
        return np.concatenate(
            [np.broadcast_to(row, (len(row), count)) for row in shaped]
        )
