# SPDX-License-Identifier: Apache-2.0
"""The JSON schema of a document, from the same declarations that check it.

Editors complete and check YAML with it; what no schema can express (inertias, angles that must sum
to 360 deg) is left to `read`.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from sst_ros.scene.schema import Section, Spec

_DRAFT = "https://json-schema.org/draft/2020-12/schema"
_TEXT = {"type": "string", "pattern": "\\S"}


def json_schema(cls: type[Section], title: str) -> dict[str, Any]:
    """Describe the documents that `read(cls, ...)` accepts."""
    return {"$schema": _DRAFT, "title": title, **_object(cls)}


def _object(cls: type[Section]) -> dict[str, Any]:
    described: dict[str, Any] = {"type": "object", "additionalProperties": False}
    if cls.__doc__:
        described["description"] = cls.__doc__.partition("\n")[0]
    properties, required = {}, []
    for field in dataclasses.fields(cls):
        properties[field.name] = _property(field.metadata["spec"])
        if field.default is dataclasses.MISSING:
            required.append(field.name)
        elif isinstance(field.default, (bool, int, float, str)):
            properties[field.name]["default"] = field.default
    return {**described, "properties": properties, "required": required}


def _property(spec: Spec) -> dict[str, Any]:
    unit = f" [{spec.unit}]" if spec.unit else ""
    described: dict[str, Any] = {"description": spec.doc + unit}
    if spec.kind == "number":
        return described | _numbers(spec, spec.shape)
    if spec.kind == "integer":
        return described | {"type": "integer", "minimum": spec.least, "maximum": spec.most}
    if spec.kind == "choice":
        return described | {"enum": list(spec.choices)}
    if spec.kind == "section" and spec.section:
        return _object(spec.section) | described
    if spec.kind == "sections" and spec.section:
        lengths = [{"minItems": length, "maxItems": length} for length in spec.lengths]
        entries = {"type": "array", "items": _object(spec.section)}
        return described | entries | ({"anyOf": lengths} if lengths else {})
    if spec.kind == "notes":
        return described | {"type": "object", "additionalProperties": _TEXT}
    if spec.kind == "texts":
        return described | {"type": "array", "items": _TEXT}
    return described | ({"type": "boolean"} if spec.kind == "flag" else _TEXT)


def _numbers(spec: Spec, shape: tuple[int, ...]) -> dict[str, Any]:
    if shape:
        size = {"minItems": shape[0], "maxItems": shape[0]}
        return {"type": "array", "items": _numbers(spec, shape[1:]), **size}
    bounds = {
        "exclusiveMinimum": spec.above,
        "minimum": spec.least,
        "maximum": spec.most,
    }
    return {"type": "number"} | {name: x for name, x in bounds.items() if math.isfinite(x)}
