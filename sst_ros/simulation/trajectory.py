# SPDX-License-Identifier: Apache-2.0
"""Trajectory: a motion of a scene as arrays over time, simulated or recorded."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.errors import InputError, Problem
from sst_ros.simulation import trajectory_file
from sst_ros.simulation.interpolation import integrated
from sst_ros.simulation.sampled_motion import Array, Law, SampledMotion
from sst_ros.simulation.torque_profile import LostTorque

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.figure import Figure

__all__ = ["JOINTS", "Array", "Law", "Trajectory"]

JOINTS = ("gamma", "mu", "beta", "gamma_dot", "mu_dot", "beta_dot")

_OF_THE_RUN = (
    "status", "message", "method", "error_estimate", "evaluations", "step", "law", "dense",
)  # fmt: skip
_FEW = 300
"""Samples below which a picture asks for more."""


class Trajectory(SampledMotion):
    """A motion over n instants. Arrays are its own, and read-only.

    Args:
        scene: what moves.
        t: times [s], shape (n,), strictly ascending.
        quaternion: orientations (x, y, z, w) of {E} in {B}, shape (n, 4).
        body_rate: angular velocities of the star in {E} [rad/s], shape (n, 3).
        torque: torques that act at the actuators [N m], shape (n, 3), as in `State.torque`.
        joints: angles and rates of the joints where they are known already, shape (n, 18): gamma,
            mu, beta [rad], gamma_dot, mu_dot, beta_dot [rad/s]. By default they are computed.
        status: 0 where the motion reached its end, 1 where a limit ended it, 2 where it reached its
            end with an error estimate above the tolerance, -1 where no step resolved it.
        message: the same in words.
        method: the integrator, and why it was chosen.
        error_estimate: estimated error of the orientation at the end [rad], nan if unknown.
        energy_residual: energy at the end, less that at the start, less the work done [J]; a
            number, or a function that computes it when it is asked for.
        evaluations: how often the derivative was evaluated.
        step: mean length of the steps of the integrator [s], nan if unknown.
        law: torques that act between the samples, for `at`; by default each is held over the
            interval that ends at its sample.
        dense: a function from times (m,) [s] to states (m, 7 or 10) that `at` uses instead.

    Raises:
        InputError: shapes do not fit, or times do not ascend.

    """

    def at(self, t: ArrayLike) -> Trajectory:
        """Sample the motion at other times, ascending, to the accuracy of the run.

        Each state is integrated from the sample before it, under the torques that act there.

        Args:
            t: one time or times [s], shape (m,), within the trajectory.

        Raises:
            InputError: a time lies outside; or between samples that were loaded from a file, of a
                run under a function.

        """
        times = np.atleast_1d(np.asarray(t, dtype=float))
        inside = (times >= self.t[0]) & (times <= self.t[-1])
        if times.ndim != 1 or not np.all(inside):
            allowed = f"must be times from {self.t[0]:g} to {self.t[-1]:g} s, shape (m,)"
            raise InputError("at", [Problem("t", t, allowed)])
        if isinstance(self.law, LostTorque) and not np.all(np.isin(times, self.t)):
            allowed = "must be times of samples: the function of the torques is not in the file"
            raise InputError("at", [Problem("t", t, allowed)])
        y = integrated(self, times)
        kept = {name: getattr(self, name) for name in _OF_THE_RUN}
        residual = lambda: self.energy_residual  # noqa: E731 computed if it is asked for
        return Trajectory(
            self.scene, times, y[:, :4], y[:, 4:7], y[:, 7:], energy_residual=residual, **kept
        )

    def to_pandas(self) -> pd.DataFrame:
        """Table with a row an instant and a column a number, units in its `attrs`."""
        return trajectory_file.frame(self)

    def to_xarray(self) -> xr.Dataset:
        """Arrays with the dimensions time, leg, axis and part; needs the package xarray."""
        return trajectory_file.dataset(self)

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write a Parquet file that `load` reads back to the bit, units and scene included.

        Raises:
            InputError: the file exists, unless `overwrite`.
            MissingDependency: pyarrow is not installed.

        """
        trajectory_file.save(self, Path(path), overwrite=overwrite)

    @classmethod
    def load(cls, path: str | Path) -> Trajectory:
        """Read a file that `save` has written.

        Raises:
            InputError: there is no such file, or it holds no trajectory.

        """
        return trajectory_file.load(cls, Path(path))

    def plot(self) -> Figure:
        """Draw actuator angles, rates, torques and the energy over time; needs matplotlib."""
        return trajectory_file.draw(self._dense_enough())

    def __repr__(self) -> str:
        span = f"{self.t[0]:g} to {self.t[-1]:g} s" if len(self) else "no samples"
        return (
            f"<Trajectory of {self.scene.name}: {len(self)} samples, {span}; {self.message}; "
            f"{self.method}; error estimate {self.error_estimate:.1e} rad>"
        )

    def _repr_html_(self) -> str:
        return trajectory_file.html(self, self._dense_enough())

    def _dense_enough(self) -> Trajectory:
        """Return a trajectory with samples enough for a picture."""
        if not 2 <= len(self.t) < _FEW or isinstance(self.law, LostTorque):
            return self
        return self.at(np.union1d(self.t, np.linspace(self.t[0], self.t[-1], _FEW)))
