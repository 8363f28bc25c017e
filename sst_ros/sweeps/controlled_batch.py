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
from sst_ros.integration.batch_step import (
    Block,
    Columns,
    ColumnStep,
    advance_blocks,
    fill,
)
from sst_ros.mechanism.generic_math import axpy, cos, dot3, log, positive, select, sqrt
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.programs.columns import ColumnFunction, compile_columns
from sst_ros.programs.expression import Expression, divide, trace
from sst_ros.state import NANOSECONDS, TORQUES, cached_property
from sst_ros.sweeps.sweep_study import SampledControl, SweepStudy

CONTROL_NEWTON_STEPS = 5
"""Newton steps of the observer at a sample.

Each squares the error, which is small from one sample to the next.
"""

REFERENCES = {"first": 1, **REFERENCE_SIZES, "feedforward": 3, "held": 3}
"""Sizes of a sample's inputs.

They are whether it is the first, the reference, and the torques of the desired motion,
now and at the instant whose torque is held.
"""

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
    earlier = np.uint64(2 * normal * sample)
    numbers = np.arange(1, 2 * normal + 1, dtype=np.uint64) + earlier
    bits = _mix(starts + (numbers * _SPLITMIX_STEP)[:, None])
    # by the upper 53 bits, as many as a double has; in the middle of their steps
    uniform: Array = ((bits >> np.uint64(11)).astype(float) + 0.5) * 2.0**-53
    return uniform


def normal_number(u: Any, v: Any) -> Any:
    """Return a normal number of mean 0 and deviation 1, of two uniform ones."""
    return sqrt(-2.0 * log(u)) * cos(2.0 * math.pi * v)


def _mix(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return the bits that SplitMix64 makes of its states."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    mixed: NDArray[np.uint64] = x ^ (x >> np.uint64(31))
    return mixed


class Feedback(NamedTuple):
    """What the control of some scenarios needs; arrays have a column a scenario."""

    answer: ColumnFunction  # the control law, see `ControlledBatch.answer`
    references: Sequence[tuple[float, ...]]  # of each sample
    hold: int  # steps from a sample to the next
    memory: Array  # changes at each sample, see `ControlledBatch`
    gains: Array  # see GAINS
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
        has_noise = len(feedback.starts) > 0
        self._uniform = np.zeros((2 * _NOISE if has_noise else 0, width))
        self._starts = np.zeros((1, width), dtype=np.uint64)
        inputs = [
            *self._memory,
            *self._uniform,
            *self.given,
            *self._gains,
            self.running,
        ]
        results = [*self.given[TORQUES], *self._memory]
        self._answer = [
            feedback.answer.bind([*self.states(which), *inputs], results)
            for which in (0, 1)
        ]

    def load(self, columns_of_block: slice, columns: Columns) -> None:
        """Take over columns, their memory, gains and noise too."""
        super().load(columns_of_block, columns)
        fill(self._memory, self._feedback.memory[:, columns_of_block])
        fill(self._gains, self._feedback.gains[:, columns_of_block])
        if len(self._uniform):
            fill(self._starts, self._feedback.starts[None, columns_of_block])

    def store(self, columns_of_block: slice, columns: Columns) -> None:
        """Put states, errors, torques and memory back."""
        super().store(columns_of_block, columns)
        memory = self._feedback.memory
        number = len(columns.code[columns_of_block])  # the last block may have fewer
        columns.drives[TORQUES, columns_of_block] = self.given[TORQUES, :number]
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

        def has(name: str) -> bool:
            """Return whether a setting acts in some scenario."""
            return bool(getattr(control, name)) or f"control.{name}" in varied

        limits = self._scene.torque_limit, batch.scene.torque_limit
        self._limited = has("torque_limit") or any(limits)
        has_noise = has("angle_noise") or has("rate_noise")
        self._noise = _NOISE if has_noise else 0
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
            "sent": 3,
            "other_drives": drives - 3,
            "varied": len(model.names),
            "gains": sum(GAINS.values()),
            "running": 1,
        }

        def respond(*inputs: Expression) -> tuple[Any, ...]:
            numbers = divide(sizes, inputs)
            plant = model.constants(numbers["varied"]).model
            new = self._command(kernel.joints(plant, numbers["y"]), numbers)
            old = (*numbers["sent"], *numbers["memory"])
            (running,) = numbers["running"]
            return tuple(
                select(running, *choices) for choices in zip(new, old, strict=True)
            )

        program = trace(respond, [f"i{j}" for j in range(sum(sizes.values()))])
        return compile_columns({"answer": program}, sizes["references"])["answer"]

    def _command(self, joints: Any, numbers: Mapping[str, Any]) -> tuple[Any, ...]:
        """Return what law and channel send, three torques, and the new memory.

        The joints are those of the plant, the numbers the other inputs of `answer`.
        """
        control = self._control
        space = ActuatorSpaceMap(Geometry.of(self._scene))
        reference = divide(REFERENCES, numbers["references"])
        gains = divide(GAINS, numbers["gains"])
        memory = divide(self._memory_sizes, numbers["memory"])
        noise = self._scale_noise(numbers["uniform"], gains["noise"])
        measured, encoder_angles = control.measure(
            joints.gamma, joints.gamma_dot, memory["before"], noise
        )
        observed = memory["observed"]
        if observed:  # in the last assembly mode
            carriages = space.carriages(measured.gamma)
            for _ in range(CONTROL_NEWTON_STEPS):
                x, y, z, w, *_ = space.newton_step(*observed, *carriages)
                observed = (x, y, z, w)
        desired = Reference(**{name: reference[name] for name in REFERENCE_SIZES})
        scheme = law.ControlLaw(
            control,
            self._inverse_dynamics,
            space.star_accelerations,
            gains["kp"],
            gains["kd"],
            gains["inertia"],
            gains["rate"][0],
            gains["limit"][0] if self._limited else None,
            control.period,
        )
        ahead = reference["feedforward"], reference["held"]
        answer = scheme.answer(desired, ahead, measured, observed, memory["integral"])
        sent, queue = control.transmit(
            answer.torque, memory["queue"], reference["first"][0]
        )
        limited = memory["limited"]
        if self._limited:
            cut = axpy(1.0, answer.total, -1.0, answer.torque)
            limited = (limited[0] + law.is_above(dot3(cut, cut)),)
            sent = law.bound(sent, gains["plant_limit"][0])
        error = axpy(1.0, desired.gamma, -1.0, joints.gamma)
        new = {
            "integral": answer.integral,
            "queue": queue,
            "before": encoder_angles,
            "observed": observed,
            "limited": limited,
            **self._score(memory, error, sent),
        }
        return (*sent, *(number for name in self._memory_sizes for number in new[name]))

    def _inverse_dynamics(self, *motion: Any) -> Any:
        """Return the torques of quaternion, W and W_dot by the controller's model."""
        torque, _ = kernel.actuator_torque(kernel.model_of(self._scene), *motion)
        return torque

    def _scale_noise(self, uniform: Sequence[Any], deviations: Sequence[Any]) -> Any:
        """Return noise of three angles and three rates, of pairs of uniform numbers."""
        angle, rate = deviations
        noise = []
        for k in range(self._noise):
            u, v = uniform[2 * k : 2 * k + 2]
            deviation = angle if k < 3 else rate
            noise.append(normal_number(u, v) * deviation)
        return noise

    def _score(
        self, memory: Mapping[str, Any], error: Any, sent: Any
    ) -> dict[str, tuple[Any, ...]]:
        """Return the sums of tracking errors [rad] and torques [N m] with a sample."""
        scored = (*error, *sent)
        squares = zip(memory["squares"], scored, strict=True)
        # The larger of the largest yet and of |x|, without a branch.
        largest = zip(memory["largest"], scored, strict=True)
        (count,) = memory["samples"]
        (last,) = memory["unsettled"]
        outside = [positive(x - self._band) + positive(-x - self._band) for x in error]
        return {
            "squares": tuple(total + x * x for total, x in squares),
            "largest": tuple(
                most + positive(positive(x) + positive(-x) - most)
                for most, x in largest
            ),
            "samples": (count + 1.0,),
            "unsettled": (last + law.is_above(sum(outside)) * (count + 1.0 - last),),
        }

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
        start = self._motion.at(0.0)
        gamma = varied.get("initial.gamma", np.tile(start.gamma, (count, 1)))
        rate = varied.get("initial.gamma_dot", np.tile(start.gamma_dot, (count, 1)))
        memory = self._start_memory(start, gamma, rate)
        noise = np.zeros(0, dtype=np.uint64)
        if self._noise:
            noise = streams(self._seed, rows)
        feedback = Feedback(
            answer=self.answer,
            references=[tuple(row) for row in self._references.tolist()],
            hold=steps // self.samples,
            memory=memory,
            gains=self._make_gains(batch, varied, count),
            starts=noise,
        )
        width = block_width(count)
        sent = [np.zeros((3, count))]  # torques that were sent before each kept state

        def advance(
            first: int, number: int, step: float, *columns: Any, rows: Any
        ) -> None:
            if rows is not None:  # torques are held while a step is repeated
                batch.advance(first, number, step, *columns, threads=1)
                return
            block = ControlledBlock(batch.programs, width, feedback)
            advance_blocks(block, range(0, count, width), first, number, step, *columns)
            if kept and (first + number) % kept == 0:
                _, drives, *_ = columns
                sent.append(drives[TORQUES].copy())

        step = self.samples * self._control.period / steps
        result = batch.run(
            gamma, rate, step=step, count=steps, keep_every=kept, advance=advance
        )
        if result.kept is not None:
            result.kept.sent = np.moveaxis(np.stack(sent), 1, -1)
        return result, self._tracking_figures(result, memory)

    def _start_memory(self, start: Reference, gamma: Array, rate: Array) -> Array:
        """Return the memory before the first sample, a column a scenario."""
        control = self._control
        memory = np.zeros((sum(self._memory_sizes.values()), len(gamma)))
        rows = divide(self._memory_sizes, memory)  # views
        if control.observes:
            for row, component in zip(rows["observed"], start.quaternion, strict=True):
                row[:] = component
        if control.counts:  # encoder angles a period before the start
            earlier = control.count(gamma - control.period * rate)
            for row, angle in zip(rows["before"], earlier.T, strict=True):
                row[:] = angle
        return memory

    def _tracking_figures(self, result: BatchResult, memory: Array) -> dict[str, Array]:
        """Return how closely the scenarios followed the reference.

        The figures are the root of the mean square and the largest error of gamma [rad]
        at the samples of a run and its end, and of the torque [N m]; when the error of
        all joints is in the band for good [s].
        """
        rows = divide(self._memory_sizes, memory)
        desired = np.array(divide(REFERENCES, self._references[-1])["gamma"])
        final = desired - result.gamma
        complete = result.success[:, None]
        no_torque = np.zeros_like(final)
        last = np.hstack([np.where(complete, final, 0.0), no_torque])
        largest = np.maximum(np.stack(rows["largest"], axis=1), np.abs(last))
        squares = np.stack(rows["squares"], axis=1) + last**2
        # Errors count at the end, too, torques where a period begins: not at the end of
        # a whole run.
        begun = np.floor(result.t / self._control.period + 1e-9)[:, None]
        sample_counts = np.hstack([begun + 1.0] * 3 + [begun + ~complete] * 3)
        error_rms, torque_rms = np.split(np.sqrt(squares / sample_counts), 2, axis=1)
        error_max, torque_max = np.split(largest, 2, axis=1)
        figures = {
            "error_rms": error_rms,
            "error_max": error_max,
            "torque_rms": torque_rms,
            "torque_max": torque_max,
        }
        table = {}
        for name, columns in figures.items():
            for k in range(3):
                table[f"{name}_{k + 1}"] = columns[:, k]
        settled = result.success & (np.abs(final).max(axis=1) <= self._band)
        since = rows["unsettled"][0] * self._control.period
        table["settling_time"] = np.where(settled, since, np.nan)
        table["limited_samples"] = rows["limited"][0]
        return table

    @cached_property
    def _band(self) -> float:
        """Settling band [rad]: a share of the largest range of a desired angle."""
        desired = [divide(REFERENCES, row)["gamma"] for row in self._references]
        return SETTLING_BAND * float(np.ptp(desired, axis=0).max())

    @cached_property
    def _references(self) -> Array:
        """References of all samples of a run, shape (samples + 1, n)."""
        rows = []
        period_ns = round(self._control.period * NANOSECONDS)
        for k in range(self.samples + 1):
            time = k * period_ns / NANOSECONDS
            reference, feedforward, held = self._controller.desire(time)
            row = [float(k == 0)]  # in the order of REFERENCES
            for name in REFERENCE_SIZES:
                row += getattr(reference, name)
            rows.append([*row, *feedforward, *held])
        return np.array(rows)

    def _make_gains(self, batch: Batch, varied: dict[str, Array], count: int) -> Array:
        """Return the gains, a column a scenario; see GAINS."""

        def value(name: str) -> Any:
            """Return a setting; of a vector that varies, a row for each component."""
            nominal = getattr(self._control, name)
            values = varied.get(f"control.{name}", np.array(nominal))
            is_varied_vector = np.ndim(nominal) == 1 and values.ndim == 2
            return values.T if is_varied_vector else values

        inertia = np.array(self._controller.inertia)[:, None]
        varies = {"control.stiffness", "control.damping"} & varied.keys()
        direct = self._control.direct or bool(varies)
        stiffness, damping = law.feedback_gains(inertia, value, direct)
        noise = np.broadcast_arrays(value("angle_noise"), value("rate_noise"))
        gains = {
            "kp": stiffness,
            "kd": damping,
            "inertia": inertia,
            "rate": value("integral_rate"),
            "limit": law.command_limit(value("torque_limit"), self._scene),
            "plant_limit": batch.columns.torque_limit,
            "noise": noise,
        }
        columns = []
        for name, size in GAINS.items():
            rows = np.reshape(gains[name], (size, -1))
            columns.append(np.broadcast_to(rows, (size, count)))
        return np.concatenate(columns)
