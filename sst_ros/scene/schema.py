# SPDX-License-Identifier: Apache-2.0
"""Documents as trees of frozen dataclasses: every field has a unit and bounds, which are checked.

A class that derives from `Section` is checked whenever it is built, from YAML or from Python.
Reading a document gives either the object or one `InputError` with every fault and its line. The
JSON schema is from the same declarations: editors complete and check YAML with it; what no schema
can express (inertias, angles that must sum to 360 deg) is left to reading.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
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

REQUIRED: Any = object()
"""Default of a field that must be given."""

Place = tuple[str | int, ...]
"""Names and indices of a part of a tree from the root on."""


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
    default: Any = REQUIRED

    def allows(self, x: Any) -> Any:
        """Whether numbers keep the bounds; a nan does not."""
        return (x > self.above) & (x >= self.least) & (x <= self.most)

    def refuse(self) -> str:
        """Describe the values that are allowed, and what may be wrong with others."""
        return self.describe() + (": in rad?" if self.most == TURN else "")

    def describe(self) -> str:
        """Describe the values that are allowed."""
        unit = f" [{self.unit}]" if self.unit else ""
        size = " x ".join(map(str, self.shape))
        what = f"{size} finite numbers" if size else "a finite number"
        ends = (">", self.above), (">=", self.least), ("<=", self.most)
        bounds = "".join(f" {sign} {end:g}" for sign, end in ends if math.isfinite(end))
        counts = " or ".join(map(str, self.lengths)) + " " if self.lengths else ""
        return {
            "number": f"must be {what}{bounds}{unit}",
            "integer": f"must be a whole number from {self.least} to {self.most}{unit}",
            "flag": "must be true or false",
            "text": "must be text without control characters",
            "texts": "must be a list of text",
            "choice": "must be one of " + ", ".join(self.choices),
            "section": "must be a mapping",
            "sections": f"must be a list of {counts}mappings",
            "notes": "must be a mapping from keys to text",
            "anything": "",
        }[self.kind]


def _declare(kind: str, doc: str, unit: str = "", *, default: Any = REQUIRED, **spec: Any) -> Any:
    """Declare a field of a section; `spec` has more of what `Spec` says."""
    metadata = {"spec": Spec(kind, doc, unit, default=default, **spec)}
    default = MISSING if default is REQUIRED else default
    return field(default=default, metadata=metadata, kw_only=True)


number, integer, flag, text, texts = (
    partial(_declare, kind) for kind in ("number", "integer", "flag", "text", "texts")
)
notes = partial(_declare, "notes", default=())
"""A mapping from keys of this document to text."""
vector = partial(number, shape=(3,))
angles = partial(vector, unit="rad", least=-TURN, most=TURN)
"""Angles of the three actuators, at most a turn."""
positive = partial(number, above=0.0)
coefficient = partial(number, least=0.0, default=0.0)


def anything(doc: str, **default: Any) -> Any:
    """Declare what `Section.check` checks; it may be given by its place, too."""
    return field(metadata={"spec": Spec("anything", doc, default=None)}, **default)


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


Rules: TypeAlias = "Iterator[tuple[Any, str, Any, str | Callable[[], str]]]"
"""Whether each rule is broken; key and value that are at fault, and what is allowed.

The last two may be functions, which are called where the rule is broken."""


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
        for name, spec in specs(type(self)).items():
            value = getattr(self, name)
            if value is not None or spec.default is not None:
                try:
                    object.__setattr__(self, name, accept(spec, value))
                except ValueError:
                    problems.append(Problem(name, value, spec.refuse()))
        problems = problems or [*self.settle()] or [*self._find_idle(), *self.check()]
        if problems:
            raise InputError(self.ORIGIN or type(self).__name__.lower(), problems)

    def _find_idle(self) -> Iterator[Problem]:
        """Yield what has no effect, and what is not one of several."""
        acts = True
        for name, spec in specs(type(self)).items():
            value = getattr(self, name)
            if spec.acts_on and value != spec.default and not self._has_any(spec.acts_on):
                given = "it" if len(spec.acts_on) == 1 else "one"
                text = spec.needs or f"acts on {' or '.join(spec.acts_on)}: give {given}"
                yield Problem(name, value, text)
                acts = False
        if self.ONE_OF:
            chosen = [name for name in self.ONE_OF if getattr(self, name)]
            if len(chosen) != 1:
                yield Problem("", chosen or None, "give one of " + ", ".join(self.ONE_OF))
        key, text = self.IDLE
        if text and acts and not self._has_any(self.EFFECTS):
            yield Problem(key, getattr(self, key, None), text)

    def _has_any(self, names: tuple[str, ...]) -> bool:
        return any(has_effect(getattr(self, name)) for name in names)

    def settle(self) -> Iterator[Problem]:
        """Put what may be given in several forms into one; yield what forbids that."""
        return iter(())

    def check(self) -> Iterator[Problem]:
        """Yield the faults that no single field shows; override where rules are not enough."""
        with np.errstate(all="ignore"):
            for broken, key, *found in self.rules():
                if broken:
                    yield Problem(key, *(one() if callable(one) else one for one in found))

    def rules(self) -> Rules:
        """Yield the rules that numbers of several fields must keep.

        They also hold for columns in place of numbers: what is broken is then an array.
        """
        return iter(())


def has_effect(value: Any) -> bool:
    """Return whether a value, or any in a list, is given and not zero."""
    return any(map(has_effect, value)) if isinstance(value, (list, tuple)) else bool(value)


# The tree: sections and tuples, whose leaves are numbers or columns, words and None.


def specs(cls: type[Section]) -> dict[str, Spec]:
    """List the declared fields of a section, in order."""
    return {one.name: one.metadata["spec"] for one in fields(cls)}


def make_unchecked(cls: type[Section], values: Mapping[str, Any]) -> Any:
    """Return a section with any values, as columns or symbols, which are not checked."""
    found = object.__new__(cls)
    vars(found).update(values)
    return found


def parts_of(tree: Any) -> list[tuple[Any, Any]]:
    """List the parts of a section or tuple by name or index; there are none of anything else."""
    if isinstance(tree, tuple):
        return list(zip(getattr(tree, "_fields", range(len(tree))), tree, strict=True))
    return list(vars(tree).items()) if isinstance(tree, Section) else []


def walk(tree: Any, place: Place = ()) -> Iterator[tuple[Place, Any]]:
    """Yield the place of a tree and the tree, then those of all that is in it."""
    yield place, tree
    for name, part in parts_of(tree):
        yield from walk(part, (*place, name))


def leaves(tree: Any) -> dict[Place, Any]:
    """Return the numbers and columns of a tree by their places."""
    return {place: x for place, x in walk(tree) if isinstance(x, (float, np.ndarray))}


def rebuild(tree: Any, values: Mapping[Place, Any], place: Place = ()) -> Any:
    """Return a tree with other values at some places; its sections are not checked."""
    if place in values:
        return values[place]
    parts = {name: rebuild(part, values, (*place, name)) for name, part in parts_of(tree)}
    if isinstance(tree, tuple):
        return type(tree)(*parts.values()) if hasattr(tree, "_fields") else tuple(parts.values())
    return make_unchecked(type(tree), parts) if parts else tree


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


# What a value may be.


def accept(spec: Spec, value: Any) -> Any:
    """Return `value` in its frozen form, or raise ValueError."""
    kind, is_list, section = spec.kind, isinstance(value, (list, tuple)), spec.section or Section
    if kind == "number":
        try:
            return _freeze_numbers(spec, value, spec.shape)
        except (TypeError, OverflowError):
            raise ValueError from None
    if kind == "text":
        return freeze_text(value)
    if kind == "texts" and is_list:
        return tuple(map(freeze_text, value))
    if kind == "notes" and isinstance(value, (dict, tuple)):
        return tuple((freeze_text(name), freeze_text(x)) for name, x in dict(value).items())
    if kind == "sections" and is_list and len(value) in (spec.lengths or [len(value)]):
        if not all(isinstance(entry, section) for entry in value):
            raise ValueError
        return tuple(value) * (max(spec.lengths) if spec.lengths and len(value) == 1 else 1)
    fits = {
        "anything": True,
        "flag": isinstance(value, bool),
        "integer": type(value) is int and spec.least <= value <= spec.most,
        "choice": value in spec.choices,
        "section": isinstance(value, section),
    }
    if not fits.get(kind):
        raise ValueError
    return value


def _freeze_numbers(spec: Spec, value: Any, shape: tuple[int, ...]) -> Any:
    if shape:
        if isinstance(value, (str, dict, set)) or len(value) != shape[0]:
            raise ValueError
        return tuple(_freeze_numbers(spec, entry, shape[1:]) for entry in value)
    if isinstance(value, bool) or (isinstance(value, str) and not _NUMBER.fullmatch(value)):
        raise ValueError
    result = float(value)
    if not (math.isfinite(result) and spec.allows(result)):
        raise ValueError
    return result


def freeze_text(value: Any) -> str:
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
    if cls.ONE_OF:
        described["oneOf"] = [{"required": [name]} for name in cls.ONE_OF]
    known = specs(cls)
    properties = {name: _property_schema(spec) for name, spec in known.items()}
    required = [name for name, spec in known.items() if spec.default is REQUIRED]
    return {**described, "properties": properties, "required": required}


def _property_schema(spec: Spec) -> dict[str, Any]:
    described: dict[str, Any] = {"description": spec.doc + (f" [{spec.unit}]" if spec.unit else "")}
    if isinstance(spec.default, (bool, int, float, str)):
        described["default"] = spec.default
    bounds = {"exclusiveMinimum": spec.above, "minimum": spec.least, "maximum": spec.most}
    known: dict[str, dict[str, Any]] = {
        "number": {"type": "number"} | {name: x for name, x in bounds.items() if math.isfinite(x)},
        "integer": {"type": "integer", "minimum": spec.least, "maximum": spec.most},
        "choice": {"enum": list(spec.choices)},
        "notes": {"type": "object", "additionalProperties": _TEXT},
        "texts": {"type": "array", "items": _TEXT},
        "flag": {"type": "boolean"},
    }
    own = _object_schema(spec.section) if spec.section else known.get(spec.kind, _TEXT)
    for size in reversed(spec.shape):
        own = {"type": "array", "items": own, "minItems": size, "maxItems": size}
    if spec.kind == "sections":
        own = {"type": "array", "items": own}
    if spec.lengths:
        own["anyOf"] = [{"minItems": length, "maxItems": length} for length in spec.lengths]
    return own | described
