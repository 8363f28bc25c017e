# SPDX-License-Identifier: Apache-2.0
"""A document as YAML text, as nested values, and as numbers with keys.

Text is read into nested dicts and lists, which are built into a checked `Section`, and back; every
fault has its key and its line. A key is "star.inertia.zz" or "springs[0].rest"; a list without an
index means all of its entries.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import yaml

from sst_ros.errors import InputError, Problem, suggestion
from sst_ros.scene.schema import (
    REQUIRED,
    Place,
    Section,
    Spec,
    accept,
    freeze_text,
    has_effect,
    make_unchecked,
    specs,
)

S = TypeVar("S", bound=Section)

NO_NUMBER = "must name a number, as star.mass does"

LONGEST, MOST_NODES, DEEPEST = 1_000_000, 20_000, 20
"""Characters, values and levels of nesting of a document: PyYAML reads 20,000 values in 0.5 s,
and its time grows with the square of the levels."""


class _Loader(yaml.SafeLoader):
    """PyYAML's reader, which refuses aliases and ends at the first event that breaks a limit."""

    depth = nodes = 0

    def __init__(self, source: str) -> None:
        if len(source) > LONGEST:
            allowed = f"no more than {LONGEST} characters are allowed"
            raise InputError("", [Problem("", f"{len(source)} characters", allowed)])
        super().__init__(source)

    def get_event(self) -> yaml.Event:
        event: yaml.Event = super().get_event()  # type: ignore[no-untyped-call]
        self.depth += isinstance(event, yaml.CollectionStartEvent)
        self.depth -= isinstance(event, yaml.CollectionEndEvent)
        self.nodes += isinstance(event, yaml.NodeEvent)
        fault = None
        if isinstance(event, yaml.AliasEvent):
            fault = f"*{event.anchor}", "aliases are not allowed; write the value out"
        elif self.depth > DEEPEST:
            fault = "nested", f"no more than {DEEPEST} levels are allowed"
        elif self.nodes > MOST_NODES:
            fault = "long", f"no more than {MOST_NODES} values are allowed"
        if fault:
            raise InputError("", [Problem("", *fault, _line(event))])
        return event


class Switch(str):
    """A word of YAML 1.1 for true or false, of which YAML 1.2 has those two."""


def read(cls: type[S], source: str, origin: str) -> S:
    """Build `cls` from YAML text; InputError lists every fault with its line."""
    lines: dict[str, int] = {}
    problems: list[Problem] = []
    try:
        values = _values(yaml.compose(source, Loader=_Loader), "", lines, problems)
    except InputError as refused:
        raise InputError(origin, refused.problems) from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        line = None if mark is None else mark.line + 1
        reason = getattr(error, "problem", None) or str(error)
        raise InputError(origin, [Problem("", reason, "must be YAML", line)]) from None
    try:
        result = build(cls, values, origin)
    except InputError as refused:
        problems += (replace(one, line=_line_at(lines, one.key)) for one in refused.problems)
    if problems:
        raise InputError(origin, sorted(problems, key=lambda problem: problem.line or 0))
    return result


def dump(document: Section) -> str:
    """Write a document as YAML that `read` turns into an equal one."""
    return str(yaml.safe_dump(plain(document), sort_keys=False, allow_unicode=True))


def line_of(source: str, key: str) -> int | None:
    """Line of a key, as in "links[0].centre", or of the deepest part of it that YAML text has."""
    lines: dict[str, int] = {}
    _values(yaml.compose(source, Loader=_Loader), "", lines, [])
    return _line_at(lines, key)


def _values(
    node: yaml.Node | None, path: str, lines: dict[str, int], problems: list[Problem]
) -> Any:
    """Return a node as dicts, lists and text; note the lines of keys, and keys that come again.

    Numbers stay text: YAML 1.1, which PyYAML reads, has others.
    """
    if node is not None:
        lines.setdefault(path, _line(node))
    if isinstance(node, yaml.ScalarNode) and not node.tag.endswith(":null"):
        return Switch(node.value) if node.tag.endswith(":bool") else node.value
    if isinstance(node, yaml.SequenceNode):
        entries = enumerate(node.value)
        return [_values(entry, f"{path}[{i}]", lines, problems) for i, entry in entries]
    if not isinstance(node, yaml.MappingNode):
        return None
    found: dict[str, Any] = {}
    for key_node, value_node in node.value:
        name = str(_values(key_node, "", {}, []))
        key = _join(path, name)
        line = lines.setdefault(key, _line(key_node))
        value = _values(value_node, key, lines, problems)
        if name in found:
            allowed = f"is given twice, first on line {line}"
            problems.append(Problem(key, value, allowed, _line(key_node)))
        else:
            found[name] = value
    return found


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _line(node: yaml.Node | yaml.Event) -> int:
    return 1 if node.start_mark is None else int(node.start_mark.line) + 1


def _line_at(lines: Mapping[str, int], key: str) -> int | None:
    """Return the line of a key, or of the deepest part of it that has one."""
    # One entry may stand for all.
    key = re.sub(r"\[\d+\]", lambda at: at[0] if key[: at.end()] in lines else "[0]", key)
    while key and key not in lines:
        key = key[: max(key.rfind("."), key.rfind("["), 0)]
    return lines.get(key)


def plain(value: Any) -> Any:
    """Turn sections, arrays, NumPy numbers, tuples and mappings into what YAML has."""
    if isinstance(value, Section):
        given = {name: x for name, x in vars(value).items() if x is not None and x != ()}
        notes = (name for name, spec in specs(type(value)).items() if spec.kind == "notes")
        return plain(given | {name: dict(given[name]) for name in notes if name in given})
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    return [plain(entry) for entry in value] if isinstance(value, (list, tuple)) else value


def replace_values(document: Any, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested dicts and lists with other values by key; a single one fills a list.

    A section that the document does not have is made; None takes a value or a section away. The
    argument of KeyError is a key that does not fit the document.
    """
    changed: dict[str, Any] = plain(document)
    for key, value in values.items():
        try:
            _set(changed, [_split(word) for word in str(key).split(".")], value)
        except (AttributeError, IndexError, TypeError, ValueError):
            raise KeyError(key) from None
    return changed


def _set(section: dict[str, Any], words: list[tuple[str, int | None]], value: Any) -> None:
    (name, index), *rest = words
    if rest:
        below = section.setdefault(name, {} if index is None else [])
        entries = below if isinstance(below, list) else [below]
        for entry in entries if index is None else [entries[index]]:
            _set(entry, rest, value)
    elif index is not None:
        section[name][index] = value
    elif value is None:
        section.update({name: None})
        del section[name]
    else:
        known = section.get(name)
        if isinstance(known, list) and not isinstance(value, (str, list, tuple, Mapping)):
            value = [value] * len(known)
        section.update({name: value})


def build_unchecked(cls: type[Section], values: Mapping[str, Any]) -> Any:
    """Build a section from nested dicts and lists of any values, which are not checked.

    A number that a section must have and these values have not is zero.
    """

    def make(inner: type[Section] | None, value: Any) -> Any:
        if isinstance(value, list):
            return tuple(make(inner, entry) for entry in value)
        return build_unchecked(inner, value) if inner and isinstance(value, dict) else value

    found = {}
    for name, spec in specs(cls).items():
        default = 0.0 if spec.default is REQUIRED else spec.default
        found[name] = make(spec.section, values.get(name, default))
    return make_unchecked(cls, found)


def build(cls: type[S], values: Any, origin: str, *, path: str = "", of_row: bool = False) -> S:
    """Build a section from nested dicts and lists, in which arrays are allowed.

    Messages are headed by `origin`, and `path` is the section's key in a larger document. A
    document that says what has no effect is refused, as a friction whose coefficients are zero;
    with `of_row` that is left out. InputError lists every fault.
    """
    builder = _Builder(of_row, [])
    result = builder.section(cls, plain(values), path)
    if builder.problems or result is None:
        raise InputError(origin, builder.problems)
    return result


@dataclass
class _Builder:
    """Builds sections; what it cannot build is None, with a problem."""

    of_row: bool
    problems: list[Problem]

    def section(self, cls: type[S], values: Any, path: str) -> S | None:
        known, before = specs(cls), len(self.problems)
        if not isinstance(values, Mapping):
            self._refuse(path, values, f"must be a mapping with the keys {', '.join(known)}")
            return None
        given: dict[str, Any] = {}
        for name, value in values.items():
            if name in known:
                given[name] = self._value(known[name], value, _join(path, name))
            else:
                allowed = f"unknown key; allowed are {', '.join(known)}{suggestion(name, known)}"
                self._refuse(_join(path, name), value, allowed)
        for name, spec in known.items():
            if spec.default is REQUIRED and name not in given:
                self._refuse(_join(path, name), None, "is missing; " + spec.describe())
        if len(self.problems) > before:
            return None

        def acts(names: tuple[str, ...]) -> bool:
            return not names or any(has_effect(given.get(name)) for name in names)

        if self.of_row:
            given = {name: x for name, x in given.items() if acts(known[name].acts_on)}
            if not acts(cls.EFFECTS):
                return None
        try:
            return cls(**given)
        except InputError as error:
            for one in error.problems:
                self._refuse(".".join(filter(None, [path, one.key])), one.value, one.allowed)
        return None

    def _value(self, spec: Spec, value: Any, key: str) -> Any:
        if spec.kind == "section" and spec.section:
            return self.section(spec.section, value, key)
        if spec.kind == "sections" and spec.section and isinstance(value, list):
            parts = [self.section(spec.section, x, f"{key}[{i}]") for i, x in enumerate(value)]
            return tuple(part for part in parts if part is not None or not self.of_row)
        if spec.kind == "notes" and isinstance(value, dict):
            for name, note in value.items():
                try:
                    freeze_text(note)
                except ValueError:
                    self._refuse(f"{key}.{name}", note, "must be text")
            return value
        if spec.kind == "number" and self.of_row and not has_effect(value):
            return value  # the section refuses zero, or is left out
        given = value
        if spec.kind == "flag" and isinstance(value, Switch):
            given = {"true": True, "false": False}.get(value.lower(), value)
        elif spec.kind == "integer" and re.fullmatch("[-+]?[0-9]+", str(value)):
            given = int(value)
        elif spec.kind == "text" and isinstance(value, (int, float)):
            given = str(value)
        try:
            return accept(spec, given)
        except ValueError:
            return self._refuse(key, value, spec.refuse())

    def _refuse(self, key: str, value: Any, allowed: str) -> None:
        self.problems.append(Problem(key, value, allowed))


def _split(word: str) -> tuple[str, int | None]:
    """Return name and index of a word of a key; raises ValueError where it is none."""
    parts = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", word, re.A)
    if parts is None:
        raise ValueError(word)
    return parts[1], None if parts[2] is None else int(parts[2])


def find_fields(
    tree: Section, key: str, *, components: bool = False, place: Place = ()
) -> Iterator[tuple[Place, Any, Spec]]:
    """Yield the place of each field that a key names, its value, and what it allows.

    With `components` an index may also pick a component of a vector. `place` is that of the tree in
    a larger one. ValueError says why there is no such field, or not in this scene.
    """
    word, _, rest = key.partition(".")
    try:
        name, index = _split(word)
    except ValueError:
        name, index = word, None
    known = specs(type(tree))
    if name not in known:
        raise ValueError("unknown key; allowed are " + ", ".join(known))
    spec, value, here = known[name], getattr(tree, name), (*place, name)
    if not rest and index is None:
        yield here, value, spec
    elif not rest and components and spec.shape and value is not None:
        if index is None or index >= len(value):
            raise ValueError(NO_NUMBER)
        yield (*here, index), value[index], replace(spec, shape=spec.shape[1:])
    elif rest and spec.kind == "section" and index is None:
        if value is None:
            raise ValueError(f"the scene has no {name}")
        yield from find_fields(value, rest, components=components, place=here)
    elif rest and spec.kind == "sections":
        chosen = range(len(value)) if index is None else [index]
        if not chosen or max(chosen) >= len(value):
            raise ValueError(f"the scene has {len(value)} {name}")
        for i in chosen:
            yield from find_fields(value[i], rest, components=components, place=(*here, i))
    else:
        raise ValueError(NO_NUMBER)
