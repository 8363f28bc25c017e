# SPDX-License-Identifier: Apache-2.0
"""A batch under feedback: the control law, compiled for all scenarios, acts once a period.

At a sample the law and its channel are a function of the state of the plant and of a memory: the
integral, the queue of delayed commands, the last encoder angles, the observed orientation, and sums
of tracking errors. It is traced, without branches: what the settings do not use has no operation.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields
from functools import cached_property
from itertools import islice
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.control import law
from sst_ros.control.actuator_space import ActuatorSpaceMap, Reference, ReferenceMotion
from sst_ros.control.controller import BAND, Controller
from sst_ros.dynamics import kernel
from sst_ros.dynamics.expression import Expression, Program, trace
from sst_ros.errors import refuse_unless
from sst_ros.host import compiled_module
from sst_ros.integration.batch import Batch, BatchResult
from sst_ros.integration.simd_source import (
    SIMD_WIDTH,
    Layout,
    assign_once,
    evaluate_lanes,
    indent,
    load_lanes,
    loop,
    over_blocks,
    replace_valid,
)
from sst_ros.mechanism.generic_math import axpy, dot3, positive
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.sweeps.sweep_study import SampledControl, SweepStudy

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

NEWTON_STEPS = 5
"""Of the observer at a sample. They square the error; from one sample to the next it is small."""

_DESIRED = {part.name: 4 if part.name == "quaternion" else 3 for part in fields(Reference)}

REFERENCES = {"first": 1, **_DESIRED, "feedforward": 3, "held": 3}
"""Sizes of what a sample is given: whether it is the first, the reference, its torques."""

GAINS = {"kp": 3, "kd": 3, "inertia": 3, "rate": 1, "limit": 1, "plant_limit": 1, "noise": 2}
"""Sizes of what may differ between scenarios; `rate` is that of the integral."""

_NOISE = 6
_BLOCKS = 32
"""Blocks of scenarios that are advanced from sample to sample together: they fit the cache."""


def divide(sizes: Mapping[str, int], numbers: Iterable[Any]) -> dict[str, Any]:
    """Divide numbers into tuples by name, of the sizes given."""
    rest = iter(numbers)
    return {name: tuple(islice(rest, size)) for name, size in sizes.items()}


def control_source(program: Program, sizes: Mapping[str, int]) -> str:
    """Text of `control(sample, begin, end, y, d, code, memory, references, gains, rows, seed)`.

    At a sample it gives scenarios whose code is 0, in the blocks begin to end, the torques in
    d (numbers, N) and the new memory (numbers, N). All share the references (samples, numbers);
    `gaussian(seed, row, counter)` gives the noise of each. The outputs of the program are three
    torques and the new memory; `sizes` are those of its inputs: references, state y, memory, noise,
    the rest of d behind the torques, gains. Ten lines of it:

        def control(sample, begin, end, y, d, code, memory, references, gains, rows, seed):
            block = vector(2976)
            for b in range(begin, end):
                lo = b * 32
                for i in range(32):
                    n = lo + min(i, last)
                    block[0 + i] = y[0, n]
                u0 = references[sample, 0]
                for i in range(last + 1):
                    d[0, lo + i] = block[704 + i]
    """
    state, memory, noise, drive = sizes["y"], sizes["memory"], sizes["noise"], 3 + sizes["rest"]
    at = Layout(
        SIMD_WIDTH, y=state, memory=memory, noise=noise, d=drive, gains=sizes["gains"],
        command=3 + memory, code=1,
    )  # fmt: skip
    given = [
        *(f"references[sample, {j}]" for j in range(sizes["references"])),
        *at.rows("y", state),
        *at.rows("memory", memory),
        *at.rows("noise", noise),
        *at.rows("d", drive)[3:],
        *at.rows("gains", sizes["gains"]),
    ]
    drawn = [
        f"    {at.lane('noise', j)} = gaussian(seed, rows[n], {noise} * sample + {j})"
        for j in range(noise)
    ]
    places = at.rows("d", 3) + at.rows("memory", memory)
    names = [f"d[{j}, lo + i]" for j in range(3)] + [f"memory[{j}, lo + i]" for j in range(memory)]
    accepted = [f"now = {at.lane('code')}"]
    for j, place in enumerate(places):
        accepted += replace_valid(place, at.lane("command", j))
    lines = [
        *load_lanes(at, y=state, d=drive, memory=memory, gains=sizes["gains"]),
        f"    {at.lane('code')} = code[n]",
        *(load_lanes(at) + drawn if drawn else ()),
        *evaluate_lanes(program, given, at, "command"),
        *loop(at, accepted),
        "for i in range(last + 1):",
        *(f"    {name} = {place}" for name, place in zip(names, places, strict=True)),
    ]
    head = "def control(sample, begin, end, y, d, code, memory, references, gains, rows, seed):"
    return assign_once([head, *over_blocks(at), *indent(8, lines)])


class ControlledBatch:
    """A batch of plants whose torques come from the controller of a study, with zero-order hold.

    The controller's model of the plant is the scene of the study, which does not vary. A run has
    `samples` control periods; a length or a number of steps that does not fit them is refused.
    """

    def __init__(self, batch: Batch, study: SweepStudy) -> None:
        assert study.motion is not None and study.control is not None
        self._batch, self._scene, self._seed = batch, study.scene, study.seed
        self._motion: ReferenceMotion = study.motion
        self._control: SampledControl = study.control
        control, length, period = self._control, study.length, self._control.period
        self.samples = round(length / period)
        fits = self.samples > 0 and abs(self.samples * period - length) <= 1e-9 * length
        allowed = f"must be a whole number of control periods of {period:g} s"
        refuse_unless("sweep", ("duration", length, fits, allowed))
        whole = not study.steps or study.steps % self.samples == 0
        allowed = f"must be a multiple of {self.samples}, the control periods of a run"
        refuse_unless("sweep", ("steps", study.steps, whole, allowed))
        self._controller = Controller(self._scene, self._motion, control, period)
        varied = {one.key for one in study.variations}

        def has(*names: str) -> bool:
            return any(getattr(control, name) or f"control.{name}" in varied for name in names)

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
    def module(self) -> ModuleType:
        """The compiled function `control`, see `control_source`."""
        state, drive = len(self._batch.model.ode.state), len(self._batch.model.ode.drive)
        sizes = {
            "references": sum(REFERENCES.values()),
            "y": state,
            "memory": sum(self._memory_sizes.values()),
            "noise": self._noise,
            "rest": drive - 3 + len(self._batch.model.names),
            "gains": sum(GAINS.values()),
        }

        def answer(*inputs: Expression) -> tuple[Any, ...]:
            of = divide(sizes, inputs)
            plant = self._batch.model.constants(of["rest"][drive - 3 :]).model
            return self._command(kernel.joints(plant, of["y"]), of)

        program = trace(answer, [f"i{j}" for j in range(sum(sizes.values()))])
        texts = [*NOISE, control_source(program, sizes)]
        return compiled_module.load(texts, {}, numba=True, nogil=True)

    def _command(self, joints: Any, of: Mapping[str, Any]) -> tuple[Any, ...]:
        """Return what the law and its channel send, three torques, and the new memory."""
        control, space = self._control, ActuatorSpaceMap(Geometry.of(self._scene))
        given, gains = divide(REFERENCES, of["references"]), divide(GAINS, of["gains"])
        memory = divide(self._memory_sizes, of["memory"])
        new = dict(memory)
        angle, rate = gains["noise"]
        scaled = [n * by for n, by in zip(of["noise"], (angle,) * 3 + (rate,) * 3, strict=False)]
        exact = joints.gamma, joints.gamma_dot
        gamma, gamma_dot, new["before"] = control.measure(*exact, memory["before"], scaled)
        if observed := memory["observed"]:  # in the last assembly mode
            carriages = space.carriages(gamma)
            for _ in range(NEWTON_STEPS):
                observed = space.newton_step(*observed, *carriages)[:4]
        desired = Reference(**{name: given[name] for name in _DESIRED})
        limit = gains["limit"][0] if self._limited else None
        numbers = gains["kp"], gains["kd"], gains["inertia"], gains["rate"][0], limit

        def torque(*at: Any) -> Any:
            return kernel.actuator_torque(kernel.model_of(self._scene), *at)[0]

        scheme = law.ControlLaw(control, torque, space.star_accelerations, *numbers, control.period)
        ahead = given["feedforward"], given["held"]
        found = scheme.answer(desired, ahead, gamma, gamma_dot, observed, memory["integral"])
        sent, new["queue"] = control.transmit(found.torque, memory["queue"], given["first"][0])
        if self._limited:
            cut = axpy(1.0, found.total, -1.0, found.torque)
            new["limited"] = (memory["limited"][0] + law.is_above(dot3(cut, cut)),)
            sent = law.bound(sent, gains["plant_limit"][0])
        off = axpy(1.0, desired.gamma, -1.0, joints.gamma)
        sums, most = (zip(memory[x], (*off, *sent), strict=True) for x in ("squares", "largest"))
        new |= {"observed": observed, "integral": found.integral}
        new["squares"] = tuple(s + e * e for s, e in sums)
        new["largest"] = tuple(s + positive(positive(e) + positive(-e) - s) for s, e in most)
        (count,), (last,) = memory["samples"], memory["unsettled"]
        beyond = [positive(e - self._band) + positive(-e - self._band) for e in off]
        new["samples"] = (count + 1.0,)
        new["unsettled"] = (last + law.is_above(sum(beyond)) * (count + 1.0 - last),)
        return (*sent, *(number for name in self._memory_sizes for number in new[name]))

    def run(
        self, batch: Batch, given: dict[str, Array], rows: NDArray[np.int64], steps: int, kept: int
    ) -> tuple[BatchResult, dict[str, Array]]:
        """Run the scenarios of a batch; return their results and tracking figures.

        Initial states and gains that differ are given by key. The noise depends on the rows of the
        scenarios in their study; `steps` is a multiple of `samples`.
        """
        count, hold, drawn_for = len(rows), steps // self.samples, rows
        start, control = self._motion.at(0.0), self._control
        gamma = given.get("initial.gamma", np.tile(start.gamma, (count, 1)))
        rate = given.get("initial.gamma_dot", np.tile(start.gamma_dot, (count, 1)))
        memory = np.zeros((sum(self._memory_sizes.values()), count))
        blocks = divide(self._memory_sizes, memory)  # views of its rows
        earlier = control.count(gamma - control.period * rate).T if control.counts else ()
        for name, values in (("observed", start.quaternion), ("before", earlier)):
            for row, value in zip(blocks[name], values, strict=False):
                row[:] = value
        gains = self._make_gains(batch, given, count)
        drives = [np.zeros((3, count))]  # torques that were sent before each kept state

        def advance(first: int, count: int, step: float, *arrays: Any, rows: Any) -> None:
            if rows is not None:  # torques are held while a step is repeated
                batch.advance(first, count, step, *arrays, threads=1)
                return
            blocks, end = -(-arrays[0].shape[1] // SIMD_WIDTH), first + count
            own = *arrays[:3], memory, self._references, gains, drawn_for, self._seed
            for begin in range(0, blocks, _BLOCKS):
                part, now = (begin, min(begin + _BLOCKS, blocks)), first
                while now < end:
                    if now % hold == 0:
                        self.module.control(now // hold, *part, *own)
                    span = min(hold - now % hold, end - now)
                    batch.module.batch(step, now, span, *part, *arrays)
                    now += span
            if kept and end % kept == 0:
                drives.append(arrays[1][:3].copy())

        step = self.samples * control.period / steps
        result = batch.run(gamma, rate, step=step, count=steps, keep_every=kept, advance=advance)
        if result.kept is not None:
            result.kept.sent = np.moveaxis(np.stack(drives), 1, -1)
        # Root of the mean square and largest error of gamma [rad] at the samples of a run and its
        # end, and of the torque [N m]; when the error of all joints is in the band for good [s].
        final = np.array(divide(REFERENCES, self._references[-1])["gamma"]) - result.gamma
        complete = result.success[:, None]
        last = np.hstack([np.where(complete, final, 0.0), np.zeros((count, 3))])
        largest = np.maximum(np.stack(blocks["largest"], axis=1), np.abs(last))
        squares = np.stack(blocks["squares"], axis=1) + last**2
        begun = np.floor(result.t / control.period + 1e-9)[:, None]
        samples = np.hstack([begun + 1.0] * 3 + [begun + ~complete] * 3)
        figures = {"rms": np.sqrt(squares / samples), "max": largest}
        columns = {
            f"{what}_{name}_{k + 1}": x[:, 3 * part + k]
            for part, what in enumerate(("error", "torque"))
            for name, x in figures.items()
            for k in range(3)
        }
        settled = result.success & (np.abs(final).max(axis=1) <= self._band)
        since = blocks["unsettled"][0] * control.period
        columns["settling_time"] = np.where(settled, since, np.nan)
        return result, columns | {"limited_samples": blocks["limited"][0]}

    @cached_property
    def _band(self) -> float:
        """Settling band [rad]: a share of the largest range of a desired angle."""
        desired = [divide(REFERENCES, row)["gamma"] for row in self._references]
        return BAND * float(np.ptp(desired, axis=0).max())

    @cached_property
    def _references(self) -> Array:
        """References of all samples of a run, shape (samples + 1, n)."""
        rows = []
        for k in range(self.samples + 1):
            time = k * round(self._control.period * 1e9) / 1e9
            at, *torques = self._controller.desire(time)
            desired = (number for name in _DESIRED for number in getattr(at, name))
            rows.append((float(k == 0), *desired, *torques[0], *torques[1]))
        return np.array(rows)

    def _make_gains(self, batch: Batch, given: dict[str, Array], count: int) -> Array:
        """Return the gains, a column a scenario; see GAINS."""

        def value(name: str) -> Any:
            nominal = getattr(self._control, name)
            found = given.get(f"control.{name}", np.array(nominal))
            return found.T if np.ndim(nominal) == 1 and found.ndim == 2 else found

        inertia = np.array(self._controller.inertia)[:, None]
        varies = {"control.stiffness", "control.damping"} & given.keys()
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
        return np.concatenate([np.broadcast_to(row, (len(row), count)) for row in shaped])
