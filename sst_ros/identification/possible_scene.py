# SPDX-License-Identifier: Apache-2.0
"""A scene with identified numbers; where its bodies cannot exist, that with the nearest ones."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from sst_ros.errors import InputError
from sst_ros.identification.base_parameters import BaseParameters
from sst_ros.identification.consistency import consistent_values, scales
from sst_ros.identification.least_squares import LinearFit
from sst_ros.identification.parameters import STANDARD
from sst_ros.identification.parameters import values as parameter_values
from sst_ros.identification.scene_numbers import value_of
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import Scene


def possible_scene(
    scene: Scene, names: Sequence[str], numbers: Array, note: str
) -> tuple[Scene, Array, tuple[str, ...]]:
    """Scene with other numbers by key; where its bodies cannot exist, that with the nearest ones.

    Returns:
        The scene, the values in it, and a warning where they are others.

    Raises:
        InputError: other numbers than those of inertias make no scene.

    """
    wanted = dict(zip(names, numbers.tolist(), strict=True))
    sections = sorted({re.split(r"[.\[]", name)[0] for name in names})
    notes = {f"provenance.{section}": note for section in sections}
    try:
        return scene.with_values({**wanted, **notes}), numbers, ()
    except InputError:
        inertias = {name: wanted.pop(name) for name in names if ".inertia." in name}
        if not inertias:
            raise
    changed = scene.with_values(wanted)
    found = _nearest_inertias(changed, list(inertias), np.array(list(inertias.values())))
    adjusted = changed.with_values({**found, **notes})
    values = np.array([value_of(adjusted, name) for name in names], dtype=float)
    warning = "no bodies have the inertias that fit best: the scene has the nearest"
    return adjusted, values, (warning,)


def _nearest_inertias(scene: Scene, names: Sequence[str], numbers: Array) -> dict[str, float]:
    """All entries of the inertias that some entries belong to, of bodies that can exist.

    Args:
        scene: the manipulator.
        names: entries by key, as "star.inertia.zz".
        numbers: their values [kg m^2], which are kept where that is possible.

    """
    bodies = dict.fromkeys(name.partition(".inertia")[0] for name in names)
    entries = tuple(f"{body}.{part}" for body in bodies for part in STANDARD[4:])
    given = parameter_values(scene, entries)
    chosen = tuple(entries.index(name) for name in names)
    base = BaseParameters(entries, chosen, np.eye(len(entries))[list(chosen)])
    root = np.diag(1e6 / scales(entries, given)[list(chosen)])
    covariance = np.asarray(np.linalg.inv(root) ** 2)
    fit = LinearFit(numbers, covariance, root, np.ones(3), np.zeros((0, 3)), 1.0)
    values, _ = consistent_values(entries, given, base, fit, 1.0)
    return dict(zip(entries, values.tolist(), strict=True))
