# SPDX-License-Identifier: Apache-2.0
"""YAML text to a checked document and back; reports every fault with its line.

Between them stand nested dicts, whose values have keys, as in "star.inertia.zz" or
"springs[0].rest".
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np
import yaml

from sst_ros.errors import InputError, Problem, suggestion
from sst_ros.scene.schema import Section, Spec, accept, frozen_text, specs

S = TypeVar("S", bound=Section)

LONGEST, MOST_NODES, DEEPEST = 1_000_000, 20_000, 20
"""Characters, values and levels of nesting of a document: PyYAML reads 20,000 values in 0.5 s,
and its time grows with the square of the levels."""


class _Refused(Exception):
    """A document breaks one of the limits; ends its reading at once."""

    def __init__(self, event: yaml.Event, value: object, allowed: str) -> None:
        self.problem = Problem("", value, allowed, _line(event))


class _Loader(yaml.SafeLoader):
    """PyYAML's reader, which ends at the first event that breaks a limit."""

    def __init__(self, source: str) -> None:
        super().__init__(source)
        self.depth = self.nodes = 0

    def get_event(self) -> yaml.Event:
        """Return the next event.

        Raises:
            _Refused: it is an alias, or there is too much in the document.

        """
        event: yaml.Event = super().get_event()  # type: ignore[no-untyped-call]
        self.depth += isinstance(event, yaml.CollectionStartEvent)
        self.depth -= isinstance(event, yaml.CollectionEndEvent)
        self.nodes += isinstance(event, yaml.NodeEvent)
        if isinstance(event, yaml.AliasEvent):
            allowed = "aliases are not allowed; write the value out"
            raise _Refused(event, f"*{event.anchor}", allowed)
        if self.depth > DEEPEST:
            raise _Refused(event, "nested", f"no more than {DEEPEST} levels are allowed")
        if self.nodes > MOST_NODES:
            raise _Refused(event, "long", f"no more than {MOST_NODES} values are allowed")
        return event


def read(cls: type[S], source: str, origin: str) -> S:
    """Build `cls` from YAML text.

    Raises:
        InputError: the text is no YAML or breaks the schema; lists every fault with its line.

    """
    if len(source) > LONGEST:
        allowed = f"no more than {LONGEST} characters are allowed"
        raise InputError(origin, [Problem("", f"{len(source)} characters", allowed)])
    try:
        node = yaml.compose(source, Loader=_Loader)
    except _Refused as refused:
        raise InputError(origin, [refused.problem]) from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        line = None if mark is None else mark.line + 1
        reason = getattr(error, "problem", None) or str(error)
        raise InputError(origin, [Problem("", reason, "must be YAML", line)]) from None
    problems: list[Problem] = []
    result = _build(cls, node, "", problems)
    if problems or result is None:
        raise InputError(origin, sorted(problems, key=lambda problem: problem.line or 0))
    return result


def from_values(cls: type[S], values: Mapping[str, Any], origin: str) -> S:
    """Build `cls` from nested dicts and lists, as YAML text would have them; arrays are allowed.

    Raises:
        InputError: the values break the schema; lists every fault.

    """
    try:
        text = yaml.safe_dump(plain(values), sort_keys=False, allow_unicode=True)
        return read(cls, text, origin)
    except yaml.YAMLError as error:
        allowed = f"must be text, numbers, lists and mappings ({error})"
        raise InputError(origin, [Problem("", "values", allowed)]) from None
    except InputError as error:
        found = [dataclasses.replace(problem, line=None) for problem in error.problems]
        raise InputError(origin, found) from None


def values_of(document: Section) -> dict[str, Any]:
    """Return a document as nested dicts and lists, which `from_values` takes."""
    tree: dict[str, Any] = _tree(document)
    return tree


def replace_values(document: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
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


def dump(document: Section) -> str:
    """Write a document as YAML that `read` turns into an equal one."""
    return str(yaml.safe_dump(_tree(document), sort_keys=False, allow_unicode=True))


def line_of(source: str, key: str) -> int | None:
    """Line of a key, as in "links[0].centre", or of the deepest part of it that YAML text has."""
    node = yaml.compose(source, Loader=_Loader)
    return None if node is None else _line_at(node, key)


def _tree(value: Any) -> Any:
    if isinstance(value, Section):
        pairs = ((name, spec, getattr(value, name)) for name, spec in specs(type(value)).items())
        return {
            name: dict(entry) if spec.kind == "notes" else _tree(entry)
            for name, spec, entry in pairs
            if entry is not None and entry != ()
        }
    return [_tree(entry) for entry in value] if isinstance(value, tuple) else value


def _build(cls: type[S], node: yaml.Node | None, path: str, problems: list[Problem]) -> S | None:
    if not isinstance(node, yaml.MappingNode):
        problems.append(Problem(path, _plain(node), "must be a mapping", _line(node)))
        return None
    known = specs(cls)
    values: dict[str, Any] = {}
    lines: dict[str, int | None] = {}
    before = len(problems)
    for key_node, value_node in node.value:
        name = str(_plain(key_node))
        key = f"{path}.{name}" if path else name
        if name not in known:
            allowed = f"unknown key; allowed are {', '.join(known)}{suggestion(name, known)}"
            problems.append(Problem(key, _plain(value_node), allowed, _line(key_node)))
        elif name in lines:
            allowed = f"is given twice, first on line {lines[name]}"
            problems.append(Problem(key, _plain(value_node), allowed, _line(key_node)))
        else:
            lines[name] = _line(key_node)
            values[name] = _convert(known[name], value_node, key, problems)
    for field in dataclasses.fields(cls):
        if field.default is dataclasses.MISSING and field.name not in lines:
            key = f"{path}.{field.name}" if path else field.name
            allowed = "is missing; " + known[field.name].describe()
            problems.append(Problem(key, None, allowed, _line(node)))
    if len(problems) > before:
        return None
    try:
        return cls(**values)
    except InputError as error:
        for problem in error.problems:
            key = ".".join(filter(None, [path, problem.key]))
            line = _line_at(node, problem.key)
            problems.append(dataclasses.replace(problem, key=key, line=line))
    return None


def _convert(spec: Spec, node: yaml.Node, key: str, problems: list[Problem]) -> Any:
    if spec.kind == "section" and spec.section:
        return _build(spec.section, node, key, problems)
    if spec.kind == "sections" and spec.section and isinstance(node, yaml.SequenceNode):
        entries = enumerate(node.value)
        return tuple(
            _build(spec.section, entry, f"{key}[{index}]", problems) for index, entry in entries
        )
    if spec.kind == "notes" and isinstance(node, yaml.MappingNode):
        return _notes(node, key, problems)
    value = _plain(node)
    try:
        return accept(spec, _read_scalar(spec, node, value))
    except ValueError:
        problems.append(Problem(key, value, spec.describe(), _line(node)))
        return None


def _notes(node: yaml.MappingNode, path: str, problems: list[Problem]) -> dict[str, str]:
    result: dict[str, str] = {}
    for key_node, value_node in node.value:
        name, note = str(_plain(key_node)), _plain(value_node)
        if name in result:
            problems.append(Problem(f"{path}.{name}", note, "is given twice", _line(key_node)))
        try:
            result[name] = frozen_text(note)
        except ValueError:
            problems.append(Problem(f"{path}.{name}", note, "must be text", _line(key_node)))
    return result


def _plain(node: yaml.Node | None) -> Any:
    """Return the node's value; numbers stay text: YAML 1.1, which PyYAML reads, has others."""
    if isinstance(node, yaml.ScalarNode):
        return None if node.tag.endswith(":null") else node.value
    if isinstance(node, yaml.SequenceNode):
        return [_plain(entry) for entry in node.value]
    if isinstance(node, yaml.MappingNode):
        return {str(_plain(key)): _plain(value) for key, value in node.value}
    return None


def _read_scalar(spec: Spec, node: yaml.Node, value: Any) -> Any:
    """Convert the text of a plain flag or whole number, by the rules of YAML 1.2."""
    if spec.kind == "flag" and node.tag.endswith(":bool"):
        return {"true": True, "false": False}.get(value.lower(), value)
    if spec.kind == "integer" and isinstance(value, str) and re.fullmatch("[-+]?[0-9]+", value):
        return int(value)
    return value


def _line(node: yaml.Node | yaml.Event | None) -> int | None:
    return None if node is None or node.start_mark is None else int(node.start_mark.line) + 1


def _line_at(node: yaml.Node, path: str) -> int | None:
    """Line of the deepest part of a path, as in "links[0].centre", that the document has."""
    pairs = node.value if isinstance(node, yaml.MappingNode) else []
    for key_node, value_node in pairs:
        name = str(_plain(key_node))
        if path == name:
            return _line(key_node)
        if path.startswith(f"{name}."):
            return _line_at(value_node, path[len(name) + 1 :])
        if path.startswith(f"{name}[") and isinstance(value_node, yaml.SequenceNode):
            index, _, rest = path[len(name) + 1 :].partition("]")
            entries = value_node.value
            return _line_at(entries[min(int(index), len(entries) - 1)], rest.removeprefix("."))
    return _line(node)
