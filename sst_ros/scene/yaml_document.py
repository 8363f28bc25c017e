# SPDX-License-Identifier: Apache-2.0
"""A document as YAML text, as nested values, and as numbers with keys.

Text is read into nested dicts and lists, which are built into a checked `Section`, and
back; every fault has its key and its line. A key is "star.inertia.zz" or
"springs[0].rest"; a list without an index means all of its entries. The JSON schema is
from the same declarations: editors complete and check YAML with it; what no schema can
express (inertias, angles that must sum to 360 deg) is left to reading.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sst_ros.errors import InputError, Problem, check_regular, refusal
from sst_ros.scene.schema import NUMBER, REQUIRED, Place, S, Section, Spec, build
from sst_ros.state import LostMeaning, find_lost_meaning

NO_NUMBER = "must name a number, as star.mass does"

_WHOLE = re.compile("[-+]?[0-9]{1,18}")  # longer ones are doubles
_INFINITE = re.compile(r"[-+]?\.inf")

LONGEST_DOCUMENT = 1_000_000  # characters
MOST_NODES = 20_000
DEEPEST_DOCUMENT = 20
LIMITS_TEXT = (
    f"no more than {LONGEST_DOCUMENT} characters, {MOST_NODES} values and"
    f" {DEEPEST_DOCUMENT} levels are allowed, and no aliases"
)
"""Of a document: PyYAML reads 20,000 values in 0.5 s, and its time grows with the
square of the levels.
"""


class _Loader(yaml.SafeLoader):
    """PyYAML's reader, which refuses aliases and documents beyond a limit.

    It ends at the first event that breaks a limit.
    """

    depth = nodes = 0

    def get_event(self) -> yaml.Event:
        event: yaml.Event = super().get_event()  # type: ignore[no-untyped-call]
        if isinstance(event, yaml.CollectionStartEvent):
            self.depth += 1
        if isinstance(event, yaml.CollectionEndEvent):
            self.depth -= 1
        if isinstance(event, yaml.NodeEvent):
            self.nodes += 1
        excess = ""
        if self.depth > DEEPEST_DOCUMENT or self.nodes > MOST_NODES:
            excess = "more"
        if isinstance(event, yaml.AliasEvent):
            excess = f"*{event.anchor}"
        if excess:
            raise InputError("", [Problem("", excess, LIMITS_TEXT, _line(event))])
        return event


def read(cls: type[S], source: str, origin: str) -> S:
    """Build `cls` from YAML text; InputError lists every fault with its line."""
    lines: dict[str, int] = {}
    problems: list[Problem] = []
    try:
        values = _parse(source, lines, problems)
        result = build(cls, values, origin)
    except InputError as refused:
        for problem in refused.problems:
            line = problem.line or _line_at(lines, problem.key)
            problems.append(replace(problem, line=line))
    if problems:
        problems.sort(key=lambda problem: problem.line or 0)
        raise InputError(origin, problems)
    return result


def read_values(source: str, origin: str) -> Any:
    """Return YAML text as dicts, lists and text, numbers as text too.

    Raises InputError where it is no YAML, breaks a limit of `read`, or has a key twice.
    """
    problems: list[Problem] = []
    try:
        values = _parse(source, {}, problems)
    except InputError as refused:
        problems += refused.problems
    if problems:
        raise InputError(origin, problems)
    return values


def read_file(path: Path) -> str:
    """Return the text of a YAML file.

    Return only its beginning if `read` refuses it as too long. Raises OSError where
    there is no such file, or a pipe or a device, which may never end; and
    UnicodeDecodeError.
    """
    check_regular(path)
    with path.open(encoding="utf-8") as file:
        return file.read(LONGEST_DOCUMENT + 1)


def resolve_numbers(value: Any) -> Any:
    """Turn text into numbers and truth values, as in YAML 1.2.

    The text is in what `read_values` returns.
    """
    if isinstance(value, dict):
        return {key: resolve_numbers(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [resolve_numbers(entry) for entry in value]
    if not isinstance(value, str):
        return value
    if _WHOLE.fullmatch(value):
        return int(value)
    if NUMBER.fullmatch(value) or _INFINITE.fullmatch(value):
        return float(value.replace(".inf", "inf"))
    return {"true": True, "false": False}.get(value.lower(), value)


def _parse(source: str, lines: dict[str, int], problems: list[Problem]) -> Any:
    """Return `_values` of YAML text within the limits.

    InputError says what is wrong with it.
    """
    try:
        if len(source) > LONGEST_DOCUMENT:
            raise refusal("", "", "more", LIMITS_TEXT)
        return _values(yaml.compose(source, Loader=_Loader), "", lines, problems)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        reason = getattr(error, "problem", None) or str(error)
        line = mark and mark.line + 1
        raise InputError("", [Problem("", reason, "must be YAML", line)]) from None


def dump(document: Section) -> str:
    """Write a document as YAML that `read` turns into an equal one."""
    return str(yaml.safe_dump(plain(document), sort_keys=False, allow_unicode=True))


def line_of(source: str, key: str) -> int | None:
    """Return the line of a key, as in "links[0].centre".

    Return that of the deepest part of the key that YAML text has.
    """
    lines: dict[str, int] = {}
    _values(yaml.compose(source, Loader=_Loader), "", lines, [])
    return _line_at(lines, key)


def _values(
    node: yaml.Node | None, path: str, lines: dict[str, int], problems: list[Problem]
) -> Any:
    """Return a node as dicts, lists and text.

    Enter the line of each key in `lines`, and keys that are given twice in `problems`.
    Numbers stay text: YAML 1.1, which PyYAML reads, has others.
    """
    if node is not None:
        lines.setdefault(path, _line(node))
    if isinstance(node, yaml.ScalarNode):
        if node.tag.endswith(":null"):
            return None
        return node.value
    if isinstance(node, yaml.SequenceNode):
        entries = enumerate(node.value)
        return [_values(entry, f"{path}[{i}]", lines, problems) for i, entry in entries]
    if not isinstance(node, yaml.MappingNode):
        return None
    mapping: dict[str, Any] = {}
    for key_node, value_node in node.value:
        name = str(_values(key_node, "", {}, []))
        key = f"{path}.{name}" if path else name
        first_line = lines.setdefault(key, _line(key_node))
        value = _values(value_node, key, lines, problems)
        if name in mapping:
            requirement = f"is given twice, first on line {first_line}"
            problems.append(Problem(key, value, requirement, _line(key_node)))
        else:
            mapping[name] = value
    return mapping


def _line(node: yaml.Node | yaml.Event) -> int:
    return 1 if node.start_mark is None else int(node.start_mark.line) + 1


def _line_at(lines: Mapping[str, int], key: str) -> int | None:
    """Return the line of a key, or of the deepest part of it that has one."""

    def written_index(index: re.Match[str]) -> str:
        """Return an index, or that of the first entry, which may stand for all."""
        if key[: index.end()] in lines:
            return index.group()
        return "[0]"

    nearest = re.sub(r"\[\d+\]", written_index, key)
    while nearest and nearest not in lines:
        end = max(nearest.rfind("."), nearest.rfind("["), 0)
        nearest = nearest[:end]
    return lines.get(nearest)


def plain(value: Any) -> Any:
    """Turn sections, arrays, NumPy numbers, tuples and mappings into what YAML has.

    Raises LostMeaning where an array means more than its numbers, as a masked one does.
    """
    if isinstance(value, Section):
        document = {}
        for name, field in vars(value).items():
            if field is None or field == ():
                continue
            notes = value.SPECS[name].kind == "notes"
            document[name] = plain(dict(field) if notes else field)
        return document
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if hasattr(value, "tolist"):  # arrays and numbers of NumPy, series of pandas
        if reason := find_lost_meaning(value):
            raise LostMeaning(reason)
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    return value


def replace_values(document: Any, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested dicts and lists with other values by key.

    A single value fills a list. A section that the document does not have is made; None
    removes a value or a section. The argument of KeyError is a key that does not fit
    the document.
    """
    changed: dict[str, Any] = plain(document)
    for key, value in values.items():
        try:
            _set(changed, _split(str(key)), value)
        except (AttributeError, LookupError, TypeError, ValueError):
            raise KeyError(key) from None
    return changed


def _set(tree: Any, place: Place, value: Any) -> None:
    """Set a value at a place of a tree; a name in a list means that of each entry."""
    name, *inner_place = place
    if isinstance(tree, list) and isinstance(name, str):
        for entry in tree:
            _set(entry, place, value)
        return
    if inner_place:
        if isinstance(name, str):
            tree.setdefault(name, {})
        _set(tree[name], tuple(inner_place), value)
        return
    if value is None and isinstance(name, str):
        tree.pop(name, None)
        return
    current = tree.get(name) if isinstance(name, str) else tree[name]
    is_single = not isinstance(value, (str, list, tuple, Mapping))
    if isinstance(current, list) and is_single:
        tree[name] = [value] * len(current)
    else:
        tree[name] = value


def _split(key: str) -> Place:
    """Return a key as a place; ValueError says that it is none."""
    if not re.fullmatch(r"\w+(\[\d+\])*(\.\w+(\[\d+\])*)*", key, re.A):
        raise ValueError(NO_NUMBER)
    steps = re.sub(r"\[(\d+)\]", r".\1", key).split(".")
    return tuple(int(step) if step.isdecimal() else step for step in steps)


def find_fields(
    tree: Section, key: str, *, components: bool = False, place: Place = ()
) -> Iterator[tuple[Place, Any, Spec]]:
    """Yield the place of each field that a key names, its value, and what it allows.

    With `components` an index may also pick a component of a vector. `place` is that of
    the tree in a larger one. ValueError says why there is no such field, or not in this
    scene.
    """
    fields = [(place, tree, Spec("section", ""))]
    for step in _split(key):
        deeper: list[tuple[Place, Any, Spec]] = []
        for field in fields:
            deeper += _below(*field, step, components)
        fields = deeper
    yield from fields


def find_number(tree: Section, key: str) -> float | None:
    """Return a number by its key, the first of a list; None where there is none."""
    numbers = values_at(tree, key, "number")
    if not numbers:
        return None
    return float(np.ravel(numbers[0])[0])


def values_at(tree: Section, key: str, field_kind: str = "") -> list[Any]:
    """List the values that a key names, those of one kind of field if it is given.

    The list is empty where there are none.
    """
    try:
        fields = [*find_fields(tree, key, components=True)]
    except ValueError:
        return []
    values = []
    for _, value, spec in fields:
        if value is not None and field_kind in ("", spec.kind):
            values.append(value)
    return values


def _below(
    place: Place, value: Any, spec: Spec, step: str | int, components: bool
) -> Iterator[tuple[Place, Any, Spec]]:
    """Yield what the next step of a key names in a field.

    A name in a list is that of each entry.
    """
    if value is None:
        raise ValueError(f"the scene has no {place[-1]}")
    if spec.kind == "sections":
        if not value or (isinstance(step, int) and step >= len(value)):
            raise ValueError(f"the scene has {len(value)} {place[-1]}")
        section = replace(spec, kind="section")
        if isinstance(step, int):
            yield (*place, step), value[step], section
            return
        for i, entry in enumerate(value):
            yield from _below((*place, i), entry, section, step, components)
    elif spec.kind == "section" and isinstance(step, str):
        specs = value.SPECS
        if step not in specs:
            raise ValueError("unknown key; allowed are " + ", ".join(specs))
        yield (*place, step), getattr(value, step), specs[step]
    elif components and spec.shape and isinstance(step, int) and step < len(value):
        yield (*place, step), value[step], replace(spec, shape=spec.shape[1:])
    else:
        raise ValueError(NO_NUMBER)


def json_schema(cls: type[Section]) -> dict[str, Any]:
    """Describe the documents that `read(cls, ...)` accepts, by draft 2020-12."""
    schema: dict[str, Any] = {
        "type": "object",
        "description": (cls.__doc__ or "").partition("\n")[0],
    }
    if cls.ONE_OF:
        schema["anyOf"] = [{"required": [name]} for name in cls.ONE_OF]
    schema["additionalProperties"] = False
    schema["properties"] = {
        name: _property_schema(spec) for name, spec in cls.SPECS.items()
    }
    schema["required"] = [
        name for name, spec in cls.SPECS.items() if spec.default is REQUIRED
    ]
    return schema


_TEXT_SCHEMA = {"type": "string", "pattern": "\\S"}


def _property_schema(spec: Spec) -> dict[str, Any]:
    """Describe the values that a field accepts, its unit and its default."""
    schema = _value_schema(spec)
    bounds = {
        "exclusiveMinimum": spec.above,
        "minimum": spec.least,
        "maximum": spec.most,
    }
    for keyword, bound in bounds.items():
        if math.isfinite(bound):
            schema[keyword] = bound
    for size in reversed(spec.shape):
        schema = {"type": "array", "items": schema, "minItems": size, "maxItems": size}
    if spec.kind == "sections":
        schema = {"type": "array", "items": schema}
    if spec.lengths:
        schema["anyOf"] = [
            {"minItems": length, "maxItems": length} for length in spec.lengths
        ]
    schema["description"] = spec.doc + (f" [{spec.unit}]" if spec.unit else "")
    if isinstance(spec.default, (bool, int, float, str)):
        schema["default"] = spec.default
    return schema


def _value_schema(spec: Spec) -> dict[str, Any]:
    """Describe one value of a field, without its bounds."""
    if spec.section:
        return json_schema(spec.section)
    schemas: dict[str, dict[str, Any]] = {
        "number": {"type": "number"},
        "integer": {"type": "integer"},
        "choice": {"enum": list(spec.choices)},
        "notes": {"type": "object", "additionalProperties": _TEXT_SCHEMA},
        "texts": {"type": "array", "items": _TEXT_SCHEMA},
        "flag": {"type": "boolean"},
    }
    return dict(schemas.get(spec.kind, _TEXT_SCHEMA))
