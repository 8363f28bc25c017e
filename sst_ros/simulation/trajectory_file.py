# SPDX-License-Identifier: Apache-2.0
"""Tables, files and pictures of a trajectory."""

from __future__ import annotations

import html as html_text
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sst_ros import state
from sst_ros.errors import InputError, Problem
from sst_ros.extras import MissingDependency, require
from sst_ros.scene.scene import Scene
from sst_ros.scene.yaml_document import dump, read
from sst_ros.simulation.sampled_motion import Law, SampledMotion, T
from sst_ros.simulation.torque_profile import TorqueProfile, profile_from

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.figure import Figure

_KEY = b"sst_ros"
_FORMAT = 1

QUANTITIES = {
    name: (unit, tuple(map(str, state.DIMENSIONS[dimension])))
    for name, (unit, dimension) in state.QUANTITIES.items()
}
"""Unit and names of the parts of each array with more than one column."""

UNITS = {
    "t": "s",
    **{f"{name}_{part}": unit for name, (unit, parts) in QUANTITIES.items() for part in parts},
    "energy": "J",
}
"""Unit of each column of a table."""

_FIGURES = (
    "status", "message", "method", "error_estimate", "energy_residual", "evaluations", "step",
)  # fmt: skip


def frame(trajectory: SampledMotion) -> pd.DataFrame:
    """See `Trajectory.to_pandas`."""
    pd = require("pandas")
    table = pd.DataFrame(_columns(trajectory))
    table.attrs = {"units": UNITS, "scene": trajectory.scene.name}
    return table


def dataset(trajectory: SampledMotion) -> xr.Dataset:
    """See `Trajectory.to_xarray`."""
    package = require("xarray")
    arrays: dict[str, Any] = {
        name: (("time", dimension), getattr(trajectory, name), {"units": unit})
        for name, (unit, dimension) in state.QUANTITIES.items()
    }
    arrays["energy"] = (("time",), trajectory.energy, {"units": "J"})
    coordinates = {"time": ("time", trajectory.t, {"units": "s"}), **state.DIMENSIONS}
    more = {name: getattr(trajectory, name) for name in _FIGURES}
    found: xr.Dataset = package.Dataset(
        arrays, coordinates, {"scene": trajectory.scene.name, **more}
    )
    return found


def save(trajectory: SampledMotion, path: Path, *, overwrite: bool) -> None:
    """See `Trajectory.save`."""
    pa, parquet = require("pyarrow"), require("pyarrow.parquet")

    if path.exists() and not overwrite:
        raise InputError("save", [Problem("path", str(path), "exists; overwrite=True replaces it")])
    metadata = {name: getattr(trajectory, name) for name in _FIGURES} | {
        "format": _FORMAT,
        "scene": dump(trajectory.scene),
        "torque": _torque_record(trajectory.law),
    }
    fields = [pa.field(name, pa.float64(), metadata={"unit": unit}) for name, unit in UNITS.items()]
    schema = pa.schema(fields, metadata={_KEY: json.dumps(metadata).encode()})
    arrays = [pa.array(column) for column in _columns(trajectory).values()]
    unfinished = path.with_name(path.name + ".part")
    try:
        parquet.write_table(pa.Table.from_arrays(arrays, schema=schema), unfinished)
        unfinished.replace(path)
    except OSError as error:
        unfinished.unlink(missing_ok=True)
        allowed = f"must be writable ({error})"
        raise InputError("save", [Problem("path", str(path), allowed)]) from None


def _torque_record(law: Law | None) -> dict[str, Any] | None:
    if law is None:
        return None
    return law.record() if isinstance(law, TorqueProfile) else {"kind": "function"}


def load(cls: type[T], path: Path) -> T:
    """See `Trajectory.load`."""
    pa, parquet = require("pyarrow"), require("pyarrow.parquet")

    allowed = "must be a trajectory that `Trajectory.save` has written"
    try:
        table = parquet.read_table(path)
        metadata = json.loads((table.schema.metadata or {})[_KEY])
    except (OSError, pa.ArrowInvalid) as error:
        raise InputError("load", [Problem("path", str(path), f"{allowed} ({error})")]) from None
    except (KeyError, ValueError):
        raise InputError("load", [Problem("path", str(path), allowed)]) from None
    if metadata["format"] != _FORMAT:
        raise InputError("load", [Problem("format", metadata["format"], f"must be {_FORMAT}")])
    scene = read(Scene, metadata["scene"], str(path))
    arrays = {
        name: np.stack([table[f"{name}_{part}"].to_numpy() for part in parts], axis=1)
        for name, (_, parts) in QUANTITIES.items()
    }
    joints = ("gamma", "mu", "beta", "gamma_dot", "mu_dot", "beta_dot")
    return cls(
        scene,
        table["t"].to_numpy(),
        *(arrays[name] for name in ("quaternion", "body_rate", "torque")),
        joints=np.hstack([arrays[name] for name in joints]),
        law=profile_from(metadata["torque"]),
        **{name: metadata[name] for name in _FIGURES if name in metadata},
    )


def draw(trajectory: SampledMotion) -> Figure:
    """See `Trajectory.plot`."""
    require("matplotlib")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 9.0), layout="constrained")
    panels = figure.subplots(4, 1, sharex=True)
    rows = (("gamma", "rad"), ("gamma_dot", "rad/s"), ("torque", "N m"))
    for axes, (name, unit) in zip(panels, rows, strict=False):
        for k, column in enumerate(getattr(trajectory, name).T, start=1):
            axes.plot(trajectory.t, column, label=f"leg {k}", linewidth=1.2)
        axes.set_ylabel(f"{name} [{unit}]")
        axes.grid(alpha=0.3)
    panels[0].legend(loc="best", ncols=3)
    panels[3].plot(trajectory.t, trajectory.energy, color="black", linewidth=1.2)
    panels[3].set(ylabel="energy [J]", xlabel="time [s]")
    panels[3].grid(alpha=0.3)
    figure.suptitle(f"{trajectory.scene.name}: {trajectory.message}")
    return figure


def html(trajectory: SampledMotion, shown: SampledMotion) -> str:
    """Return a summary as a table, and a picture of `shown` where matplotlib is installed."""
    rows = {
        "scene": trajectory.scene.name,
        "samples": f"{len(trajectory)}, {trajectory.t[0]:g} to {trajectory.t[-1]:g} s",
        "status": f"{trajectory.status}: {trajectory.message}",
        "method": trajectory.method,
        "error estimate": f"{trajectory.error_estimate:.1e} rad",
    }
    cells = "".join(
        f"<tr><th style='text-align:left'>{name}</th><td>{html_text.escape(value)}</td></tr>"
        for name, value in rows.items()
    )
    return f"<table>{cells}</table>{_picture(shown)}"


def _picture(trajectory: SampledMotion) -> str:
    import io

    try:
        figure = draw(trajectory)
    except MissingDependency:
        return ""
    text = io.StringIO()
    figure.savefig(text, format="svg")
    return text.getvalue()[text.getvalue().index("<svg") :]


def _columns(trajectory: SampledMotion) -> dict[str, Any]:
    columns: dict[str, Any] = {"t": trajectory.t}
    for name, (_, parts) in QUANTITIES.items():
        array = getattr(trajectory, name)
        columns |= {f"{name}_{part}": array[:, i] for i, part in enumerate(parts)}
    return columns | {"energy": trajectory.energy}
