# SPDX-License-Identifier: Apache-2.0
"""Numbers of a scene by key, as "friction.gamma.viscous" or "actuated_links[0].mass"."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

from sst_ros.scene.bodies import Inertia
from sst_ros.scene.loads import Actuators, Friction
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import Section

JOINT_KINDS = ("gamma", "mu", "beta")


def value_of(scene: Scene, name: str) -> float | None:
    """Return a number of a scene by its key, the first of a list; None where there is none."""
    try:
        value = at(scene, re.findall(r"\w+", name))
    except (AttributeError, IndexError, TypeError):
        return None
    return float(value) if isinstance(value, (int, float)) else None


def at(value: Any, words: Sequence[str]) -> Any:
    """Return what a key, split in words, names; of a list without index the first entry."""
    for word in words:
        if value is None:
            return None
        if isinstance(value, (tuple, list)):
            if not word.isdigit():
                value = getattr(value[0], word)
                continue
            value = value[int(word)]
        else:
            value = getattr(value, word)
    return value[0] if isinstance(value, (tuple, list)) else value


def opened(value: Any) -> Any:
    """Return a section as an object whose fields may be set to anything, tuples as lists."""
    if isinstance(value, Section):
        return SimpleNamespace(**{f.name: opened(getattr(value, f.name)) for f in fields(value)})
    return [opened(entry) for entry in value] if isinstance(value, tuple) else value


def set_number(value: Any, words: Sequence[str], symbol: Any) -> None:
    """Set a number of an `opened` section; a list without an index means all of its entries."""
    first, *rest = words
    if isinstance(value, list):
        if not first.isdigit():
            for entry in value:
                set_number(entry, words, symbol)
        elif rest:
            set_number(value[int(first)], rest, symbol)
        else:
            value[int(first)] = symbol
        return
    known = vars(value)
    if rest:
        if known.get(first) is None:
            known[first] = _absent(first)
        set_number(known[first], rest, symbol)
    elif isinstance(known.get(first), list):
        known[first] = [symbol] * len(known[first])
    else:
        known[first] = symbol


def _absent(name: str) -> SimpleNamespace:
    """Return an empty section for a term that the scene does not have."""
    if name == "friction":
        return SimpleNamespace(gamma=None, mu=None, beta=None)
    if name == "inertia":
        return SimpleNamespace(**dict.fromkeys((f.name for f in fields(Inertia)), 0.0))
    sections: dict[str, type[Section]] = {
        "actuators": Actuators,
        **dict.fromkeys(JOINT_KINDS, Friction),
    }
    return SimpleNamespace(**{f.name: f.default for f in fields(sections[name])})
