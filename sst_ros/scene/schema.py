# SPDX-License-Identifier: Apache-2.0
"""Documents as frozen dataclasses: every field has a unit and bounds, which are checked.

A class that derives from `Section` is checked whenever it is built, from YAML or from Python.
Reading a document gives either the object or one `InputError` with every fault and its line. The
JSON schema is from the same declarations: editors complete and check YAML with it; what no schema
can express (inertias, angles that must sum to 360 deg) is left to reading.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, TypeAlias

import numpy as np

from sst_ros.errors import InputError, Problem

_NUMBER = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
"""A decimal number of YAML 1.2 and JSON: no 3_5, 0x10 or 1:30, of which YAML 1.1 makes others."""

_UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
"""What a terminal obeys, and halves of characters."""

_DRAFT = "https://json-schema.org/draft/2020-12/schema"

_TEXT = {"type": "string", "pattern": "\\S"}

TURN = 2.0 * math.pi
"""No initial or desired angle of an actuator [rad] is larger: it is in degrees."""

Place = tuple[str | int, ...]
"""Names and indices of a leaf from the root on."""


@dataclass(frozen=True)
class Spec:
    """What a field may hold. `shape` () is a scalar, (3,) a vector, (3, 3) a list of rows.

    Without any of the fields `acts_on` it has no effect; `needs` says so.
    """

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
    acts_on: tuple[str, ...] = ()
    needs: str = ""

    def refuse(self) -> str:
        """Describe the values that are allowed, and what may be wrong with others."""
        return self.describe() + (": in rad?" if self.most == TURN else "")

    def describe(self) -> str:
        """Describe the values that are allowed."""
        unit = f" [{self.unit}]" if self.unit else ""
        if self.kind == "number":
            size = " x ".join(map(str, self.shape))
            what = f"{size} finite numbers" if size else "a finite number"
            ends = (">", self.above), (">=", self.least), ("<=", self.most)
            bounds = [f"{sign} {end:g}" for sign, end in ends if math.isfinite(end)]
            return " ".join(["must be", what, *bounds]) + unit
        return {
            "integer": f"must be a whole number from {self.least} to {self.most}{unit}",
            "flag": "must be true or false",
            "text": "must be text without control characters",
            "texts": "must be a list of text",
            "choice": "must be one of " + ", ".join(self.choices),
            "section": "must be a mapping",
            "sections": " ".join(
                ["must be a list of", *" or ".join(map(str, self.lengths)).split(), "mappings"]
            ),
            "notes": "must be a mapping from keys to text",
            "anything": "",
        }[self.kind]


def _declare(
    kind: str, doc: str, unit: str = "", *, default: Any = dataclasses.MISSING, **spec: Any
) -> Any:
    """Declare a field of a section; `spec` has more of what `Spec` says."""
    metadata = {"spec": Spec(kind, doc, unit, **spec)}
    return dataclasses.field(default=default, metadata=metadata, kw_only=True)


number, integer, flag, text, texts = (
    partial(_declare, kind) for kind in ("number", "integer", "flag", "text", "texts")
)
notes = partial(_declare, "notes", default=())
"""A mapping from keys of this document to text."""


def anything(doc: str, **default: Any) -> Any:
    """Declare what `Section.check` checks; it may be given by its place, too."""
    return dataclasses.field(metadata={"spec": Spec("anything", doc)}, **default)


def angles(doc: str, **default: Any) -> Any:
    """Declare angles of the three actuators, at most a turn."""
    return number(doc, "rad", shape=(3,), least=-TURN, most=TURN, **default)


def choice(doc: str, choices: Sequence[str], **rest: Any) -> Any:
    """Declare one word out of a list."""
    return _declare("choice", doc, choices=tuple(choices), **rest)


def section(doc: str, cls: type[Section], **default: Any) -> Any:
    """Declare a nested section."""
    return _declare("section", doc, section=cls, **default)


def sections(doc: str, cls: type[Section], lengths: Sequence[int] = (), **default: Any) -> Any:
    """Declare a list of sections, of any length where `lengths` is empty.

    Otherwise one entry stands for all of the longest allowed list.
    """
    return _declare("sections", doc, section=cls, lengths=tuple(lengths), **default)


Rules: TypeAlias = "Iterator[tuple[Any, Callable[[], Problem]]]"
"""Whether each rule is broken, and the problem that is reported where it is."""


@dataclass(frozen=True)
class Section:
    """Base of every part of a document; refuses what its fields do not allow."""

    ORIGIN: ClassVar[str] = ""
    """What messages are headed by; by default the name of the class."""

    EFFECTS: ClassVar[tuple[str, ...]] = ()
    """A section has no effect where all of these are zero or not given."""

    IDLE: ClassVar[tuple[str, str]] = "", ""
    """Key and text that refuse a section without effect; no text where its fields refuse it."""

    ONE_OF: ClassVar[tuple[str, ...]] = ()
    """Fields of which a document gives exactly one."""

    def __post_init__(self) -> None:
        problems = []
        for field in dataclasses.fields(self):
            name, spec, value = field.name, field.metadata["spec"], getattr(self, field.name)
            if value is None and field.default is None:
                continue
            try:
                object.__setattr__(self, name, accept(spec, value))
            except ValueError:
                problems.append(Problem(name, value, spec.refuse()))
        problems = problems or [*self._find_idle(), *self.check()]
        if problems:
            raise InputError(self.ORIGIN or type(self).__name__.lower(), problems)

    def _find_idle(self) -> Iterator[Problem]:
        """Yield what has no effect, and what is not one of several."""
        acts = True
        for field in dataclasses.fields(self):
            spec, value = field.metadata["spec"], getattr(self, field.name)
            if spec.acts_on and value != field.default and not self._has_any(spec.acts_on):
                given = "it" if len(spec.acts_on) == 1 else "one"
                text = spec.needs or f"acts on {' or '.join(spec.acts_on)}: give {given}"
                yield Problem(field.name, value, text)
                acts = False
        if self.ONE_OF:
            chosen = [name for name in self.ONE_OF if getattr(self, name)]
            if len(chosen) != 1:
                yield Problem("", chosen or None, "give one of " + ", ".join(self.ONE_OF))
        key, text = self.IDLE
        if text and acts and not self._has_any(self.EFFECTS):
            yield Problem(key, getattr(self, key, None), text)

    def _has_any(self, names: tuple[str, ...]) -> bool:
        values = (getattr(self, name) for name in names)
        return any(any(value) if isinstance(value, tuple) else value for value in values)

    def check(self) -> Iterator[Problem]:
        """Yield the faults that no single field shows; override where rules are not enough."""
        with np.errstate(all="ignore"):
            yield from (problem() for broken, problem in self.rules() if broken)

    def rules(self) -> Rules:
        """Yield the rules that numbers of several fields must keep.

        They also hold for columns in place of numbers: what is broken is then an array.
        """
        return iter(())


def specs(cls: type[Section]) -> dict[str, Spec]:
    """List the declared fields of a section, in order."""
    return {field.name: field.metadata["spec"] for field in dataclasses.fields(cls)}


def make_unchecked(cls: type[Section], values: Mapping[str, Any]) -> Any:
    """Return a section with any values, as columns or symbols, which are not checked."""
    found = object.__new__(cls)
    vars(found).update(values)
    return found


def sections_of(tree: Section, place: Place = ()) -> Iterator[tuple[Place, Section]]:
    """Yield a section and all below it, each with its place."""
    yield place, tree
    for name in specs(type(tree)):
        value = getattr(tree, name)
        if isinstance(value, Section):
            yield from sections_of(value, (*place, name))
        for index, entry in enumerate(value if isinstance(value, tuple) else ()):
            if isinstance(entry, Section):
                yield from sections_of(entry, (*place, name, index))


def has_key(cls: type[Section], key: str) -> bool:
    """Return whether documents of a class may have a key without indices."""
    name, _, rest = key.partition(".")
    spec = specs(cls).get(name)
    if spec is None or not rest:
        return spec is not None
    return spec.section is not None and has_key(spec.section, rest)


def key_of(place: Place) -> str:
    """Return a place as a key."""
    return "".join(f"[{x}]" if isinstance(x, int) else f".{x}" for x in place).removeprefix(".")


def accept(spec: Spec, value: Any) -> Any:
    """Return `value` in its frozen form, or raise ValueError."""
    kind, is_list = spec.kind, isinstance(value, (list, tuple))
    if kind == "number":
        return _numbers(spec, value, spec.shape)
    if kind == "text":
        return frozen_text(value)
    if kind == "texts" and is_list:
        return tuple(map(frozen_text, value))
    if kind == "notes" and isinstance(value, (dict, tuple)):
        pairs = value.items() if isinstance(value, dict) else value
        return tuple((frozen_text(name), frozen_text(note)) for name, note in pairs)
    if kind == "sections" and spec.section and is_list:
        repeated = max(spec.lengths) if spec.lengths and len(value) == 1 else 1
        fits = not spec.lengths or len(value) in spec.lengths
        if fits and all(isinstance(entry, spec.section) for entry in value):
            return tuple(value) * repeated
    fits = {
        "anything": True,
        "flag": value is True or value is False,
        "integer": type(value) is int and spec.least <= value <= spec.most,
        "choice": value in spec.choices,
        "section": spec.section is not None and isinstance(value, spec.section),
    }.get(kind, False)
    if not fits:
        raise ValueError
    return value


def _numbers(spec: Spec, value: Any, shape: tuple[int, ...]) -> Any:
    if shape:
        try:
            fits = len(value) == shape[0] and not isinstance(value, (str, dict, set))
        except TypeError:
            fits = False
        if not fits:
            raise ValueError
        return tuple(_numbers(spec, entry, shape[1:]) for entry in value)
    if isinstance(value, bool) or (isinstance(value, str) and not _NUMBER.fullmatch(value)):
        raise ValueError
    try:
        result = float(value)
    except (TypeError, OverflowError):
        raise ValueError from None
    if not math.isfinite(result) or not spec.least <= result <= spec.most or result <= spec.above:
        raise ValueError
    return result


def frozen_text(value: Any) -> str:
    """Return text without its outer blanks, or raise ValueError."""
    if not isinstance(value, str) or not value.strip() or _UNPRINTABLE.search(value):
        raise ValueError
    return value.strip()


def json_schema(cls: type[Section], title: str) -> dict[str, Any]:
    """Describe the documents that `read(cls, ...)` accepts."""
    return {"$schema": _DRAFT, "title": title, **_object_schema(cls)}


def _object_schema(cls: type[Section]) -> dict[str, Any]:
    described: dict[str, Any] = {"type": "object", "additionalProperties": False}
    if cls.__doc__:
        described["description"] = cls.__doc__.partition("\n")[0]
    properties, required = {}, []
    for field in dataclasses.fields(cls):
        properties[field.name] = _property_schema(field.metadata["spec"])
        if field.default is dataclasses.MISSING:
            required.append(field.name)
        elif isinstance(field.default, (bool, int, float, str)):
            properties[field.name]["default"] = field.default
    if cls.ONE_OF:
        described["oneOf"] = [{"required": [name]} for name in cls.ONE_OF]
    return {**described, "properties": properties, "required": required}


def _property_schema(spec: Spec) -> dict[str, Any]:
    unit = f" [{spec.unit}]" if spec.unit else ""
    described: dict[str, Any] = {"description": spec.doc + unit}
    if spec.kind == "number":
        return described | _number_schema(spec, spec.shape)
    if spec.kind == "integer":
        return described | {"type": "integer", "minimum": spec.least, "maximum": spec.most}
    if spec.kind == "choice":
        return described | {"enum": list(spec.choices)}
    if spec.kind == "section" and spec.section:
        return _object_schema(spec.section) | described
    if spec.kind == "sections" and spec.section:
        lengths = [{"minItems": length, "maxItems": length} for length in spec.lengths]
        entries = {"type": "array", "items": _object_schema(spec.section)}
        return described | entries | ({"anyOf": lengths} if lengths else {})
    if spec.kind == "notes":
        return described | {"type": "object", "additionalProperties": _TEXT}
    if spec.kind == "texts":
        return described | {"type": "array", "items": _TEXT}
    return described | ({"type": "boolean"} if spec.kind == "flag" else _TEXT)


def _number_schema(spec: Spec, shape: tuple[int, ...]) -> dict[str, Any]:
    if shape:
        size = {"minItems": shape[0], "maxItems": shape[0]}
        return {"type": "array", "items": _number_schema(spec, shape[1:]), **size}
    bounds = {"exclusiveMinimum": spec.above, "minimum": spec.least, "maximum": spec.most}
    return {"type": "number"} | {name: x for name, x in bounds.items() if math.isfinite(x)}
