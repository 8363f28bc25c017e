# SPDX-License-Identifier: Apache-2.0
"""The JSON schema of a document, from the same declarations that check it.

Editors complete and check YAML with it; what no schema can say (inertias, angles that must sum to
360 deg) is left to `read`.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from sst_ros.schema import Section, Spec, specs

_DRAFT = "https://json-schema.org/draft/2020-12/schema"


def json_schema(cls: type[Section], title: str) -> dict[str, Any]:
    """Describe the documents that `read(cls, ...)` accepts."""
    return {"$schema": _DRAFT, "title": title, **_object(cls)}


def _object(cls: type[Section]) -> dict[str, Any]:
    declared = specs(cls)
    required = [
        field.name for field in dataclasses.fields(cls) if field.default is dataclasses.MISSING
    ]
    properties = {name: _property(spec) for name, spec in declared.items()}
    described: dict[str, Any] = {"type": "object", "additionalProperties": False}
    if cls.__doc__:
        described["description"] = cls.__doc__.partition("\n")[0]
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
        lengths = spec.lengths or (0,)
        bounds = {"minItems": min(lengths), "maxItems": max(lengths)}
        return described | {
            "type": "array",
            "items": _object(spec.section),
            **(bounds if spec.lengths else {}),
        }
    if spec.kind == "notes":
        return described | {"type": "object", "additionalProperties": {"type": "string"}}
    return described | {"type": {"flag": "boolean", "texts": "array"}.get(spec.kind, "string")}


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
