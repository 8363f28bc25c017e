# SPDX-License-Identifier: Apache-2.0
"""Documents as nested dicts: values by their keys, as in "star.inertia.zz" or "springs[0].rest"."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np


def replaced(document: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document with other values; a list without an index means all of its entries.

    So does a single value in place of a list of numbers.

    A section that the document does not have is made; None takes a value or a section away.

    Raises:
        KeyError: a key does not fit the document; its argument is the key.

    """
    changed: dict[str, Any] = plain(document)
    for key, value in values.items():
        try:
            _set(changed, str(key).split("."), plain(value))
        except (AttributeError, IndexError, TypeError, ValueError):
            raise KeyError(key) from None
    return changed


def plain(value: Any) -> Any:
    """Turn arrays, NumPy numbers, tuples and mappings into what YAML has."""
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    return value


def _set(section: dict[str, Any], words: list[str], value: Any) -> None:
    parts = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", words[0], re.A)
    if parts is None:
        raise ValueError(words[0])
    name, index = parts.groups()
    if len(words) == 1 and index is not None:
        section[name][int(index)] = value
        return
    if len(words) == 1:
        known = section.get(name)
        if isinstance(known, list) and isinstance(value, (int, float)):
            value = [value] * len(known)
        section.update({name: value})
        if value is None:
            del section[name]
        return
    below = section.setdefault(name, {} if index is None else [])
    entries = below if isinstance(below, list) else [below]
    for entry in entries if index is None else [entries[int(index)]]:
        _set(entry, words[1:], value)
