# SPDX-License-Identifier: Apache-2.0
"""Documents as frozen dataclasses: every field says its unit and bounds, and is held to them.

A class that derives from `Section` is checked whenever it is built, from YAML or from Python.
Reading a document gives either the object or one `InputError` with every fault and its line.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import yaml

from sst_ros.errors import InputError, Problem

S = TypeVar("S", bound="Section")

DEEPEST = 20
"""Levels of nesting in a document; PyYAML's time grows with their square."""


@dataclass(frozen=True)
class Spec:
    """What a field may hold. `shape` () is a scalar, (3,) a vector, (3, 3) a list of rows."""

    kind: str
    doc: str
    unit: str = ""
    shape: tuple[int, ...] = ()
    above: float = -math.inf
    least: float = -math.inf
    most: float = math.inf
    choices: tuple[str, ...] = ()
    section: type[Section] | None = None
    lengths: tuple[int, ...] = ()

    def allowed(self) -> str:
        """Say in words what is allowed."""
        if self.kind == "number":
            what = "a finite number" if not self.shape else f"{_size(self.shape)} finite numbers"
            bounds = [
                f"> {self.above:g}" if math.isfinite(self.above) else "",
                f">= {self.least:g}" if math.isfinite(self.least) else "",
                f"<= {self.most:g}" if math.isfinite(self.most) else "",
            ]
            unit = f" [{self.unit}]" if self.unit else ""
            return " ".join(["must be", what, *filter(None, bounds)]) + unit
        return {
            "integer": f"must be a whole number from {self.least:g} to {self.most:g} [{self.unit}]",
            "flag": "must be true or false",
            "text": "must be text",
            "texts": "must be a list of text",
            "choice": "must be one of " + ", ".join(self.choices),
            "section": "must be a mapping",
            "sections": " ".join(
                ["must be a list of", *" or ".join(map(str, self.lengths)).split(), "mappings"]
            ),
            "notes": "must be a mapping from keys to text",
        }[self.kind]


def number(doc: str, unit: str, *, default: Any = dataclasses.MISSING, **spec: Any) -> Any:
    """Declare a number, or with `shape` a vector or a list of rows."""
    return _declare(Spec("number", doc, unit, **spec), default)


def integer(doc: str, unit: str, *, default: Any = dataclasses.MISSING, **spec: Any) -> Any:
    """Declare a whole number."""
    return _declare(Spec("integer", doc, unit, **spec), default)


def flag(doc: str, *, default: Any = dataclasses.MISSING) -> Any:
    """Declare a switch."""
    return _declare(Spec("flag", doc), default)


def texts(doc: str, *, default: Any = dataclasses.MISSING) -> Any:
    """Declare a list of text."""
    return _declare(Spec("texts", doc), default)


def text(doc: str, *, default: Any = dataclasses.MISSING) -> Any:
    """Declare free text."""
    return _declare(Spec("text", doc), default)


def choice(doc: str, choices: Sequence[str], *, default: Any = dataclasses.MISSING) -> Any:
    """Declare one word out of a list."""
    return _declare(Spec("choice", doc, choices=tuple(choices)), default)


def section(doc: str, cls: type[Section], *, default: Any = dataclasses.MISSING) -> Any:
    """Declare a nested section."""
    return _declare(Spec("section", doc, section=cls), default)


def sections(
    doc: str,
    cls: type[Section],
    lengths: Sequence[int],
    *,
    default: Any = dataclasses.MISSING,
) -> Any:
    """Declare a list of sections, of any length where `lengths` is empty.

    Otherwise one entry stands for all of the longest allowed list.
    """
    return _declare(Spec("sections", doc, section=cls, lengths=tuple(lengths)), default)


def notes(doc: str) -> Any:
    """Declare a mapping from keys of this document to text."""
    return _declare(Spec("notes", doc), ())


def _declare(spec: Spec, default: Any) -> Any:
    return dataclasses.field(default=default, metadata={"spec": spec}, kw_only=True)


@dataclass(frozen=True)
class Section:
    """Base of every part of a document; refuses what its fields do not allow."""

    def __post_init__(self) -> None:
        problems = []
        for field in dataclasses.fields(self):
            name, spec, value = field.name, field.metadata["spec"], getattr(self, field.name)
            if value is None and field.default is None:
                continue
            try:
                object.__setattr__(self, name, _accept(spec, value))
            except ValueError:
                problems.append(Problem(name, value, spec.allowed()))
        if not problems:
            problems = list(self.check())
        if problems:
            raise InputError(type(self).__name__.lower(), problems)

    def check(self) -> Iterator[Problem]:
        """Yield the faults that no single field shows; override where there can be some."""
        return iter(())


def specs(cls: type[Section]) -> dict[str, Spec]:
    """List the declared fields of a section, in order."""
    return {field.name: field.metadata["spec"] for field in dataclasses.fields(cls)}


def read(cls: type[S], source: str, origin: str) -> S:
    """Build `cls` from YAML text.

    Raises:
        InputError: the text is no YAML or breaks the schema; lists every fault with its line.

    """
    problems: list[Problem] = []
    try:
        depth = 0
        for event in yaml.parse(source, Loader=yaml.SafeLoader):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.AliasEvent):
                allowed = "aliases are not allowed; write the value out"
                problem = Problem("", f"*{event.anchor}", allowed, _line(event))
                raise InputError(origin, [problem])
            if depth > DEEPEST:
                allowed = f"no more than {DEEPEST} levels are allowed"
                raise InputError(origin, [Problem("", "nested", allowed, _line(event))])
        node = yaml.compose(source, Loader=yaml.SafeLoader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        line = None if mark is None else mark.line + 1
        said = getattr(error, "problem", None) or str(error)
        raise InputError(origin, [Problem("", said, "must be YAML", line)]) from None
    result = _build(cls, node, "", problems)
    if problems or result is None:
        raise InputError(origin, sorted(problems, key=lambda problem: problem.line or 0))
    return result


def dump(document: Section) -> str:
    """Write a document as YAML that `read` turns into an equal one."""
    return str(yaml.safe_dump(_tree(document), sort_keys=False, allow_unicode=True))


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
            allowed = "unknown key; allowed are " + ", ".join(known)
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
            allowed = "is missing; " + known[field.name].allowed()
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
        return _accept(spec, _typed(spec, node, value))
    except ValueError:
        problems.append(Problem(key, value, spec.allowed(), _line(node)))
        return None


def _notes(node: yaml.MappingNode, path: str, problems: list[Problem]) -> dict[str, str]:
    result: dict[str, str] = {}
    for key_node, value_node in node.value:
        name, said = str(_plain(key_node)), _plain(value_node)
        if name in result:
            problems.append(Problem(f"{path}.{name}", said, "is given twice", _line(key_node)))
        try:
            result[name] = _text(said)
        except ValueError:
            problems.append(Problem(f"{path}.{name}", said, "must be text", _line(key_node)))
    return result


def _accept(spec: Spec, value: Any) -> Any:
    """Return `value` in its frozen form, or raise ValueError."""
    if spec.kind == "number":
        return _numbers(spec, value, spec.shape)
    if spec.kind == "notes" and isinstance(value, (dict, tuple)):
        pairs = value.items() if isinstance(value, dict) else value
        return tuple((_text(name), _text(said)) for name, said in pairs)
    if spec.kind == "text":
        return _text(value)
    if spec.kind == "texts" and isinstance(value, (list, tuple)):
        return tuple(_text(entry) for entry in value)
    if spec.kind == "flag" and (value is True or value is False):
        return value
    if spec.kind == "integer" and type(value) is int and spec.least <= value <= spec.most:
        return value
    if spec.kind == "choice" and value in spec.choices:
        return value
    if spec.kind == "section" and spec.section:
        return _instance(value, spec.section)
    listed = isinstance(value, (list, tuple))
    if spec.kind == "sections" and spec.section and listed and _fits(len(value), spec.lengths):
        repeated = max(spec.lengths) if spec.lengths and len(value) == 1 else 1
        return tuple(_instance(entry, spec.section) for entry in tuple(value) * repeated)
    raise ValueError


def _numbers(spec: Spec, value: Any, shape: tuple[int, ...]) -> Any:
    if shape:
        try:
            fits = len(value) == shape[0] and not isinstance(value, (str, dict, set))
        except TypeError:
            fits = False
        if not fits:
            raise ValueError
        return tuple(_numbers(spec, entry, shape[1:]) for entry in value)
    if isinstance(value, bool) or value is None:
        raise ValueError
    try:
        result = float(value)
    except (TypeError, OverflowError):
        raise ValueError from None
    if not math.isfinite(result) or not spec.least <= result <= spec.most or result <= spec.above:
        raise ValueError
    return result


def _fits(length: int, lengths: tuple[int, ...]) -> bool:
    return not lengths or length in lengths


def _text(value: Any) -> str:
    if not isinstance(value, str) or not value.strip():
        raise ValueError
    return value.strip()


def _instance(value: Any, cls: type[Section]) -> Any:
    if isinstance(value, cls):
        return value
    raise ValueError


def _plain(node: yaml.Node | None) -> Any:
    """Give the node's value; numbers stay text, so that 1e-3 means what it says."""
    if isinstance(node, yaml.ScalarNode):
        return None if node.tag.endswith(":null") else node.value
    if isinstance(node, yaml.SequenceNode):
        return [_plain(entry) for entry in node.value]
    if isinstance(node, yaml.MappingNode):
        return {str(_plain(key)): _plain(value) for key, value in node.value}
    return None


def _typed(spec: Spec, node: yaml.Node, value: Any) -> Any:
    """Turn the text of a plain YAML flag or whole number into what it says."""
    if spec.kind == "flag" and node.tag.endswith(":bool"):
        return {"true": True, "false": False}.get(value.lower(), value)
    if spec.kind == "integer" and node.tag.endswith(":int"):
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


def _size(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape))
