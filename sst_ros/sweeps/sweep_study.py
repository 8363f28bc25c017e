# SPDX-License-Identifier: Apache-2.0
"""A study of many runs as one document.

It is checked before anything runs, and identified by a digest.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import re
import warnings
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sst_ros.control.actuator_space import ReferenceMotion
from sst_ros.control.law import ControlChannel, ControllerSettings
from sst_ros.control.reference_motions import reference_motion
from sst_ros.errors import InputError, Problem, refuse_errors, refuse_unless
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import Scene, scene_of
from sst_ros.scene.schema import (
    Rules,
    Section,
    anything,
    build,
    choice,
    entry,
    positive,
)
from sst_ros.scene.torque_profile import SineTorque
from sst_ros.scene.yaml_document import plain, read_file, read_values, resolve_numbers
from sst_ros.state import QUANTITIES, cached_property, finite_vector
from sst_ros.sweeps.variations import (
    SAMPLINGS,
    TINY,
    Target,
    Variation,
    philox,
    read_table,
    read_variation,
    tabulate,
    targets_of,
)

DEFAULT_OUTPUTS = ("gamma", "gamma_dot", "quaternion", "body_rate", "energy")

CHUNK_ROWS = 32_768
"""Rows of a chunk by default.

They are a second of work, and a power of two, as Sobol points want.
"""

SWEEP_OUTPUTS = (*QUANTITIES, "energy", "extremes", "reactions")
"""What `outputs` may name.

Extremes of joints and reactions are those over a run, all else is of the final state.
"""

MOST_COUNT = 10_000_000  # of steps of a run, and of rows of a chunk
MOST_RUNS_OF_STUDY = 1_000_000_000
"""Some 200 GB, which take two weeks at 1000 runs a second."""

_DIGEST_DIGITS = 24  # of the 64 of a SHA-256

_count: Any = partial(entry, default=None, least=1, most=MOST_COUNT)
# what all runs share: a mode of assembly, ticks, a motion and its length
_FIXED_KEYS = ("initial.orientation", "control.period")
_FIXED_SECTIONS = ("motion", "duration")
_NO_TORQUE = "has no effect: the controller gives the torques"


class SampledControl(ControlChannel, ControllerSettings):
    """A controller, and the channel between it and the plant."""


class SweepStudy(Section):
    """Many runs of a scene.

    Raises InputError with the key of a value that is not allowed.
    """

    ORIGIN = "sweep"

    scene: Scene = anything("what is simulated")
    vary: Mapping[str, Any] = anything(
        "distribution or values by key of the scene, see `variations`",
        default_factory=dict,
    )
    n: int | None = _count(
        "number of runs; by default that of the grid or of the table",
        most=MOST_RUNS_OF_STUDY,
    )
    seed: int = entry("of the random numbers", default=0, least=0, most=2**64 - 1)
    sampling: str = choice("of random numbers", SAMPLINGS)
    table: Any = anything(
        "values by column in place of distributions: DataFrame, mapping or file",
        default=None,
    )
    duration: float | None = positive(
        "length of a run; by default that of the scene, or of its motion", "s"
    )
    tolerance: float = positive(
        "error of the orientation at the end, for the number of steps",
        "rad",
        default=1e-9,
    )
    steps: int | None = _count("number of steps of a run; by default by the tolerance")
    torque: Any = anything(
        "None for the scene's own torques if it has some, else zero; three constant"
        " torques [N m]; or a SineTorque as a mapping",
        default=None,
    )
    control: SampledControl | None = entry(
        "settings of a controller and its channel, also as a mapping; see"
        " `ControlChannel`"
    )
    outputs: tuple[str, ...] = entry(
        "quantities of the final state; `extremes` of joints, and peak and RMS of"
        " `reactions`, at the ends of the steps",
        default=DEFAULT_OUTPUTS,
    )
    chunk: int = _count("rows of a task and of a file", default=CHUNK_ROWS)

    def __post_init__(self) -> None:
        object.__setattr__(self, "scene", scene_of(self.scene))
        if self.table is not None:
            object.__setattr__(self, "table", read_table(self.table))
        super().__post_init__()
        _ = self.variations, self.rows, self.length

    def rules(self) -> Rules:
        """Refuse keys, outputs and torques that are none."""
        torque = self.torque
        is_mapping = isinstance(self.vary, Mapping)
        requirement = (
            "must be a mapping from keys of the scene to distributions or values"
        )
        yield not is_mapping, "vary", self.vary, requirement
        requirement = f"must be of {', '.join(SWEEP_OUTPUTS)}"
        for name in self.outputs:
            yield name not in SWEEP_OUTPUTS, "outputs", name, requirement
        if torque is None:
            return
        yield self.control is not None, "torque", "given", _NO_TORQUE
        is_profile = isinstance(torque, (Mapping, SineTorque))
        wrong = not is_profile and finite_vector(torque) is None
        yield wrong, "torque", torque, "must be three finite numbers [N m] or a mapping"

    def __getstate__(self) -> dict[str, Any]:
        """Pickle what was given, not what has been computed from it."""
        return {name: getattr(self, name) for name in SweepStudy.SPECS}

    @classmethod
    def read(cls, path: Path) -> SweepStudy:
        """Read a YAML file.

        `scene` is a name, a path relative to the file, or a document.
        """
        requirement = "must be a readable .yaml file"
        unreadable = (OSError, UnicodeDecodeError)
        with refuse_errors("sweep", "STUDY", str(path), requirement, *unreadable):
            source = read_file(path)
        values = read_values(source, str(path))
        mapping = isinstance(values, dict) and isinstance(values.get("vary", {}), dict)
        requirement = "must be a mapping with the keys scene and vary"
        refuse_unless(str(path), ("", type(values).__name__, mapping, requirement))
        # Sections take numbers as text; what only `rules` check has them as numbers.
        for name in ("vary", "table", "torque"):
            if name in values:
                values[name] = resolve_numbers(values[name])
        return cls.from_values(values, path.parent)

    @classmethod
    def from_values(
        cls, values: Mapping[str, Any], folder: Path = Path()
    ) -> SweepStudy:
        """Build a study from a mapping; names of files are relative to a folder."""
        settings: dict[str, Any] = {"scene": None}
        settings |= {key: value for key, value in values.items() if value is not None}
        scene = settings["scene"]
        # Of os.path, which is False where a name is too long for the file system.
        if isinstance(scene, str) and os.path.isfile(folder / scene):  # noqa: PTH113
            settings["scene"] = folder / scene
        if isinstance(settings.get("table"), str):
            settings["table"] = folder / settings["table"]
        # else the unknown ones say more than no scene
        if settings.keys() <= cls.SPECS.keys():
            settings["scene"] = scene_of(settings["scene"])
        return build(cls, settings, "sweep")

    @cached_property
    def model_scene(self) -> Scene:
        """The scene with the study's torques, none of its own under a controller."""
        torque = self.torque
        if self.control is not None or isinstance(torque, SineTorque):
            return dataclasses.replace(self.scene, torque=torque)
        if torque is None:
            return self.scene
        # constant: a sine that stays at its largest value
        if not isinstance(torque, Mapping):
            torque = {
                "amplitude": list(torque),
                "frequency": [0.0] * 3,
                "phase": [math.pi / 2] * 3,
            }
        return self.scene.with_values({"torque": dict(torque)})

    @cached_property
    def motion(self) -> ReferenceMotion | None:
        """The motion of the scene that a controller follows; None without one."""
        return None if self.control is None else reference_motion(self.scene)

    @cached_property
    def length(self) -> float:
        """Length of a run [s]."""
        moving = None if self.motion is None else self.motion.duration
        duration = self.duration or moving or self.scene.duration or 0.0
        requirement = "must be given [s]: the scene has none"
        refuse_unless("sweep", ("duration", None, duration > 0.0, requirement))
        return duration

    @cached_property
    def variations(self) -> tuple[Variation, ...]:
        """What varies, key by key."""
        variations: list[Variation] = []
        problems = []
        distributions = {str(key): value for key, value in self.vary.items()}
        for key, distribution in distributions.items():
            try:
                variations.append(read_variation(key, distribution, self._targets(key)))
            except (ValueError, TypeError, OverflowError, MemoryError) as error:
                problems.append(Problem(f"vary.{key}", distribution, str(error)))
        columns: dict[str, dict[str, Any]] = {}
        # a trailing index is that of a component
        for name, column in (self.table or {}).items():
            columns.setdefault(re.sub(r"(\[\d+\])+$", "", name), {})[name] = column
        taken = {name for variation in variations for name in variation.columns}
        for key, own in columns.items():
            try:
                if key in self.vary or taken & own.keys():
                    raise ValueError("is given in vary, too")
                variations.append(tabulate(key, own, self._targets(key)))
            except ValueError as error:
                problems.append(Problem(f"table.{key}", "given", str(error)))
        if not (variations or problems):
            requirement = "must name at least one key of the scene"
            problems.append(Problem("vary", dict(self.vary), requirement))
        if problems:
            raise InputError("sweep", problems)
        return tuple(variations)

    @cached_property
    def rows(self) -> int:
        """Number of runs."""
        grids = [variation for variation in self.variations if variation.kind == "grid"]
        grid = math.prod(len(variation.numbers) for variation in grids)
        lengths = {len(values) for values in (self.table or {}).values()}
        alone = len(lengths) <= 1 and not (lengths and grid > 1)
        requirement = "must have columns of equal length, and no grid beside it"
        refuse_unless("sweep", ("table", sorted(lengths), alone, requirement))
        natural = min(lengths, default=grid)
        rows = self.n or natural
        is_given = bool(self.n or lengths or grid > 1)
        is_drawn = any(variation.drawn for variation in self.variations)
        fits = not lengths or rows <= natural
        multiple = f"must be a multiple of {grid}, the size of the grid"
        refuse_unless(
            "sweep",
            ("n", self.n, is_given or not is_drawn, "must be given with distributions"),
            ("n", self.n, fits, f"must be <= {natural}, the rows of the table"),
            ("n", self.n, rows % grid == 0, multiple),
        )
        return rows

    def draw(self, first: int, count: int, sampling: str = "") -> dict[str, Array]:
        """Draw rows `first` to `first + count`: (count, components) by varied key."""
        quantiles = self._quantiles(first, count, sampling or self.sampling)
        drawn = {}
        used = 0  # columns of the quantiles
        for variation in self.variations:
            if variation.drawn:
                width = len(variation.columns)
                own_quantiles = quantiles[:, used : used + width]
                drawn[variation.key] = variation.values(own_quantiles)
                used += width
            else:
                drawn[variation.key] = variation.numbers[first : first + count]
        index = np.arange(first, first + count)
        # The last key of a grid varies fastest.
        for variation in reversed(self.variations):
            if variation.kind == "grid":
                drawn[variation.key] = variation.numbers[index % len(variation.numbers)]
                index = index // len(variation.numbers)
        return drawn

    @cached_property
    def _width(self) -> int:
        """Numbers that are drawn for a row."""
        drawn = [variation for variation in self.variations if variation.drawn]
        return sum(len(variation.columns) for variation in drawn)

    def _quantiles(self, first: int, count: int, sampling: str) -> Array:
        """Numbers in (0, 1), shape (count, width)."""
        if sampling == "random" or not self._width:
            return philox(self.seed, first, count, self._width)
        from scipy.stats import qmc

        engine = qmc.Sobol(self._width, seed=np.random.default_rng(self.seed))
        if first:
            engine.fast_forward(first)
        with warnings.catch_warnings():  # that a chunk of rows is no power of two
            warnings.simplefilter("ignore", UserWarning)
            return np.asarray(np.clip(engine.random(count), TINY, 1.0 - TINY))

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return -(-self.rows // self.chunk)

    def rows_of(self, chunk: int) -> range:
        """Return the rows of a chunk."""
        return range(self.rows)[chunk * self.chunk : (chunk + 1) * self.chunk]

    def document(self) -> dict[str, Any]:
        """Return the study as nested dicts and lists.

        A table is in it as digests of its columns.
        """
        values = self.__getstate__()
        if self.table is not None:
            values["table"] = {
                name: make_digest(column.tobytes())
                for name, column in self.table.items()
            }
        return dict(plain(values))

    @cached_property
    def digest(self) -> str:
        """Digest of the document: two studies with the same one have the same rows."""
        return make_digest(json.dumps(self.document(), sort_keys=True).encode())

    def _targets(self, key: str) -> list[Target]:
        """Return what a key of `vary` names; ValueError where it cannot vary."""
        section, _, name = key.partition(".")
        if section == "control" and self.control is None:
            raise ValueError("acts with control only")
        if key in _FIXED_KEYS or section in _FIXED_SECTIONS:
            raise ValueError("cannot vary")
        if section == "control" and self.control is not None:
            return targets_of(self.control, name, ("control",))
        if section == "torque" and self.control is not None:
            raise ValueError(_NO_TORQUE)
        return targets_of(self.model_scene, key)


def make_digest(content: bytes) -> str:
    """Return the first digits of a SHA-256."""
    return hashlib.sha256(content).hexdigest()[:_DIGEST_DIGITS]
