# SPDX-License-Identifier: Apache-2.0
"""The numbers of a scene in balls, from the document on, and programs of them.

Programs are functions of these numbers. Reading a scene converts some of it in
floats: arcs to directions, an inertia about the centre of mass to one about O, a
restitution to a damping. Here these conversions are made again, in balls, from what the
document says. What no range touches is computed once; what a range touches becomes part
of the programs, so that one number of the document is the same number wherever it acts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

from sst_ros.dynamics import kernel
from sst_ros.errors import refusal, refuse_unless
from sst_ros.mechanism import generic_math as gm
from sst_ros.mechanism.generic_math import Triple, cross3, dot3, triple
from sst_ros.programs.expression import (
    Expression,
    Program,
    divide,
    mark_present,
    trace,
)
from sst_ros.proof import enclosure
from sst_ros.proof.balls import PRECISION, arb, between, half_unit, number_ball
from sst_ros.scene.bodies import ABOUT_CENTRE, Base, Inertia, Link, shift_inertia
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import (
    Place,
    Section,
    build_unchecked,
    converted_of,
    leaves,
    rebuild,
    texts_of,
    walk,
)
from sst_ros.scene.torque_profile import SineTorque, TorqueProfile
from sst_ros.scene.yaml_document import find_fields

Range = float | tuple[float, float] | str
"""A half-width, an interval, or "digits": half a unit of the last digit written."""

LARGEST_RANGE = 1e300  # magnitude of the numbers of a range
READING = "r"  # input of programs: how numbers are taken, see `SceneBalls`
DEGREE: Place = ("degree",)  # place of pi / 180 among the constants
DAMPING: Place = ("stroke", "damping")
RESTITUTION: tuple[Place, Place] = (
    ("stroke", "restitution"),
    ("stroke", "impact_rate"),
)
_NO_EFFECT: dict[Place, str] = {
    ("base", "radius"): "does not act on the motion",
    ("star", "radius"): "does not act on the motion",
    ("initial", "orientation"): "only selects the assembly",
    ("actuators", "idle_damping"): "acts on a node alone, not on a simulated motion",
    ("actuators", "velocity_limit"): "does not act on a simulated motion",
    ("actuators", "acceleration_limit"): "does not act on a simulated motion",
    ("motion",): "does not act under given torques",
    ("duration",): "is given by the argument `duration`",
}
"""Numbers of a scene that no motion depends on, and why a range of them is refused."""


class Axes(NamedTuple):
    """The arrays of `Geometry` as triples of symbols or balls."""

    v: Any
    w: Any
    e: Any
    arc: Any
    beta_max: Any

    def of_leg(self, name: str, k: int) -> Any:
        """Return what an array has for leg k."""
        return getattr(self, name)[k]


class Derived(NamedTuple):
    """What a document is converted to: symbols, or what they stand for."""

    scene: Any  # as a `Scene` is once it is read
    axes: Axes


class Parts(NamedTuple):
    """What a traced function receives of a scene, in symbols."""

    model: kernel.Model
    axes: Axes
    scene: Any


class WrittenDocument(NamedTuple):
    """A scene before its conversions, unchecked, and the texts of its numbers.

    The texts are by place.
    """

    scene: Any
    texts: dict[Place, str]

    @classmethod
    def of(cls, scene: Scene) -> WrittenDocument:
        """Return the document that a scene was read from."""
        texts: dict[Place, str] = {}
        return cls(_unconvert(scene, (), texts), texts)


def _unconvert(document_node: Any, place: Place, texts: dict[Place, str]) -> Any:
    """Undo the conversions below a node; collect the texts of its numbers."""
    if isinstance(document_node, tuple):
        items = enumerate(document_node)
        return tuple(_unconvert(item, (*place, i), texts) for i, item in items)
    if not isinstance(document_node, Section):
        return document_node
    for name, written in texts_of(document_node).items():
        _collect_texts(written, (*place, name), texts)
    fields = vars(document_node) | converted_of(document_node)
    for name, value in fields.items():
        fields[name] = _unconvert(value, (*place, name), texts)
    return build_unchecked(type(document_node), fields)


def _collect_texts(written: Any, place: Place, texts: dict[Place, str]) -> None:
    """Collect the texts of numbers, or of lists of them, from a place on."""
    if isinstance(written, (list, tuple)):
        for i, number in enumerate(written):
            _collect_texts(number, (*place, i), texts)
    elif isinstance(written, (str, int)):
        texts[place] = str(written)


# Conversions of a document in symbols; only its zeros are floats.


def convert(scene: Any, degree: Any) -> Derived:
    """Convert a document in symbols as reading it does; `degree` is pi / 180."""
    values: dict[Place, Any] = {}
    for place, section in walk(scene):
        if isinstance(section, Base) and section.arcs_deg is not None:
            arcs = triple(degree * arc for arc in section.arcs_deg)
            corners: Place = (*place, "v")
            values[corners] = _triangle(*arcs)
        if isinstance(section, Link) and section.inertia_about == ABOUT_CENTRE:
            moments = shift_inertia(section.inertia, section.mass, section.centre)
            named_moments = dict(zip(Inertia.SPECS, moments, strict=True))
            inertia: Place = (*place, "inertia")
            values[inertia] = build_unchecked(Inertia, named_moments)
    converted = rebuild(scene, values)
    return Derived(converted, _axes_of(converted, degree))


def _triangle(arc_12: Any, arc_23: Any, arc_31: Any) -> tuple[Triple, Triple, Triple]:
    """Return the corners of a spherical triangle by its arcs, as `Base` has them."""
    sine = gm.sin(arc_12)
    cosine = gm.cos(arc_12)
    x = gm.cos(arc_31)
    y = (gm.cos(arc_23) - x * cosine) / sine
    z = gm.sqrt(1.0 - x * x - y * y)
    return (1.0, 0.0, 0.0), (cosine, sine, 0.0), (x, y, z)


def _length(vector: Triple) -> Any:
    return gm.sqrt(dot3(vector, vector))


def _axes_of(scene: Any, degree: Any) -> Axes:
    """Return the axes of a converted scene; see `Geometry`."""
    v = []
    for direction in scene.base.v:
        length = _length(direction)
        v.append(triple(x / length for x in direction))
    w = []
    arcs = []
    for first, second in ((0, 1), (1, 2), (2, 0)):
        normal = cross3(v[first], v[second])
        sine = _length(normal)
        w.append(triple(x / sine for x in normal))
        arcs.append(gm.atan2(sine, dot3(v[first], v[second])))
    alpha_12, alpha_23, _ = (degree * alpha for alpha in scene.star.alpha_deg)
    e = [(0.0, 1.0, 0.0)]
    for angle in (alpha_12, alpha_12 + alpha_23):
        e.append((-gm.sin(angle), gm.cos(angle), 0.0))
    beta_max = degree * scene.workspace.beta_max_deg
    return Axes(tuple(v), tuple(w), tuple(e), tuple(arcs), beta_max)


def damping_ball(restitution: Any, impact_rate: Any) -> Any:
    """Enclose the damping [s/rad] of `model.damping_of`.

    The bounds follow from the monotony of Langevin's function.
    """
    ratio = (1 - restitution) / (1 + restitution)
    x = between(_langevin_bound(ratio.lower(), -1), _langevin_bound(ratio.upper(), 1))
    return 2 * x / ((1 + restitution) * impact_rate)


def _langevin_bound(y: Any, side: int) -> Any:
    """Return a bound of the x with coth x - 1/x = y, 0 <= y < 1.

    It is below x for a side of -1, above for 1.
    """
    if not y > 0:
        return arb(0)
    # x/3 > coth x - 1/x > 1 - 1/x for x > 0.
    low = (3 * y).mid()
    high = (1 / (1 - y)).upper()
    for _ in range(PRECISION):
        middle = ((low + high) / 2).mid()
        value = middle.coth() - 1 / middle
        if value < y:
            low = middle
        elif value > y:
            high = middle
        else:
            break
    return low if side < 0 else high


# Ranges of numbers.


def range_balls(
    document: WrittenDocument,
    ranges: Mapping[str, Range],
    *,
    own_torque: bool,
    origin: str,
) -> dict[Place, Any]:
    """Return the ball of each number that is a range.

    Raises InputError where a key names no number that acts on the motion, or a range is
    none.
    """
    balls: dict[Place, Any] = {}
    for key, width in ranges.items():
        places = _places_of(key, document, origin)
        for place in places:
            _refuse_no_effect(key, place, own_torque=own_torque, origin=origin)
        for place, ball in _balls_of(key, width, places, document, origin):
            refuse_unless(
                origin, ("ranges", key, place not in balls, "names a number twice")
            )
            balls[place] = ball
    return balls


def _places_of(key: str, document: WrittenDocument, origin: str) -> list[Place]:
    """Return the places of all numbers of the field, or fields, that a key names."""
    try:
        fields = list(find_fields(document.scene, key, components=True))
    except ValueError as error:
        raise refusal(origin, "ranges", key, str(error)) from None
    places = []
    for place in leaves(document.scene):
        if any(place[: len(field)] == field for field, _, _ in fields):
            places.append(place)
    requirement = "must name numbers that the scene has"
    refuse_unless(origin, ("ranges", key, bool(places), requirement))
    return places


def _refuse_no_effect(key: str, place: Place, *, own_torque: bool, origin: str) -> None:
    for idle, reason in _NO_EFFECT.items():
        refuse_unless(origin, ("ranges", key, place[: len(idle)] != idle, reason))
    replaced = place[0] == "torque" and not own_torque
    refuse_unless(
        origin, ("ranges", key, not replaced, "is replaced by the argument `torque`")
    )


def _balls_of(
    key: str,
    width: Range,
    places: Sequence[Place],
    document: WrittenDocument,
    origin: str,
) -> Iterator[tuple[Place, Any]]:
    """Yield the ball of each number of a range, by place."""
    numbers = leaves(document.scene)
    texts = document.texts
    name = f"ranges[{key}]"
    if width == "digits":
        written = [place for place in places if place in texts]
        requirement = (
            "has no written digits: give a half-width, or the scene as a document"
        )
        refuse_unless(origin, (name, width, bool(written), requirement))
        for place in written:
            text = texts[place]
            doubt = arb(0, half_unit(text).upper())
            yield place, number_ball(numbers[place], text) + doubt
        return
    requirement = 'must be a half-width >= 0, an interval (low, high), or "digits"'
    if isinstance(width, (tuple, list)):
        is_interval = len(width) == 2 and all(map(_is_bounded, width))
        is_interval = is_interval and width[0] <= width[1]
        refuse_unless(origin, (name, width, is_interval, requirement))
        low, high = map(float, width)
        for place in places:
            number = numbers[place]
            inside = low <= number <= high
            must_hold = f"must hold the number of the scene, {number}"
            refuse_unless(origin, (name, width, inside, must_hold))
            yield place, between(arb(low), arb(high)).union(number_ball(number))
        return
    is_width = _is_bounded(width) and float(width) >= 0.0
    refuse_unless(origin, (name, width, is_width, requirement))
    for place in places:
        ball = number_ball(numbers[place], texts.get(place))
        yield place, ball + arb(0, float(width))


def _is_bounded(number: Any) -> bool:
    """Whether a number of a range is one, and far from the largest double."""
    is_number = isinstance(number, (int, float)) and not isinstance(number, bool)
    return is_number and -LARGEST_RANGE < number < LARGEST_RANGE


class NumberReading(NamedTuple):
    """A number as the program reads it and as the document writes it, as balls.

    What stands between them is middle + half r, with r from -1 (read) to 1 (written).
    """

    read: Any
    written: Any

    @classmethod
    def of(cls, number: float, text: str | None) -> NumberReading:
        """Return the double and the decimal number of a text, or its shortest one."""
        written = Fraction(text or repr(number))
        if written == Fraction(number):
            return cls(arb(number), arb(number))
        return cls(arb(number), arb(written.numerator) / arb(written.denominator))

    @property
    def differs(self) -> bool:
        """Whether there are two numbers."""
        return not (self.read - self.written).is_zero()

    @property
    def is_zero(self) -> bool:
        """Whether the number is exactly zero, read and written."""
        return bool(self.read.is_zero()) and not self.differs

    @property
    def middle(self) -> Any:
        """Return the number between both."""
        return (self.read + self.written) / 2

    @property
    def half(self) -> Any:
        """Return half of written - read; exactly 0 where these are equal."""
        return (self.written - self.read) / 2

    @property
    def ball(self) -> Any:
        """Return a ball of both."""
        return self.read.union(self.written)


class _Constants:
    """Numbers of a program that no range touches, by place: middle + half r.

    Args:
        letter: first one of the names of their symbols.
        readings: the numbers. Each is a symbol, or two where it is read as another
            number than is written.

    """

    def __init__(self, letter: str, readings: Mapping[Place, NumberReading]) -> None:
        self.balls: list[Any] = []  # that the symbols stand for
        self._has_slope: dict[Place, bool] = {}
        for place, reading in readings.items():
            self._has_slope[place] = reading.differs
            self.balls.append(reading.middle)
            if reading.differs:
                self.balls.append(reading.half)
        self.names = [f"{letter}{i}" for i in range(len(self.balls))]

    def __len__(self) -> int:
        return len(self.names)

    def expressions(self, symbols: Iterable[Any], reading: Any) -> dict[Place, Any]:
        """Return the numbers by place, in symbols of their names and of r."""
        remaining_symbols = iter(symbols)
        numbers = {}
        for place, has_slope in self._has_slope.items():
            number = next(remaining_symbols)
            if has_slope:
                number = number + next(remaining_symbols) * reading
            numbers[place] = number
        return numbers


class SceneBalls:
    """A scene in balls, and functions of it as programs.

    The numbers that are ranges, `varied`, are inputs of the programs; those of the
    start are not. One more input, READING, says how all other numbers are taken: from
    -1, as the doubles that the document is read as, to 1, as the decimal numbers that
    it has.

    Args:
        scene: what moves.
        profile: its torques; a sine replaces that of the scene.
        ranges: as `range_balls` returns.

    """

    def __init__(
        self,
        scene: Scene,
        profile: TorqueProfile | None,
        ranges: Mapping[Place, Any],
    ) -> None:
        self.scene = scene
        written, readings = _read(scene, profile)
        ranges = dict(ranges)
        if written.stroke.restitution is not None:
            _make_damping(readings, ranges)
            written = rebuild(written, dict.fromkeys(RESTITUTION))
        self._document = written
        # Numbers by place: ranges, those of the start, and all others that act.
        self._varied: dict[Place, Any] = {}
        for place, ball in ranges.items():
            if place[0] != "initial":
                self._varied[place] = ball
        self._initial: dict[Place, Any] = {}
        self._constants: dict[Place, NumberReading] = {}
        for place, reading in readings.items():
            if place[0] == "initial":
                self._initial[place] = ranges.get(place, reading)
            elif place not in ranges and not reading.is_zero:
                self._constants[place] = reading
        self._constants[DEGREE] = NumberReading(arb.pi() / 180, arb.pi() / 180)
        self._settled = self._convert_in_balls()
        numbers = [*self._constants.values(), *self._initial.values()]
        has_readings = any(
            isinstance(number, NumberReading) and number.differs for number in numbers
        )
        names = tuple(f"p{i}" for i in range(len(self._varied)))
        self.inputs = (*names, READING) if has_readings else names

    @property
    def varied_balls(self) -> list[Any]:
        """Balls of the numbers that are ranges, and of READING where it is an input."""
        balls = list(self._varied.values())
        return [*balls, arb(0, 1)] if READING in self.inputs else balls

    def initial(self, name: str) -> list[Any]:
        """Return gamma or gamma_dot at the start.

        Each is a ball of a range, or a `NumberReading`.
        """
        return [self._initial["initial", name, k] for k in range(3)]

    def _convert_in_balls(self) -> dict[Place, NumberReading | float]:
        """Convert the document in balls; return the results that no range touches.

        A result that is exactly 0, 1 or -1 is a float, which programs drop as a term or
        a factor.
        """
        places: list[Place] = []
        varied = [f"p{i}" for i in range(len(self._varied))]
        names = [*varied, *(f"c{i}" for i in range(len(self._constants)))]

        def convert_symbols(*symbols: Any) -> list[Any]:
            numbers = dict(zip([*self._varied, *self._constants], symbols, strict=True))
            expressions = []
            for place, value in walk(self._convert(numbers)):
                if isinstance(value, Expression):
                    places.append(place)
                    expressions.append(value)
            return expressions

        program = trace(convert_symbols, names)
        readings = self._constants.values()
        convert_read = enclosure.compile_on_balls(program, [x.read for x in readings])
        convert_written = enclosure.compile_on_balls(
            program, [x.written for x in readings]
        )
        ranges = list(self._varied.values())
        as_read = convert_read(*ranges)
        as_written = convert_written(*ranges)
        touched = _depend_on_first(program, len(varied))
        settled: dict[Place, NumberReading | float] = {}
        for place, read, written, is_touched in zip(
            places, as_read, as_written, touched, strict=True
        ):
            if is_touched:
                continue
            reading = NumberReading(read, written)
            settled[place] = reading
            if read in (-1, 0, 1) and not reading.differs:
                settled[place] = float(read)
        return settled

    def _convert(self, numbers: Mapping[Place, Any]) -> Derived:
        """Convert the document with numbers in symbols."""
        marked = {place: mark_present(x) for place, x in numbers.items()}
        return convert(rebuild(self._document, marked), numbers[DEGREE])

    def compile(
        self,
        function: Callable[..., Any],
        inputs: Sequence[str],
        by: Sequence[str] = (),
    ) -> enclosure.Function:
        """Compile function(parts, *inputs), whose `Parts` depend on `self.inputs`.

        The compiled function has the inputs, then `self.inputs`; with `by` it returns
        the derivatives by these inputs, too.
        """
        derived_readings: dict[Place, NumberReading] = {}
        folded: dict[Place, float] = {}
        for place, number in self._settled.items():
            if isinstance(number, NumberReading):
                derived_readings[place] = number
            else:
                folded[place] = number
        constants = _Constants("c", self._constants)
        derived = _Constants("d", derived_readings)
        sizes = {
            "inputs": len(inputs),
            "varied": len(self.inputs),
            "constants": len(constants),
            "derived": len(derived),
        }

        def traced(*symbols: Any) -> Any:
            of = divide(sizes, symbols)
            varied = dict(zip(self.inputs, of["varied"], strict=True))
            reading = varied.pop(READING, 0.0)
            numbers = constants.expressions(of["constants"], reading)
            numbers |= zip(self._varied, varied.values(), strict=True)
            converted = derived.expressions(of["derived"], reading) | folded
            marked = {place: mark_present(x) for place, x in converted.items()}
            scene, axes = rebuild(self._convert(numbers), marked)
            model = kernel.model_of(scene, axes)
            present = {}
            for place, value in walk(model):
                if isinstance(value, Expression):
                    present[place] = mark_present(value)
            return function(Parts(rebuild(model, present), axes, scene), *of["inputs"])

        names = (*inputs, *self.inputs, *constants.names, *derived.names)
        program = trace(traced, names, by)
        return enclosure.compile_on_balls(program, [*constants.balls, *derived.balls])


def _read(
    scene: Scene, profile: TorqueProfile | None
) -> tuple[Any, dict[Place, NumberReading]]:
    """Return the document of a scene, and its numbers by place.

    A sine replaces the torque of the scene.
    """
    document, texts = WrittenDocument.of(scene)
    replaced = isinstance(profile, SineTorque) and profile != scene.torque
    if replaced:
        document = rebuild(document, {("torque",): profile})
    readings: dict[Place, NumberReading] = {}
    for place, number in leaves(document).items():
        text = texts.get(place)
        if replaced and place[0] == "torque":
            text = None
        readings[place] = NumberReading.of(number, text)
    return document, readings


def _make_damping(
    readings: dict[Place, NumberReading], ranges: dict[Place, Any]
) -> None:
    """Put the damping of elastic stops in place of restitution and impact rate.

    It is among the ranges if one of these is.
    """
    impact = [readings.pop(place) for place in RESTITUTION]
    if any(place in ranges for place in RESTITUTION):
        balls = []
        for place, reading in zip(RESTITUTION, impact, strict=True):
            balls.append(ranges.pop(place, reading.ball))
        ranges[DAMPING] = damping_ball(*balls)
        return
    as_read = damping_ball(*(reading.read for reading in impact))
    as_written = damping_ball(*(reading.written for reading in impact))
    readings[DAMPING] = NumberReading(as_read, as_written)


def _depend_on_first(program: Program, count: int) -> list[bool]:
    """Return whether each output of a program depends on one of its first inputs."""
    depends = [number < count for number in range(len(program.inputs))]
    for _, operands in program.steps:
        depends.append(any(depends[x] for x in operands if isinstance(x, int)))
    return [isinstance(x, int) and depends[x] for x in program.outputs]
