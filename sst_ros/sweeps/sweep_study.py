# SPDX-License-Identifier: Apache-2.0
"""A study of many runs as one document: checked before anything runs, identified by a digest."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sst_ros.control.law import ControlChannel, ControllerSettings
from sst_ros.control.reference import ReferenceMotion
from sst_ros.control.reference_motions import reference_motion
from sst_ros.errors import InputError, Problem, suggestion
from sst_ros.scene.scene import Scene, SineTorque, scene_of
from sst_ros.scene.schema import Section, anything, choice, integer, number, specs, texts
from sst_ros.scene.yaml_document import plain, values_of
from sst_ros.state import QUANTITIES, finite_vector
from sst_ros.sweeps.variations import (
    LARGEST_HYPERCUBE,
    SAMPLINGS,
    Sampler,
    Target,
    Variation,
    digest_of,
    keys_of,
    read_table,
    read_variation,
    scales_tensor,
    tabulate,
    targets_of,
)

DEFAULT_OUTPUTS = ("gamma", "gamma_dot", "quaternion", "body_rate", "energy")

CHUNK = 32_768
"""Rows of a chunk by default: a second of work, and a power of two, as Sobol points want."""

OUTPUTS = (*QUANTITIES, "energy", "extremes")
"""What `outputs` may name: quantities of the final state, and extremes of joints."""

MOST_ROWS, MOST = 2**53, 10_000_000


@dataclass(frozen=True)
class SweepStudy(Section):
    """Many runs of a scene.

    Raises:
        InputError: a value is not allowed; the message names its key and what is allowed.

    """

    ORIGIN = "sweep"

    scene: Scene = anything("what is simulated")
    vary: Mapping[str, Any] = anything(
        "distribution or values by key of the scene, see `variations`", default_factory=dict
    )
    n: int | None = integer(
        "number of runs; by default that of the grid or of the table",
        default=None,
        least=1,
        most=MOST_ROWS,
    )
    seed: int = integer("of the random numbers", default=0, least=0, most=2**64 - 1)
    sampling: str = choice("of random numbers", SAMPLINGS, default="random")
    table: Mapping[str, Any] | None = anything(
        "values by column, in place of distributions", default=None
    )
    duration: float | None = number(
        "length of a run; by default that of the scene, or of its motion if controlled",
        "s",
        default=None,
        above=0.0,
    )
    tolerance: float = number(
        "largest error of the orientation at the end, for the number of steps",
        "rad",
        default=1e-9,
        above=0.0,
    )
    steps: int | None = integer(
        "number of steps of a run; chosen by the tolerance if not given",
        default=None,
        least=1,
        most=MOST,
    )
    torque: Any = anything(
        "None for the scene's own torques if it has some, else zero; three constant torques [N m]; "
        "or a SineTorque as a mapping",
        default=None,
    )
    control: Mapping[str, Any] | None = anything(
        "settings of a controller and its channel, see `ControlChannel`", default=None
    )
    outputs: tuple[str, ...] = texts(
        "quantities of the final state, and `extremes` of joints at the ends of the steps",
        default=DEFAULT_OUTPUTS,
    )
    trajectory: Mapping[str, int] | None = anything(
        "{rows: m, samples: k}: k + 1 states of each of the first m runs", default=None
    )
    chunk: int = integer("rows of a task and of a file", default=CHUNK, least=1, most=MOST)

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.variations, self.rows, self.length, self.controlled

    def check(self) -> Iterator[Problem]:
        """Refuse outputs, torques and trajectories that are none."""
        for name in self.outputs:
            if name not in OUTPUTS:
                yield Problem("outputs", name, f"must be of {', '.join(OUTPUTS)}")
        torque, kept = self.torque, self.trajectory
        if torque is not None and self.control is not None:
            yield Problem("torque", "given", "has no effect: the controller gives the torques")
        constant = not isinstance(torque, (Mapping, SineTorque, type(None)))
        if constant and finite_vector(torque) is None:
            yield Problem("torque", torque, "must be three finite numbers [N m] or a mapping")
        good = isinstance(kept, Mapping) and kept.keys() == {"rows", "samples"}
        if kept is not None and not (
            good and all(type(x) is int and 1 <= x <= 100_000 for x in kept.values())
        ):
            allowed = "must be {rows: m, samples: k}, whole numbers from 1 to 100000"
            yield Problem("trajectory", kept, allowed)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what was given, not what has been computed from it."""
        return _build_study, ({name: getattr(self, name) for name in specs(SweepStudy)},)

    @classmethod
    def read(cls, path: Path) -> SweepStudy:
        """Read a YAML file; `scene` is a name, a path relative to the file, or a document."""
        try:
            values = yaml.safe_load(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            allowed = f"must be a readable .yaml file ({error})"
            raise InputError("sweep", [Problem("STUDY", str(path), allowed)]) from None
        if not isinstance(values, dict) or not isinstance(values.get("vary", {}), dict):
            allowed = "must be a mapping with the keys scene and vary"
            raise InputError(str(path), [Problem("", type(values).__name__, allowed)])
        return cls.from_values(values, path.parent)

    @classmethod
    def from_values(cls, values: Mapping[str, Any], folder: Path = Path()) -> SweepStudy:
        """Build a study from a mapping."""
        known = specs(cls)
        for key in values:
            if key not in known:
                hint = suggestion(str(key), known)
                allowed = f"unknown key; allowed are {', '.join(known)}{hint}"
                raise InputError("sweep", [Problem(str(key), values[key], allowed)])
        given = dict(values)
        scene, table = given.pop("scene", None), given.pop("table", None)
        if isinstance(scene, str) and (folder / scene).is_file():
            scene = folder / scene
        if isinstance(table, str):
            table = read_table(folder / table)
        return cls(scene=scene_of(scene), table=table, **given)

    @cached_property
    def model_scene(self) -> Scene:
        """The scene with the torques of the study: none of its own where a controller acts."""
        if self.control is not None:
            return dataclasses.replace(self.scene, torque=None)
        if self.torque is None:
            return self.scene
        if isinstance(self.torque, SineTorque):
            return dataclasses.replace(self.scene, torque=self.torque)
        if isinstance(self.torque, Mapping):
            return self.scene.with_values({"torque": dict(self.torque)})
        constant = {
            "amplitude": list(self.torque),
            "frequency": [0.0] * 3,
            "phase": [math.pi / 2] * 3,
        }
        return self.scene.with_values({"torque": constant})

    @cached_property
    def controlled(self) -> ControlledRun | None:
        """The control loop; None without one."""
        return None if self.control is None else read_control(self.scene, self.control)

    @cached_property
    def length(self) -> float:
        """Length of a run [s]."""
        duration = self.duration
        if duration is None and self.controlled is not None:
            duration = self.controlled.motion.duration
        duration = duration or self.scene.duration
        if duration is None:
            allowed = "must be given [s]: the scene has none"
            raise InputError("sweep", [Problem("duration", None, allowed)])
        return duration

    @cached_property
    def variations(self) -> tuple[Variation, ...]:
        """What varies, key by key."""
        found, problems = [], []
        for key, given in self.vary.items():
            try:
                found.append(read_variation(key, given, self._targets(key)))
            except (ValueError, TypeError, OverflowError) as error:
                problems.append(Problem(f"vary.{key}", given, str(error)))
        columns = [name for one in found for name in one.columns]
        for key, names in keys_of(self.table or {}).items():
            try:
                targets = self._targets(key)
                if key in self.vary or set(names) & set(columns):
                    raise ValueError("is given in vary, too")
                factor = scales_tensor(key, targets)
                found.append(tabulate(key, names, targets, factor))
            except ValueError as error:
                problems.append(Problem(f"table.{key}", "given", str(error)))
        if not found:
            problems.append(Problem("vary", None, "must name at least one key of the scene"))
        if problems:
            raise InputError("sweep", problems)
        return tuple(found)

    @cached_property
    def rows(self) -> int:
        """Number of runs."""
        grid = math.prod(len(one.numbers) for one in self.variations if one.kind == "grid")
        lengths = {len(values) for values in (self.table or {}).values()}
        drawn = any(one.kind in ("uniform", "normal") for one in self.variations)
        natural = min(lengths) if lengths else grid
        if len(lengths) > 1 or (lengths and grid > 1):
            allowed = "must have columns of equal length, and no grid beside it"
            raise InputError("sweep", [Problem("table", sorted(lengths), allowed)])
        if self.n is None and drawn and not lengths and grid == 1:
            raise InputError("sweep", [Problem("n", None, "must be given with distributions")])
        rows = natural if self.n is None else self.n
        if (lengths and rows > natural) or (grid > 1 and rows % grid):
            allowed = f"must be <= {natural}, the rows of the table"
            allowed = allowed if lengths else f"must be a multiple of {grid}, the size of the grid"
            raise InputError("sweep", [Problem("n", rows, allowed)])
        if self.sampling == "latin_hypercube" and rows > LARGEST_HYPERCUBE:
            allowed = f"must be <= {LARGEST_HYPERCUBE} with latin_hypercube; use sobol"
            raise InputError("sweep", [Problem("n", rows, allowed)])
        return rows

    @cached_property
    def sampler(self) -> Sampler:
        """Rows of what varies."""
        table = {
            name: np.asarray(values, dtype=float) for name, values in (self.table or {}).items()
        }
        return Sampler(self.variations, table, self.rows, self.seed, self.sampling)

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return -(-self.rows // self.chunk)

    def document(self) -> dict[str, Any]:
        """Return the study as nested dicts and lists; a table as its digest."""
        values = {name: getattr(self, name) for name in specs(SweepStudy)}
        values["scene"] = values_of(self.scene)
        if isinstance(self.torque, SineTorque):
            values["torque"] = values_of(self.torque)
        if self.table is not None:
            values["table"] = {key: digest_of(np.asarray(x)) for key, x in self.table.items()}
        document: dict[str, Any] = plain(values)
        return document

    @cached_property
    def digest(self) -> str:
        """Digest of the document: two studies with the same one have the same rows."""
        text = json.dumps(self.document(), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:24]

    def _targets(self, key: str) -> list[Target]:
        if key.partition(".")[0] == "control":
            if self.controlled is None:
                raise ValueError("acts with control only")
            return self.controlled.targets(key)
        if key == "initial.orientation" or key.partition(".")[0] in ("motion", "duration"):
            raise ValueError("cannot vary")
        if key.partition(".")[0] == "torque" and self.control is not None:
            raise ValueError("has no effect: the controller gives the torques")
        return targets_of(self.model_scene, key)


def _build_study(values: Mapping[str, Any]) -> SweepStudy:
    return SweepStudy(**values)


@dataclass(frozen=True)
class ControlledRun:
    """A control loop.

    Attributes:
        model: the controller's model of the plant, which does not vary.
        motion: reference motion, that of the scene.
        settings: scheme and gains.
        channel: period, delay, encoders, noise.

    """

    model: Scene
    motion: ReferenceMotion
    settings: ControllerSettings
    channel: ControlChannel

    def targets(self, key: str) -> list[Target]:
        """Return what a key control.* names."""
        name = key.removeprefix("control.")
        for given in (self.settings, self.channel):
            spec = specs(type(given)).get(name)
            if spec is not None and spec.kind == "number" and name != "period":
                return [Target(key, np.array(getattr(given, name), dtype=float), spec)]
        known = [*_numbers(ControllerSettings), *_numbers(ControlChannel)]
        raise ValueError(f"must be one of {', '.join(f'control.{name}' for name in known)}")


def read_control(scene: Scene, given: Mapping[str, Any]) -> ControlledRun:
    """Read the settings of a control loop: those of a controller and of its channel.

    Raises:
        InputError: a key is unknown or its value not allowed, or the scene has no motion.

    """
    controller, channel = specs(ControllerSettings), specs(ControlChannel)
    known = (*controller, *channel)
    allowed = f"unknown key; allowed are {', '.join(known)}"
    unknown = [Problem(f"control.{key}", given[key], allowed) for key in given if key not in known]
    if unknown:
        raise InputError("sweep", unknown)
    motion = reference_motion(scene)
    return ControlledRun(
        scene,
        motion,
        ControllerSettings(**{key: value for key, value in given.items() if key in controller}),
        ControlChannel(**{key: value for key, value in given.items() if key in channel}),
    )


def _numbers(cls: type[Section]) -> list[str]:
    return [name for name, spec in specs(cls).items() if spec.kind == "number" and name != "period"]
