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
Place = tuple[str | int, ...]  # names and indices of a part of a tree from the root on


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
        return (
            within & np.any(x * x, axis=-1, keepdims=True) if self.nonzero else within
        )

    def refuse(self) -> str:
        """Describe the values that are allowed, and what may be wrong with others."""
        return self.describe() + ": in rad?" * (self.most == FULL_TURN)

    def describe(self) -> str:
        """Describe the values that are allowed."""
        unit = f" [{self.unit}]" if self.unit else ""
        size = " x ".join(map(str, self.shape))
        what = f"{size} finite numbers" if size else "a finite number"
        ends = (">", self.above), (">=", self.least), ("<=", self.most)
        bounds = " and".join(
            f" {sign} {end:g}" for sign, end in ends if math.isfinite(end)
        )
        row = ", ".join(map(str, ("n", *self.shape))) + "," * (not self.shape)
        counts = " or ".join(map(str, self.lengths)) + " " if self.lengths else ""
        keys = ", ".join(self.section.SPECS) if self.section else ""
        return {
            "number": f"must be {what}{bounds}{unit}" + ", not all zero" * self.nonzero,
            "samples": f"must be finite numbers, shape ({row}){unit}",
            "integer": f"must be a whole number from {self.least} to {self.most}{unit}",
            "flag": "must be true or false",
            "text": "must be text without control characters",
            "texts": "must be a list of text",
            "choice": "must be one of " + ", ".join(self.choices),
            "section": f"must be a mapping with the keys {keys}",
            "sections": f"must be a list of {counts}mappings",
            "notes": "must be a mapping from keys to text",
            "anything": "",
        }[self.kind]


def entry(doc: str, unit: str = "", default: Any = REQUIRED, **rules: Any) -> Any:
    """Declare a field of a section, whose type says what it may hold.

    None in it is its default.

    It may be float, a tuple of as many, or of such; int, bool, str, a section, a tuple
    of any number of them, or of three, for which one may stand; tuple[tuple[str, str],
    ...] is a mapping to text, Array has a row of some `shape` for each sample. `rules`
    has more of what `Spec` says.
    """
    given = MISSING if default is REQUIRED else default
    return field(
        default=given, metadata={"spec": Spec("", doc, unit, **rules)}, kw_only=True
    )


angles = partial(entry, unit="rad", least=-FULL_TURN, most=FULL_TURN)
"""Angles of the three actuators, at most a turn."""
positive = partial(entry, above=0.0)
amount = partial(entry, least=1e-12)
"""A positive number of a scene.

A smaller one is a slip of units, and powers leave double precision.
"""
coefficient = partial(entry, least=0.0, default=0.0)


def choice(doc: str, words: tuple[str, ...]) -> Any:
    """Declare a field that is one of some words, by default the first."""
    return entry(doc, choices=words, default=words[0])


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
            if isinstance(declared, Field) and str(hint).endswith("| None"):
                declared.default = (
                    None if declared.default is MISSING else declared.default
                )
        dataclass(frozen=True, repr=not issubclass(cls, Explained))(cls)
        hints, specs = typing.get_type_hints(cls), {}
        for one in fields(cls):
            spec: Spec = one.metadata["spec"]
            if not spec.kind:
                default = REQUIRED if one.default is MISSING else one.default
                spec = replace(spec, **_read_type(hints[one.name]), default=default)
            specs[one.name] = replace(spec, kind="choice") if spec.choices else spec
        cls.SPECS = specs

    def __post_init__(self) -> None:
        given = ((name, spec, getattr(self, name)) for name, spec in self.SPECS.items())
        kept = (
            one for one in given if one[2] is not None or one[1].default is not None
        )
        try:
            vars(self).update(_freeze_all(kept))
            before = dict(vars(self))
            problems = [*self.settle()] or [*self._find_idle(), *self._find_broken()]
            changed = {
                name: x for name, x in before.items() if vars(self)[name] is not x
            }
            self._remember({}, changed)
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
        """Put what may be given in several forms into one; yield what forbids that."""
        return iter(())

    def _find_broken(self) -> Iterator[Problem]:
        """Yield the rules that are broken."""
        with np.errstate(all="ignore"):
            yield from (Problem(*found) for broken, *found in self.rules() if broken)

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
    if kind := _ENTRY_KINDS.get(hint):
        return {"kind": kind}
    if not (parts := typing.get_args(hint)):
        return {"kind": "section", "section": hint}
    inner = _read_type(parts[0])
    if inner["kind"] == "section":
        lengths = () if parts[1] is Ellipsis else (1, len(parts))
        return inner | {"kind": "sections", "lengths": lengths}
    return inner | {"shape": (len(parts), *inner.get("shape", ()))}


# From what is given to what is kept.


def build(cls: type[S], values: Any, origin: str = "") -> S:
    """Build a section from nested mappings and lists, in which arrays are allowed.

    Messages are headed by `origin`; InputError lists every fault.
    """
    known = cls.SPECS
    if not isinstance(values, Mapping):
        allowed = Spec("section", "", section=cls).describe()
        raise refusal(origin, "", values, allowed)
    problems = []
    for name in [name for name in values if name not in known]:
        allowed = (
            f"unknown key; allowed are {', '.join(known)}{suggestion(str(name), known)}"
        )
        problems.append(Problem(str(name), values[name], allowed))
    for name, spec in known.items():
        if spec.default is REQUIRED and name not in values:
            problems.append(Problem(name, None, "is missing; " + spec.describe()))
    given = {name: value for name, value in values.items() if name in known}
    for name, value in given.items():
        # as in a YAML file
        if known[name].kind == "text" and isinstance(value, (int, float)):
            given[name] = str(value)
    try:
        frozen = _freeze_all(
            (name, known[name], value) for name, value in given.items()
        )
        if not problems:
            section = cls(**frozen)
            numbers = {
                name: x for name, x in given.items() if known[name].kind == "number"
            }
            texts_of(section).update(
                (name, x) for name, x in numbers.items() if _has_text(x)
            )
            return section
    except InputError as error:
        problems += error.problems
    raise InputError(origin, problems)


# How numbers were written: `certify` proves for all that a document says, and no less.


def texts_of(section: Section) -> dict[str, Any]:
    """Return the numbers of a section that were given as text, by field.

    Lists where they were.
    """
    texts: dict[str, Any] = getattr(section, "_texts", {})
    return texts


def converted_of(section: Section) -> dict[str, Any]:
    """Return the fields that were converted when the section was read.

    They are returned as they were given.
    """
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
    for name, text in texts_of(old).items():
        if vars(old)[name] == vars(new)[name]:
            texts_of(new).setdefault(name, text)
    if all(
        vars(old)[name] == vars(new)[name] for name in old.CONVERTED
    ) and not converted_of(new):
        converted_of(new).update(converted_of(old))
    for name, part in vars(old).items():
        keep_texts(part, vars(new)[name])


def _freeze_all(given: Iterable[tuple[str, Spec, Any]]) -> dict[str, Any]:
    """Accept values by their keys.

    InputError lists what is refused, and what in it is.
    """
    found: dict[str, Any] = {}
    problems = []
    for key, spec, value in given:
        try:
            found[key] = accept(spec, value)
        except LostMeaning as error:
            problems.append(Problem(key, value, f"{spec.refuse()} ({error})"))
        except (ValueError, TypeError, OverflowError, MemoryError):
            problems.append(Problem(key, value, spec.refuse()))
        except InputError as error:
            for one in error.problems:
                dot = "." if one.key and one.key[0] != "[" else ""
                problems.append(replace(one, key=f"{key}{dot}{one.key}"))
    if problems:
        raise InputError("", problems)
    return found


def accept(spec: Spec, value: Any) -> Any:
    """Return a value in its frozen form.

    ValueError, TypeError or OverflowError is raised where it is refused, InputError
    where parts of it are, with their keys.
    """
    kind, section = spec.kind, spec.section or Section
    if kind == "samples":
        return _freeze_samples(spec, value)
    if isinstance(value, (np.ndarray, np.generic)):
        if reason := find_lost_meaning(value):
            raise LostMeaning(reason)
        value = value.tolist()
    if kind == "number":
        return _freeze_numbers(spec, value, spec.shape)
    if kind == "text":
        return _freeze_text(value)
    if kind == "notes" and isinstance(value, (Mapping, tuple)):
        note = Spec("text", "")
        each = ((_freeze_text(name), note, x) for name, x in dict(value).items())
        return tuple(_freeze_all(each).items())
    if kind == "section" and isinstance(value, Mapping):
        return build(section, value)
    if isinstance(value, (list, tuple)):
        if kind == "texts":
            return tuple(map(_freeze_text, value))
        if kind == "sections" and len(value) in (spec.lengths or [len(value)]):
            entry = replace(spec, kind="section")
            parts = _freeze_all((f"[{i}]", entry, x) for i, x in enumerate(value))
            times = max(spec.lengths) if spec.lengths and len(value) == 1 else 1
            return (*parts.values(),) * times
    if kind == "flag" and isinstance(value, str):
        value = {"true": True, "false": False}.get(value.lower())
    elif (
        kind == "integer"
        and isinstance(value, str)
        and re.fullmatch("[-+]?[0-9]+", value)
    ):
        value = int(value)
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
        if not isinstance(value, (list, tuple)) and (
            reason := find_lost_meaning(value)
        ):
            raise LostMeaning(reason)
        each = replace(spec, nonzero=False)
        found = tuple(_freeze_numbers(each, entry, shape[1:]) for entry in value)
        if spec.nonzero and not any(x * x for x in found):
            raise ValueError
        return found
    if type(value) is not float and (reason := find_lost_meaning(value)):
        raise LostMeaning(reason)
    text = isinstance(value, str) and not NUMBER.fullmatch(value)
    if text or isinstance(value, (bool, np.bool_)):
        raise ValueError
    result = float(value)
    if not (math.isfinite(result) and spec.allows(result)):
        raise ValueError
    return result


def _freeze_samples(spec: Spec, value: Any) -> Array:
    array = freeze(real_numbers(value, seconds=spec.unit == "s"))
    fits = array.ndim > 0 and array.shape[1:] == spec.shape
    refuse_unless("", ("", array.shape, fits, spec.describe()))
    for place in np.argwhere(~np.isfinite(array))[:1].tolist():
        raise refusal("", str(place), float(array[tuple(place)]), "must be finite")
    return array


def _freeze_text(value: Any) -> str:
    """Return text without its outer blanks, or raise ValueError."""
    if not isinstance(value, str) or not value.strip() or _UNPRINTABLE.search(value):
        raise ValueError
    return value.strip()


def has_effect(value: Any) -> bool:
    """Return whether a value, or any in a list, is given and not zero."""
    return (
        any(map(has_effect, value)) if isinstance(value, (list, tuple)) else bool(value)
    )


def _acts(values: Mapping[str, Any], names: tuple[str, ...]) -> bool:
    """Whether any of these values has an effect, or there are no names."""
    return not names or has_effect([values.get(name) for name in names])


def drop_idle(cls: type[Section] | None, value: Any) -> Any:
    """Return a document of a section without what has no effect in it.

    None if nothing has.

    A document that says such things is refused, as a friction whose coefficients are
    zero.
    """
    if isinstance(value, list):
        return [
            part
            for part in (drop_idle(cls, entry) for entry in value)
            if part is not None
        ]
    if cls is None:
        return value
    known = cls.SPECS
    given = {name: drop_idle(known[name].section, x) for name, x in value.items()}
    of = {name: known[name].acts_on for name, x in given.items() if x is not None}
    kept = {name: given[name] for name, others in of.items() if _acts(given, others)}
    return kept if _acts(given, cls.EFFECTS) else None


# The tree: sections and tuples, whose leaves are numbers or columns, words and None.


def build_unchecked(cls: type[Section] | None, value: Any) -> Any:
    """Build a section from nested dicts and lists of any values, which are not checked.

    They may be columns or symbols. A number that a section must have and these values
    have not is zero.
    """
    if isinstance(value, list):
        return tuple(build_unchecked(cls, entry) for entry in value)
    if cls is None or not isinstance(value, dict):
        return value
    found = object.__new__(cls)
    for name, spec in cls.SPECS.items():
        default = 0.0 if spec.default is REQUIRED else spec.default
        vars(found)[name] = build_unchecked(spec.section, value.get(name, default))
    return found


def walk(tree: Any, place: Place = ()) -> Iterator[tuple[Place, Any]]:
    """Yield the place of a tree and the tree, then those of all that is in it."""
    yield place, tree
    for name, part in _parts_of(tree):
        yield from walk(part, (*place, name))


def _parts_of(tree: Any) -> list[tuple[Any, Any]]:
    """List the parts of a section or tuple by name or index.

    There are none of anything else.
    """
    if isinstance(tree, tuple):
        return list(zip(getattr(tree, "_fields", range(len(tree))), tree, strict=True))
    return list(vars(tree).items()) if isinstance(tree, Section) else []


def leaves(tree: Any) -> dict[Place, Any]:
    """Return the numbers and columns of a tree by their places."""
    return {place: x for place, x in walk(tree) if isinstance(x, (float, np.ndarray))}


def rebuild(tree: Any, values: Mapping[Place, Any], place: Place = ()) -> Any:
    """Return a tree with other values at some places; its sections are not checked."""
    if place in values:
        return values[place]
    parts = {
        name: rebuild(part, values, (*place, name)) for name, part in _parts_of(tree)
    }
    if isinstance(tree, tuple):
        return (
            type(tree)(*parts.values())
            if hasattr(tree, "_fields")
            else tuple(parts.values())
        )
    return build_unchecked(type(tree), parts) if parts else tree


def key_of(place: Place) -> str:
    """Return a place as a key."""
    return "".join(
        f"[{x}]" if isinstance(x, int) else f".{x}" for x in place
    ).removeprefix(".")
