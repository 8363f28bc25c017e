# SPDX-License-Identifier: Apache-2.0
"""Documents as trees of frozen dataclasses: every field has a unit and bounds.

The bounds are checked. A class that derives from `Section` is checked whenever it is
built, from YAML or from Python. Building one gives either the object or one
`InputError` with every fault.
"""

from __future__ import annotations

import math
import re
import typing
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, field, fields, replace
from functools import partial
from types import UnionType
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias, TypeVar

import numpy as np

from sst_ros.errors import InputError, Problem, refusal, refuse_unless, suggestion
from sst_ros.state import (
    Array,
    Explained,
    LostMeaning,
    find_lost_meaning,
    freeze,
    real_numbers,
)

if TYPE_CHECKING:
    from typing_extensions import dataclass_transform
else:

    def dataclass_transform(**_):
        """Leave a class as it is: only type checkers need this."""
        return lambda cls: cls


NUMBER = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
"""A decimal number of YAML 1.2 and JSON.

There is no 3_5, 0x10 or 1:30, of which YAML 1.1 makes others.
"""

_UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
"""What a terminal obeys, and halves of characters."""

# no initial or desired angle of an actuator [rad] is larger: it is in degrees
FULL_TURN = 2.0 * math.pi
REQUIRED: Any = object()  # default of a field that must be given
Place = tuple[str | int, ...]  # names and indices from the root of a tree to a part


@dataclass(frozen=True)
class Spec:
    """What a field may hold.

    `shape` () is a scalar, (3,) a vector, (3, 3) a list of rows. Without any of the
    fields `acts_on` it has no effect.
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
    default: Any = None
    nonzero: bool = False  # nor may the squares be, as of a quaternion with a direction

    def allows(self, x: Any) -> Any:
        """Whether numbers keep the bounds, and directions are not zero.

        A nan does not.
        """
        within = (x > self.above) & (x >= self.least) & (x <= self.most)
        if self.nonzero:
            within = within & np.any(x * x, axis=-1, keepdims=True)
        return within

    def refuse(self) -> str:
        """Describe the values that are allowed, and what may be wrong with others."""
        if self.most == FULL_TURN:
            return f"{self.describe()}: in rad?"
        return self.describe()

    def describe(self) -> str:
        """Describe the values that are allowed."""
        unit = f" [{self.unit}]" if self.unit else ""
        match self.kind:
            case "number":
                nonzero = ", not all zero" if self.nonzero else ""
                return self._describe_numbers() + unit + nonzero
            case "samples":
                shape = ", ".join(map(str, ("n", *self.shape)))
                if not self.shape:
                    shape = "n,"
                return f"must be finite numbers, shape ({shape}){unit}"
            case "integer":
                return f"must be a whole number from {self.least} to {self.most}{unit}"
            case "flag":
                return "must be true or false"
            case "text":
                return "must be text without control characters"
            case "texts":
                return "must be a list of text"
            case "choice":
                return "must be one of " + ", ".join(self.choices)
            case "section":
                keys = ", ".join(self.section.SPECS) if self.section else ""
                return f"must be a mapping with the keys {keys}"
            case "sections" if self.lengths:
                counts = " or ".join(map(str, self.lengths))
                return f"must be a list of {counts} mappings"
            case "sections":
                return "must be a list of mappings"
            case "notes":
                return "must be a mapping from keys to text"
        return ""

    def _describe_numbers(self) -> str:
        """Describe numbers by how many there are and their bounds."""
        text = "must be a finite number"
        if self.shape:
            text = f"must be {' x '.join(map(str, self.shape))} finite numbers"
        ends = {">": self.above, ">=": self.least, "<=": self.most}
        bounds = [
            f" {sign} {end:g}" for sign, end in ends.items() if math.isfinite(end)
        ]
        return text + " and".join(bounds)


def entry(doc: str, unit: str = "", default: Any = REQUIRED, **rules: Any) -> Any:
    """Declare a field of a section, whose type says what it may hold.

    The type may be float, a tuple of floats, or a tuple of such tuples; int, bool, str,
    a section, a tuple of any number of sections, or of three, for which one may stand.
    tuple[tuple[str, str], ...] is a mapping to text; an Array has a row of some `shape`
    for each sample. With `| None` the default is None. `rules` are further fields of
    `Spec`.
    """
    spec = Spec("", doc, unit, **rules)
    if default is REQUIRED:
        return field(metadata={"spec": spec}, kw_only=True)
    return field(default=default, metadata={"spec": spec}, kw_only=True)


angles = partial(entry, unit="rad", least=-FULL_TURN, most=FULL_TURN)
"""Angles of the three actuators, at most a turn."""
positive = partial(entry, above=0.0)
amount = partial(entry, least=1e-12)
"""A positive number of a scene.

A smaller one is a slip of units, and powers leave double precision.
"""
coefficient = partial(entry, least=0.0, default=0.0)


def choice(doc: str, choices: tuple[str, ...]) -> Any:
    """Declare a field that is one of some words, by default the first."""
    return entry(doc, choices=choices, default=choices[0])


def anything(doc: str, **default: Any) -> Any:
    """Declare what `Section.rules` check; it may be given by its place, too."""
    return field(metadata={"spec": Spec("anything", doc)}, **default)


Rules: TypeAlias = "Iterator[tuple[Any, str, Any, str]]"
"""Whether each rule is broken; key and value that are at fault, and what is allowed."""


@dataclass_transform(frozen_default=True)
class Section:
    """Base of every part of a document; refuses what its fields do not allow.

    Each class that derives from it is a frozen dataclass.
    """

    ORIGIN: ClassVar[str] = ""
    """What messages are headed by; by default the name of the class."""

    EFFECTS: ClassVar[tuple[str, ...]] = ()
    """A section is refused, as without effect, if all of these are zero or absent."""

    ONE_OF: ClassVar[tuple[str, ...]] = ()
    """Fields of which a document gives exactly one."""

    CONVERTED: ClassVar[tuple[str, ...]] = ()
    """Fields that `settle` converts, and those that it converts them by."""

    SPECS: ClassVar[dict[str, Spec]] = {}
    """What each field may hold, in order."""

    __slots__ = ("_converted", "_texts")
    # numbers that were given as text, by field, as in a YAML file
    _texts: dict[str, Any]
    _converted: dict[str, Any]  # fields that `settle` has replaced, as they were given

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __init_subclass__(cls) -> None:
        for name, hint in cls.__annotations__.items():
            declared = vars(cls).get(name)
            if not isinstance(declared, Field) or declared.default is not MISSING:
                continue
            if str(hint).endswith("| None"):  # may be left out
                declared.default = None
        dataclass(frozen=True, repr=not issubclass(cls, Explained))(cls)
        hints = typing.get_type_hints(cls)
        specs = {}
        for declared in fields(cls):
            spec: Spec = declared.metadata["spec"]
            if not spec.kind:
                has_default = declared.default is not MISSING
                default = declared.default if has_default else REQUIRED
                spec = replace(
                    spec, **_read_type(hints[declared.name]), default=default
                )
            if spec.choices:
                spec = replace(spec, kind="choice")
            specs[declared.name] = spec
        cls.SPECS = specs

    def __post_init__(self) -> None:
        values = []  # to be checked
        for name, spec in self.SPECS.items():
            value = getattr(self, name)
            # None is allowed where it is the default: then the field is left out.
            if value is not None or spec.default is not None:
                values.append((name, spec, value))
        try:
            vars(self).update(_freeze_all(values))
            before = dict(vars(self))
            problems = [*self.settle()]
            if not problems:
                problems = [*self._find_idle(), *self._find_broken()]
            converted = {}
            for name, value in before.items():
                if vars(self)[name] is not value:
                    converted[name] = value
            self._remember({}, converted)
        except InputError as error:
            problems = [*error.problems]
        if problems:
            raise InputError(self.ORIGIN or type(self).__name__.lower(), problems)

    def _remember(self, texts: dict[str, Any], converted: dict[str, Any]) -> None:
        object.__setattr__(self, "_texts", texts)
        object.__setattr__(self, "_converted", converted)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy needs: fields, and how they were written."""
        return {
            **vars(self),
            "_texts": texts_of(self),
            "_converted": converted_of(self),
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a copy."""
        fields = dict(state)
        self._remember(fields.pop("_texts", {}), fields.pop("_converted", {}))
        vars(self).update(fields)

    def __dir__(self) -> list[str]:
        """Show what a document has, and nothing of how it is checked."""
        return [
            name
            for name in super().__dir__()
            if name[0] == "_" or name not in vars(Section)
        ]

    def _find_idle(self) -> Iterator[Problem]:
        """Yield what has no effect, and what is not one of several."""
        if not _acts(vars(self), self.EFFECTS):
            names = " or ".join(self.EFFECTS)
            yield Problem("", None, f"has no effect without {names}: leave it out")
            return
        for name, spec in self.SPECS.items():
            value = getattr(self, name)
            if not _acts(vars(self), spec.acts_on) and value != spec.default:
                yield Problem(
                    name, value, f"acts on {' or '.join(spec.acts_on)}: give it"
                )
        chosen = [name for name in self.ONE_OF if getattr(self, name)]
        if self.ONE_OF and len(chosen) != 1:
            yield Problem("", chosen or None, "give one of " + ", ".join(self.ONE_OF))

    def settle(self) -> Iterator[Problem]:
        """Normalize alternative input forms; yield what forbids that."""
        return iter(())

    def _find_broken(self) -> Iterator[Problem]:
        """Yield the rules that are broken."""
        with np.errstate(all="ignore"):
            for broken, key, value, requirement in self.rules():
                if broken:
                    yield Problem(key, value, requirement)

    def rules(self) -> Rules:
        """Yield the rules that no single field shows.

        They also hold for columns in place of numbers: what is broken is then an array.
        """
        return iter(())


S = TypeVar("S", bound=Section)


_ENTRY_KINDS = {
    float: "number", int: "integer", bool: "flag", str: "text",
    tuple[str, ...]: "texts", tuple[tuple[str, str], ...]: "notes", Array: "samples",
}  # fmt: skip


def _read_type(hint: Any) -> dict[str, Any]:
    """Return what the type of a field says of its `Spec`."""
    if typing.get_origin(hint) is UnionType:
        hint = typing.get_args(hint)[0]
    if hint in _ENTRY_KINDS:
        return {"kind": _ENTRY_KINDS[hint]}
    components = typing.get_args(hint)
    if not components:
        return {"kind": "section", "section": hint}
    inner = _read_type(components[0])
    if inner["kind"] == "section":
        any_number = components[1] is Ellipsis
        lengths = () if any_number else (1, len(components))
        return inner | {"kind": "sections", "lengths": lengths}
    return inner | {"shape": (len(components), *inner.get("shape", ()))}


# From what is given to what is kept.


def build(cls: type[S], values: Any, origin: str = "") -> S:
    """Build a section from nested mappings and lists, in which arrays are allowed.

    Messages are headed by `origin`; InputError lists every fault.
    """
    specs = cls.SPECS
    if not isinstance(values, Mapping):
        requirement = Spec("section", "", section=cls).describe()
        raise refusal(origin, "", values, requirement)
    problems = []
    fields_given = {}
    for name, value in values.items():
        if name not in specs:
            keys = f"unknown key; allowed are {', '.join(specs)}"
            requirement = keys + suggestion(str(name), specs)
            problems.append(Problem(str(name), value, requirement))
        elif specs[name].kind == "text" and isinstance(value, (int, float)):
            fields_given[name] = str(value)  # as in a YAML file
        else:
            fields_given[name] = value
    for name, spec in specs.items():
        if spec.default is REQUIRED and name not in values:
            problems.append(Problem(name, None, "is missing; " + spec.describe()))
    try:
        frozen = _freeze_all(
            (name, specs[name], value) for name, value in fields_given.items()
        )
        if not problems:
            section = cls(**frozen)
            texts = texts_of(section)
            for name, value in fields_given.items():
                if specs[name].kind == "number" and _has_text(value):
                    texts[name] = value
            return section
    except InputError as error:
        problems += error.problems
    raise InputError(origin, problems)


# How numbers were written: `certify` proves for all that a document says, and no less.


def texts_of(section: Section) -> dict[str, Any]:
    """Return the numbers of a section that were given as text, by field.

    A field of several numbers has a list.
    """
    texts: dict[str, Any] = getattr(section, "_texts", {})
    return texts


def converted_of(section: Section) -> dict[str, Any]:
    """Return the fields that `settle` converted, as they were given."""
    converted: dict[str, Any] = getattr(section, "_converted", {})
    return converted


def _has_text(value: Any) -> bool:
    """Return whether a number, or any in a list, has its digits.

    A text and a whole number have them.
    """
    if isinstance(value, (list, tuple)):
        return any(map(_has_text, value))
    return isinstance(value, (str, int))


def keep_texts(old: Any, new: Any) -> None:
    """Let a tree of sections remember how another one was written.

    It does so where their numbers agree.
    """
    if isinstance(old, tuple) and isinstance(new, tuple):
        for before, after in zip(old, new, strict=False):
            keep_texts(before, after)
    if not isinstance(old, Section) or type(old) is not type(new):
        return
    old_values = vars(old)
    new_values = vars(new)
    for name, text in texts_of(old).items():
        if old_values[name] == new_values[name]:
            texts_of(new).setdefault(name, text)
    unchanged = all(old_values[name] == new_values[name] for name in old.CONVERTED)
    if unchanged and not converted_of(new):
        converted_of(new).update(converted_of(old))
    for name, subtree in old_values.items():
        keep_texts(subtree, new_values[name])


def _freeze_all(values: Iterable[tuple[str, Spec, Any]]) -> dict[str, Any]:
    """Return values in their frozen form, by key.

    InputError lists what is refused, also inside of the values.
    """
    frozen: dict[str, Any] = {}
    problems = []
    for key, spec, value in values:
        try:
            frozen[key] = accept(spec, value)
        except LostMeaning as error:
            problems.append(Problem(key, value, f"{spec.refuse()} ({error})"))
        except (ValueError, TypeError, OverflowError, MemoryError):
            problems.append(Problem(key, value, spec.refuse()))
        except InputError as error:
            for problem in error.problems:
                needs_dot = problem.key and problem.key[0] != "["
                inner_key = f".{problem.key}" if needs_dot else problem.key
                problems.append(replace(problem, key=f"{key}{inner_key}"))
    if problems:
        raise InputError("", problems)
    return frozen


def accept(spec: Spec, value: Any) -> Any:
    """Return a value in its frozen form.

    Raises ValueError, TypeError or OverflowError where the value is refused, InputError
    where parts of it are, with their keys.
    """
    if spec.kind == "samples":
        return _freeze_samples(spec, value)
    if isinstance(value, (np.ndarray, np.generic)):
        if reason := find_lost_meaning(value):
            raise LostMeaning(reason)
        value = value.tolist()
    if spec.kind == "number":
        return _freeze_numbers(spec, value, spec.shape)
    if spec.kind == "text":
        return _freeze_text(value)
    if spec.kind == "notes" and isinstance(value, (Mapping, tuple)):
        note = Spec("text", "")
        notes = ((_freeze_text(key), note, text) for key, text in dict(value).items())
        return tuple(_freeze_all(notes).items())
    if spec.kind == "section" and isinstance(value, Mapping):
        return build(spec.section or Section, value)
    if spec.kind == "texts" and isinstance(value, (list, tuple)):
        return tuple(map(_freeze_text, value))
    if spec.kind == "sections" and isinstance(value, (list, tuple)):
        return _freeze_sections(spec, value)
    value = _read_word(spec, value)
    fits = {
        "anything": True,
        "flag": isinstance(value, bool),
        "integer": type(value) is int and spec.least <= value <= spec.most,
        "choice": value in spec.choices,
        "section": isinstance(value, spec.section or Section),
    }
    if not fits.get(spec.kind):
        raise ValueError
    return value


def _freeze_sections(
    spec: Spec, values: list[Any] | tuple[Any, ...]
) -> tuple[Section, ...]:
    """Return a list of sections; one stands for all where the number is fixed."""
    if spec.lengths and len(values) not in spec.lengths:
        raise ValueError
    section = replace(spec, kind="section")
    sections = _freeze_all((f"[{i}]", section, x) for i, x in enumerate(values))
    frozen = tuple(sections.values())
    if spec.lengths and len(frozen) == 1:
        return frozen * max(spec.lengths)
    return frozen


def _read_word(spec: Spec, value: Any) -> Any:
    """Return a flag or a whole number that was given as text, else the value."""
    if not isinstance(value, str):
        return value
    if spec.kind == "flag":
        return {"true": True, "false": False}.get(value.lower())
    if spec.kind == "integer" and re.fullmatch("[-+]?[0-9]+", value):
        return int(value)
    return value


def _freeze_numbers(spec: Spec, value: Any, shape: tuple[int, ...]) -> Any:
    """Return finite numbers that the field allows: a float, or tuples of a shape."""
    if not shape:
        return _freeze_number(spec, value)
    if isinstance(value, (str, dict, set)) or len(value) != shape[0]:
        raise ValueError
    if not isinstance(value, (list, tuple)) and (reason := find_lost_meaning(value)):
        raise LostMeaning(reason)
    component = replace(spec, nonzero=False)
    numbers = tuple(_freeze_numbers(component, entry, shape[1:]) for entry in value)
    if spec.nonzero and not any(x * x for x in numbers):
        raise ValueError
    return numbers


def _freeze_number(spec: Spec, value: Any) -> float:
    if type(value) is not float and (reason := find_lost_meaning(value)):
        raise LostMeaning(reason)
    if isinstance(value, (bool, np.bool_)):
        raise ValueError
    if isinstance(value, str) and not NUMBER.fullmatch(value):
        raise ValueError
    number = float(value)
    if not (math.isfinite(number) and spec.allows(number)):
        raise ValueError
    return number


def _freeze_samples(spec: Spec, value: Any) -> Array:
    array = freeze(real_numbers(value, seconds=spec.unit == "s"))
    fits = array.ndim > 0 and array.shape[1:] == spec.shape
    refuse_unless("", ("", array.shape, fits, spec.describe()))
    bad_places = np.argwhere(~np.isfinite(array)).tolist()
    if bad_places:
        place = bad_places[0]
        raise refusal("", str(place), float(array[tuple(place)]), "must be finite")
    return array


def _freeze_text(value: Any) -> str:
    """Return text without its outer blanks, or raise ValueError."""
    if not isinstance(value, str) or not value.strip() or _UNPRINTABLE.search(value):
        raise ValueError
    return value.strip()


def has_effect(value: Any) -> bool:
    """Return whether a value, or any in a list, is given and not zero."""
    if isinstance(value, (list, tuple)):
        return any(map(has_effect, value))
    return bool(value)


def _acts(values: Mapping[str, Any], names: tuple[str, ...]) -> bool:
    """Whether any of these values has an effect, or there are no names."""
    return not names or has_effect([values.get(name) for name in names])


def drop_idle(cls: type[Section] | None, value: Any) -> Any:
    """Return a document of a section without what has no effect in it.

    None if nothing has. Such things are refused when a section is built, as a friction
    whose coefficients are zero.
    """
    if isinstance(value, list):
        entries = [drop_idle(cls, entry) for entry in value]
        return [entry for entry in entries if entry is not None]
    if cls is None:
        return value
    specs = cls.SPECS
    fields_left = {name: drop_idle(specs[name].section, x) for name, x in value.items()}
    if not _acts(fields_left, cls.EFFECTS):
        return None
    document = {}
    for name, entry in fields_left.items():
        if entry is not None and _acts(fields_left, specs[name].acts_on):
            document[name] = entry
    return document


# The tree: sections and tuples, whose leaves are numbers or columns, words and None.


def build_unchecked(cls: type[Section] | None, value: Any) -> Any:
    """Build a section from nested dicts and lists of any values, which are not checked.

    They may be columns or symbols. A number that a section must have and that is not
    given is zero.
    """
    if isinstance(value, list):
        return tuple(build_unchecked(cls, entry) for entry in value)
    if cls is None or not isinstance(value, dict):
        return value
    section = object.__new__(cls)
    for name, spec in cls.SPECS.items():
        default = 0.0 if spec.default is REQUIRED else spec.default
        vars(section)[name] = build_unchecked(spec.section, value.get(name, default))
    return section


def walk(tree: Any, place: Place = ()) -> Iterator[tuple[Place, Any]]:
    """Yield the place of a tree and the tree, then those of all that is in it."""
    yield place, tree
    for name, subtree in _children_of(tree):
        yield from walk(subtree, (*place, name))


def _children_of(tree: Any) -> list[tuple[Any, Any]]:
    """List what a section or tuple holds, by name or index.

    Anything else holds nothing.
    """
    if isinstance(tree, tuple):
        names = getattr(tree, "_fields", range(len(tree)))
        return list(zip(names, tree, strict=True))
    if isinstance(tree, Section):
        return list(vars(tree).items())
    return []


def leaves(tree: Any) -> dict[Place, Any]:
    """Return the numbers and columns of a tree by their places."""
    return {place: x for place, x in walk(tree) if isinstance(x, (float, np.ndarray))}


def rebuild(tree: Any, values: Mapping[Place, Any], place: Place = ()) -> Any:
    """Return a tree with other values at some places; its sections are not checked."""
    if place in values:
        return values[place]
    children = {
        name: rebuild(subtree, values, (*place, name))
        for name, subtree in _children_of(tree)
    }
    if not isinstance(tree, tuple):
        return build_unchecked(type(tree), children) if children else tree
    if hasattr(tree, "_fields"):
        return type(tree)(*children.values())
    return tuple(children.values())


def key_of(place: Place) -> str:
    """Return a place as a key."""
    return "".join(
        f"[{x}]" if isinstance(x, int) else f".{x}" for x in place
    ).removeprefix(".")
