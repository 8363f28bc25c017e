# SPDX-License-Identifier: Apache-2.0
"""Result of a batch: states of many scenarios as arrays, with the names of `simulate`."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.extras import require
from sst_ros.integration.batch_source import NOT_FINITE
from sst_ros.integration.parametric_model import OUTPUTS, ParameterColumns, ParametricModel
from sst_ros.mechanism import frames
from sst_ros.mechanism.geometry import Array
from sst_ros.state import DIMENSIONS, UNITS, arrays_of, columns_of

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

_BLOCK = 1024
"""Scenarios whose joints are computed at once: all numbers of the program are arrays as long."""

NO_ASSEMBLY, NO_RATE, OUTSIDE = -1, -2, -3
_REASONS = {
    0: "reached the end",
    NO_ASSEMBLY: "no unique admissible assembly",
    NO_RATE: "gamma_dot does not determine the body rate: singular start",
    OUTSIDE: "initial gamma outside the stroke",
    NOT_FINITE: "not finite",
}
"""How a scenario ended, by the codes that are no limit's: below zero it did not start."""

_HALF = 2 * NOT_FINITE
_CODES = 2 * _HALF
"""More than there are codes, of either sign."""

_SCENARIO = ("status", "message", "fault_time", "local_error")


def _of_joints(name: str, meaning: str) -> Any:
    return property(lambda states: states._quantity(name), doc=f"{meaning}, shape (..., N, 3).")


class BatchStates:
    """States of N scenarios, at one time or at several. Treat the arrays as read-only.

    Args:
        model: the programs.
        columns: the numbers of the scenarios.
        torque: commanded torques [N m], shape (N, 3); not used under a profile.
        valid: whether a scenario has started, shape (N,).
        t: times [s] of the states, shape (N,) or (samples, N).
        y: state of the integration (quaternion, body rate, with lag three torques), shape
            (state, N) or (samples, state, N).

    Attributes:
        t: times of the states [s], shape (N,) or (samples, N): those of the last valid state in a
            scenario that has ended.
        quaternion: orientations (x, y, z, w) of {E} in {B}, shape (N, 4) or (samples, N, 4).
        body_rate: angular velocities of the star in {E} [rad/s], shape (N, 3) or (samples, N, 3).

    """

    def __init__(
        self,
        model: ParametricModel,
        columns: ParameterColumns,
        torque: Array,
        valid: NDArray[np.bool_],
        t: Array,
        y: Array,
    ) -> None:
        self._model, self._columns, self._torque, self._valid = model, columns, torque, valid
        self._state, self.t = np.moveaxis(y, -2, -1), t
        self._computed: dict[str, Array] = {}
        self.quaternion: Array = self._state[..., :4]
        self.body_rate: Array = self._state[..., 4:7]

    gamma = _of_joints("gamma", "Angles of the actuators [rad], nan where there is no start")
    mu = _of_joints("mu", "Angles between base arcs and arcs of the star [rad]")
    beta = _of_joints("beta", "Angles from the carriages to E [rad]")
    gamma_dot = _of_joints("gamma_dot", "Rates of gamma [rad/s]")
    mu_dot = _of_joints("mu_dot", "Rates of mu [rad/s]")
    beta_dot = _of_joints("beta_dot", "Rates of beta [rad/s]")

    @property
    def energy(self) -> Array:
        """Kinetic and potential energy [J], shape (..., N)."""
        return self._quantity("energy")[..., 0]

    def compute(self, *names: str) -> None:
        """Compute these quantities of joints, or the energy, and no others, for later use."""
        if not names:
            return
        shapes = [1 if name == "energy" else 3 for name in names]
        found = np.empty((sum(shapes), *self.t.shape))
        flat = found.reshape(len(found), -1, self.t.shape[-1])
        function = self._model.output_function(names)
        states = np.moveaxis(self._state, -1, 0)[:7].reshape(7, *flat.shape[1:])
        columns = self._columns.inputs
        for sample in range(flat.shape[1]):
            for first in range(0, flat.shape[2], _BLOCK):
                rows = slice(first, first + _BLOCK)
                own = columns[:, rows] if columns.shape[1] > 1 else columns
                with np.errstate(all="ignore"):
                    numbers = function(*states[:, sample, rows], *own)
                for j, number in enumerate(numbers):
                    flat[j, sample, rows] = number
        flat[..., ~self._valid] = np.nan
        parts = np.split(np.moveaxis(found, 0, -1), np.cumsum(shapes)[:-1], axis=-1)
        self._computed |= dict(zip(names, parts, strict=True))

    def _quantity(self, name: str) -> Array:
        if name not in self._computed:
            self.compute(*OUTPUTS)
        return self._computed[name]

    @cached_property
    def euler_zyz(self) -> Array:
        """ZYZ angles (theta, phi, psi) of {E} in {B} [rad], shape (..., N, 3)."""
        return np.asarray(frames.zyz_angles(frames.rotation_matrix(self.quaternion)))

    @cached_property
    def torque(self) -> Array:
        """Torques that act at the actuators [N m], shape (..., N, 3)."""
        if self._state.shape[-1] > 7:
            return self._state[..., 7:10]
        profile = self._model.constants(list(self._columns.inputs)).torque
        if profile is None:
            return np.broadcast_to(self._torque, self.body_rate.shape)
        rows = zip(profile.amplitude, profile.frequency, profile.phase, strict=True)
        return np.stack([a * np.sin(f * self.t + p) for a, f, p in rows], axis=-1)

    def to_xarray(self) -> xr.Dataset:
        """Arrays with the dimension scenario, before it time if there are several; needs xarray."""
        first = ("time", "scenario") if self.t.ndim == 2 else ("scenario",)
        arrays = arrays_of(self, *first) | {"t": (first, self.t, {"units": "s"})}
        coordinates: dict[str, Any] = {"scenario": np.arange(self.t.shape[-1])}
        found: xr.Dataset = require("xarray").Dataset(arrays, coordinates | DIMENSIONS)
        found.attrs["scene"] = self._model.scene.name
        return found


class BatchResult(BatchStates):
    """Results of N scenarios: their states at the end, or the last valid ones.

    Attributes:
        status: 0 where a scenario reached its end, 1 where a limit ended it, -1 where it has no
            start or its numbers ceased to be finite, shape (N,).
        code: 0 at the end, 1 + the index of a limit, NOT_FINITE, < 0 without a start, shape (N,).
        fault_time: when a scenario passed a limit [s], the end of the step in which its numbers
            ceased to be finite, 0 without a start, nan where it reached its end,
            shape (N,).
        local_error: largest local error estimate of a quaternion in a step, shape (N,).
        kept: states every `keep_every` steps from the start on, arrays (samples, N, ...); None
            unless asked for.

    """

    def __init__(
        self,
        *states: Any,
        code: NDArray[np.int64],
        fault_time: Array,
        local_error: Array,
        kept: BatchStates | None,
    ) -> None:
        super().__init__(*states)
        self.code = code
        self.status = np.where((code < 0) | (code == NOT_FINITE), -1, np.sign(code))
        self.fault_time, self.local_error, self.kept = fault_time, local_error, kept

    @cached_property
    def message(self) -> tuple[str, ...]:
        """How each scenario ended, N texts."""
        texts, index = self.reasons
        return tuple(texts[index].tolist())

    @cached_property
    def reasons(self) -> tuple[NDArray[np.object_], NDArray[np.intp]]:
        """The distinct texts of how scenarios ended, and the index of that of each, shape (N,)."""
        limited = (self.code > 0) & (self.code < NOT_FINITE)  # only these depend on the geometry
        # One number for both: of pairs np.unique takes a tenth of the time of a sweep.
        both = np.where(limited, self._columns.geometry, 0) * _CODES + self.code
        found, index = np.unique(both, return_inverse=True)
        texts = []
        for geometry, code in ((one // _CODES, one % _CODES) for one in (found + _HALF).tolist()):
            limits = self._model.limits(self._columns.geometries.of_rows(geometry))
            texts.append(_REASONS.get(code - _HALF) or limits[code - _HALF - 1].reason)
        return np.array(texts, dtype=object), index

    def __len__(self) -> int:
        return len(self.status)

    @property
    def success(self) -> NDArray[np.bool_]:
        """Whether a scenario reached its end, shape (N,)."""
        return np.equal(self.status, 0)

    def to_xarray(self) -> xr.Dataset:
        """Arrays with the dimension scenario; needs the package xarray. See `kept` for times."""
        found = super().to_xarray()
        for name in _SCENARIO:
            found[name] = ("scenario", np.array(getattr(self, name)))
        found["fault_time"].attrs["units"] = "s"
        return found

    def to_pandas(self) -> pd.DataFrame:
        """Table with a row a scenario and a column a number, units in its `attrs`."""
        columns: dict[str, Any] = {name: getattr(self, name) for name in _SCENARIO}
        table: pd.DataFrame = require("pandas").DataFrame(columns | columns_of(self))
        table.index.name = "scenario"
        table.attrs = {"units": UNITS | {"fault_time": "s"}, "scene": self._model.scene.name}
        return table

    def __repr__(self) -> str:
        name, ended = self._model.scene.name, np.count_nonzero(self.status)
        return f"<BatchResult of {name}: {len(self)} scenarios, {ended} ended early>"
