# SPDX-License-Identifier: Apache-2.0
"""The table of motion: quantities with units over time, scenarios, or both."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from sst_ros.errors import require
from sst_ros.mechanism.geometry import Array, rotation_matrix, zyz_angles
from sst_ros.scene.scene import Scene
from sst_ros.state import (
    DIMENSIONS,
    MOTION_UNITS,
    QUANTITIES,
    Explained,
    ReadOnly,
    cached_property,
    freeze,
)

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

JOINT_QUANTITIES = ("gamma", "mu", "beta", "gamma_dot", "mu_dot", "beta_dot")


def _of_joints(name: str, meaning: str) -> Any:
    return property(lambda table: table._joint(name), doc=f"{meaning}, shape (..., 3).")


class MotionTable(Explained, ReadOnly):
    """Quantities of a motion at n instants, of N scenarios, or of both, (n, N).

    In shapes, ... is that of t. Arrays are read-only. A `Trajectory` is one motion, a
    `BatchResult` many scenarios.

    Attributes:
        scene: what moves.
        t: times [s], shape (...).
        quaternion: orientations (x, y, z, w) of {E} in {B}, shape (..., 4).
        body_rate: angular velocities of the star in {E} [rad/s], shape (..., 3).

    """

    _axes: tuple[str, ...] = ("time",)
    """Names of the axes of t."""

    scene: Scene
    t: Array
    quaternion: Array
    body_rate: Array
    torque: Any
    energy: Any

    def _joint(self, name: str) -> Array:
        """Return one of JOINT_QUANTITIES, shape (..., 3)."""
        raise NotImplementedError

    gamma = _of_joints("gamma", "Angles of the actuators [rad]")
    mu = _of_joints("mu", "Angles between base arcs and arcs of the star [rad]")
    beta = _of_joints("beta", "Angles from the carriages to E [rad]")
    gamma_dot = _of_joints("gamma_dot", "Rates of gamma [rad/s]")
    mu_dot = _of_joints("mu_dot", "Rates of mu [rad/s]")
    beta_dot = _of_joints("beta_dot", "Rates of beta [rad/s]")

    @cached_property
    def euler_zyz(self) -> Array:
        """ZYZ angles (theta, phi, psi) of {E} in {B} [rad], shape (..., 3)."""
        return freeze(zyz_angles(rotation_matrix(self.quaternion)))

    def columns(
        self, names: Iterable[str] = (*QUANTITIES, "energy")
    ) -> dict[str, Array]:
        """Return the time and these quantities, a column a number.

        The names are those of `state.MOTION_UNITS`. Each has the shape of t.
        """
        columns: dict[str, Array] = {"t": self.t}
        for name in names:
            array = getattr(self, name)
            if name in QUANTITIES:
                components = enumerate(DIMENSIONS[QUANTITIES[name][1]])
                for i, component in components:
                    columns[f"{name}_{component}"] = array[..., i]
            else:
                columns[name] = array
        return columns

    def _of_each(self) -> dict[str, tuple[Any, str]]:
        """Return what is known of each scenario beside its motion, with units."""
        return {}

    def _of_run(self) -> dict[str, Any]:
        """Return what is known of the run as a whole."""
        return {}

    def to_pandas(self) -> pd.DataFrame:
        """Return a table with a row an instant or a scenario, a column a number.

        Units are in its `attrs`.
        """
        scenario_columns = self._of_each()
        columns = {name: values for name, (values, _) in scenario_columns.items()}
        columns |= self.columns()
        table: pd.DataFrame = require("pandas").DataFrame(columns)
        units = {name: unit for name, (_, unit) in scenario_columns.items() if unit}
        table.attrs = {"units": MOTION_UNITS | units, "scene": self.scene.name}
        if self._axes != ("time",):
            table.index.name = self._axes[-1]
        return table

    def to_xarray(self) -> xr.Dataset:
        """Return arrays with the dimensions time, scenario, leg, axis and part.

        It needs xarray.
        """
        axes = self._axes
        arrays: dict[str, Any] = {}
        for name, (unit, dimension) in QUANTITIES.items():
            arrays[name] = (*axes, dimension), getattr(self, name), {"units": unit}
        arrays["energy"] = axes, self.energy, {"units": "J"}
        for name, (values, unit) in self._of_each().items():
            units = {"units": unit} if unit else {}
            arrays[name] = "scenario", np.array(values), units
        seconds = {"units": "s"}
        if "scenario" in axes:
            arrays["t"] = axes, self.t, seconds
            coordinates: dict[str, Any] = {"scenario": np.arange(self.t.shape[-1])}
        else:
            coordinates = {"time": ("time", self.t, seconds)}
        attributes = {"scene": self.scene.name} | self._of_run()
        dataset: xr.Dataset = require("xarray").Dataset(
            arrays, coordinates | DIMENSIONS, attributes
        )
        return dataset

    def __len__(self) -> int:
        return int(self.t.shape[-1])
