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

LONGEST_DOCUMENT, MOST_NODES, DEEPEST_DOCUMENT = 1_000_000, 20_000, 20
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
        self.depth += isinstance(event, yaml.CollectionStartEvent)
        self.depth -= isinstance(event, yaml.CollectionEndEvent)
        self.nodes += isinstance(event, yaml.NodeEvent)
        alias = f"*{event.anchor}" if isinstance(event, yaml.AliasEvent) else ""
        if alias or self.depth > DEEPEST_DOCUMENT or self.nodes > MOST_NODES:
            raise InputError(
                "", [Problem("", alias or "more", LIMITS_TEXT, _line(event))]
            )
        return event


def read(cls: type[S], source: str, origin: str) -> S:
    """Build `cls` from YAML text; InputError lists every fault with its line."""
    lines: dict[str, int] = {}
    problems: list[Problem] = []
    try:
        values = _parse(source, lines, problems)
        result = build(cls, values, origin)
    except InputError as refused:
        for one in refused.problems:
            problems.append(replace(one, line=one.line or _line_at(lines, one.key)))
    if problems:
        raise InputError(
            origin, sorted(problems, key=lambda problem: problem.line or 0)
        )
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

    Note the lines of keys, and keys that come again.

    Numbers stay text: YAML 1.1, which PyYAML reads, has others.
    """
    if node is not None:
        lines.setdefault(path, _line(node))
    if isinstance(node, yaml.ScalarNode):
        return None if node.tag.endswith(":null") else node.value
    if isinstance(node, yaml.SequenceNode):
        entries = enumerate(node.value)
        return [_values(entry, f"{path}[{i}]", lines, problems) for i, entry in entries]
    if not isinstance(node, yaml.MappingNode):
        return None
    found: dict[str, Any] = {}
    for key_node, value_node in node.value:
        name = str(_values(key_node, "", {}, []))
        key = f"{path}.{name}" if path else name
        line = lines.setdefault(key, _line(key_node))
        value = _values(value_node, key, lines, problems)
        if name in found:
            allowed = f"is given twice, first on line {line}"
            problems.append(Problem(key, value, allowed, _line(key_node)))
        else:
            found[name] = value
    return found


def _line(node: yaml.Node | yaml.Event) -> int:
    return 1 if node.start_mark is None else int(node.start_mark.line) + 1


def _line_at(lines: Mapping[str, int], key: str) -> int | None:
    """Return the line of a key, or of the deepest part of it that has one."""
    # One entry may stand for all.
    key = re.sub(
        r"\[\d+\]", lambda at: at[0] if key[: at.end()] in lines else "[0]", key
    )
    while key and key not in lines:
        key = key[: max(key.rfind("."), key.rfind("["), 0)]
    return lines.get(key)


def plain(value: Any) -> Any:
    """Turn sections, arrays, NumPy numbers, tuples and mappings into what YAML has.

    Raises LostMeaning where an array means more than its numbers, as a masked one does.
    """
    if isinstance(value, Section):
        given = {
            name: x for name, x in vars(value).items() if x is not None and x != ()
        }
        notes = (name for name, spec in value.SPECS.items() if spec.kind == "notes")
        return plain(
            given | {name: dict(given[name]) for name in notes if name in given}
        )
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if hasattr(value, "tolist"):  # arrays and numbers of NumPy, series of pandas
        if reason := find_lost_meaning(value):
            raise LostMeaning(reason)
        return value.tolist()
    return (
        [plain(entry) for entry in value] if isinstance(value, (list, tuple)) else value
    )


def replace_values(document: Any, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested dicts and lists with other values by key.

    A single one fills a list.

    A section that the document does not have is made; None takes a value or a section
    away. The argument of KeyError is a key that does not fit the document.
    """
    changed: dict[str, Any] = plain(document)
    for key, value in values.items():
        try:
            _set(changed, *_split(str(key)), value=value)
        except (AttributeError, LookupError, TypeError, ValueError):
            raise KeyError(key) from None
    return changed


def _set(tree: Any, name: str | int, *rest: str | int, value: Any) -> None:
    """Set a value below a tree; a name of an entry means that of each in a list."""
    for part in tree if isinstance(tree, list) and isinstance(name, str) else [tree]:
        if rest:
            below = part.setdefault(name, {}) if isinstance(name, str) else part[name]
            _set(below, *rest, value=value)
        elif value is None and isinstance(name, str):
            part.pop(name, None)
        else:
            known = part.get(name) if isinstance(name, str) else part[name]
            single = not isinstance(value, (str, list, tuple, Mapping))
            part[name] = (
                [value] * len(known) if isinstance(known, list) and single else value
            )


def _split(key: str) -> Place:
    """Return a key as a place; ValueError says that it is none."""
    if not re.fullmatch(r"\w+(\[\d+\])*(\.\w+(\[\d+\])*)*", key, re.A):
        raise ValueError(NO_NUMBER)
    words = re.sub(r"\[(\d+)\]", r".\1", key).split(".")
    return tuple(int(word) if word.isdecimal() else word for word in words)


def find_fields(
    tree: Section, key: str, *, components: bool = False, place: Place = ()
) -> Iterator[tuple[Place, Any, Spec]]:
    """Yield the place of each field that a key names, its value, and what it allows.

    With `components` an index may also pick a component of a vector. `place` is that of
    the tree in a larger one. ValueError says why there is no such field, or not in this
    scene.
    """
    found = [(place, tree, Spec("section", ""))]
    for word in _split(key):
        found = [one for part in found for one in _below(*part, word, components)]
    yield from found


def find_number(tree: Section, key: str) -> float | None:
    """Return a number by its key, the first of a list; None where there is none."""
    found = values_at(tree, key, "number")
    return float(np.ravel(found[0])[0]) if found else None


def values_at(tree: Section, key: str, kind: str = "") -> list[Any]:
    """List the values that a key names, of a kind where it is given.

    None where there is none.
    """
    try:
        found = [*find_fields(tree, key, components=True)]
    except ValueError:
        return []
    return [
        x for _, x, spec in found if x is not None and spec.kind in (kind or spec.kind,)
    ]


def _below(
    place: Place, value: Any, spec: Spec, word: str | int, components: bool
) -> Iterator[tuple[Place, Any, Spec]]:
    """Yield what the next word of a key names in a field.

    A name in a list is that of each.
    """
    if value is None:
        raise ValueError(f"the scene has no {place[-1]}")
    if spec.kind == "sections":
        chosen = [word] if isinstance(word, int) else range(len(value))
        if not chosen or chosen[-1] >= len(value):
            raise ValueError(f"the scene has {len(value)} {place[-1]}")
        for i in chosen:
            entry = (*place, i), value[i], replace(spec, kind="section")
            yield from [entry] if i == word else _below(*entry, word, components)
    elif spec.kind == "section" and isinstance(word, str):
        known = value.SPECS
        if word not in known:
            raise ValueError("unknown key; allowed are " + ", ".join(known))
        yield (*place, word), getattr(value, word), known[word]
    elif components and spec.shape and isinstance(word, int) and word < len(value):
        yield (*place, word), value[word], replace(spec, shape=spec.shape[1:])
    else:
        raise ValueError(NO_NUMBER)


def json_schema(cls: type[Section]) -> dict[str, Any]:
    """Describe the documents that `read(cls, ...)` accepts, by draft 2020-12."""
    described = {"description": (cls.__doc__ or "").partition("\n")[0]}
    any_of = (
        {"anyOf": [{"required": [name]} for name in cls.ONE_OF]} if cls.ONE_OF else {}
    )
    properties = {name: _property_schema(spec) for name, spec in cls.SPECS.items()}
    required = [name for name, spec in cls.SPECS.items() if spec.default is REQUIRED]
    given = {
        "additionalProperties": False,
        "properties": properties,
        "required": required,
    }
    return {"type": "object", **described, **any_of, **given}


def _property_schema(spec: Spec) -> dict[str, Any]:
    described: dict[str, Any] = {
        "description": spec.doc + (f" [{spec.unit}]" if spec.unit else "")
    }
    if isinstance(spec.default, (bool, int, float, str)):
        described["default"] = spec.default
    bounds = {
        "exclusiveMinimum": spec.above,
        "minimum": spec.least,
        "maximum": spec.most,
    }
    text = {"type": "string", "pattern": "\\S"}
    known: dict[str, dict[str, Any]] = {
        "number": {"type": "number"},
        "integer": {"type": "integer"},
        "choice": {"enum": list(spec.choices)},
        "notes": {"type": "object", "additionalProperties": text},
        "texts": {"type": "array", "items": text},
        "flag": {"type": "boolean"},
    }
    own = json_schema(spec.section) if spec.section else known.get(spec.kind, text)
    own = own | {name: bound for name, bound in bounds.items() if math.isfinite(bound)}
    for size in reversed(spec.shape):
        own = {"type": "array", "items": own, "minItems": size, "maxItems": size}
    if spec.kind == "sections":
        own = {"type": "array", "items": own}
    if spec.lengths:
        own["anyOf"] = [
            {"minItems": length, "maxItems": length} for length in spec.lengths
        ]
    return own | described
