# SPDX-License-Identifier: Apache-2.0
"""Straight-line programs out of ordinary functions: what a scene does not have vanishes.

A function is run once on expressions instead of numbers. Constants fold, products with zero and
sums with zero disappear, equal subexpressions are computed once, and what no output needs is
dropped. What is left is a list of operations: it can be counted, differentiated, and written as
the source of one flat Python function, for the interpreter or for a compiler.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import add, mul, sub, truediv
from typing import Any, NamedTuple

import numpy as np

from sst_ros.scene.schema import Place, leaves, rebuild

Value = Any  # an Expression, a Number or a float

_TEMPLATES = {
    "add": "{} + {}",
    "sub": "{} - {}",
    "mul": "{} * {}",
    "div": "{} / {}",
    "neg": "-{}",
    "sqrt": "sqrt({})",
    "tanh": "tanh({})",
    "exp": "exp({})",
    "sin": "sin({})",
    "cos": "cos({})",
    "atan2": "atan2({}, {})",
    "positive": "max({}, 0.0)",
    "step": "(1.0 if {} > 0.0 else 0.0)",
}
FUNCTIONS = ("sqrt", "tanh", "exp", "sin", "cos", "atan2")
_OPERATORS = {"add": add, "sub": sub, "mul": mul, "div": truediv}


class Graph:
    """All expressions of one trace, each distinct one once."""

    def __init__(self) -> None:
        self.nodes: list[tuple[str, tuple[Value, ...]]] = []
        self._known: dict[tuple[Any, ...], Expression] = {}

    def node(self, op: str, *args: Value) -> Expression:
        """Return the expression op(args), an old one where there is one."""
        keys = tuple(
            ("n", a.index) if isinstance(a, Expression) else ("c", _origin(a)) for a in args
        )
        key = (op, *(sorted(keys) if op in ("add", "mul") else keys))
        if key not in self._known:
            self._known[key] = Expression(self, len(self.nodes))
            self.nodes.append((op, args))
        return self._known[key]


class Expression:
    """A number that is not known yet; arithmetic on it is noted in its graph."""

    __slots__ = ("graph", "index")
    # NumPy scalars must leave the arithmetic to us.
    __array_ufunc__ = None

    def __init__(self, graph: Graph, index: int) -> None:
        self.graph = graph
        self.index = index

    def __add__(self, other: Value) -> Value:
        if _is(other, 0.0):
            return self
        if _drop_minus(other) is not None:
            return self - _drop_minus(other)
        if _drop_minus(self) is not None and not _is_constant(other):
            return other - _drop_minus(self)
        return self.graph.node("add", self, other)

    __radd__ = __add__

    def __sub__(self, other: Value) -> Value:
        if _is(other, 0.0):
            return self
        if other is self:
            return 0.0
        inner = _drop_minus(other)
        return self + inner if inner is not None else self.graph.node("sub", self, other)

    def __rsub__(self, other: Value) -> Value:
        return -self if _is(other, 0.0) else self.graph.node("sub", other, self)

    def __mul__(self, other: Value) -> Value:
        if _is(other, 0.0):
            return 0.0
        if _is(other, 1.0) or _is(other, -1.0):
            return self if other > 0.0 else -self
        mine, theirs = _drop_minus(self), _drop_minus(other)
        if mine is not None and theirs is not None:
            return mine * theirs
        if mine is not None:
            return -(mine * other) if not _is_constant(other) else mine * -other
        return -(self * theirs) if theirs is not None else self.graph.node("mul", self, other)

    __rmul__ = __mul__

    def __truediv__(self, other: Value) -> Value:
        if _is_constant(other) and not isinstance(other, Number):
            if abs(other) == 1.0:
                return self * other
            if math.frexp(other)[0] in (0.5, -0.5):
                return self * (1.0 / other)
        if other is self:
            return 1.0
        mine = _drop_minus(self)
        return -(mine / other) if mine is not None else self.graph.node("div", self, other)

    def __rtruediv__(self, other: Value) -> Value:
        return 0.0 if _is(other, 0.0) else self.graph.node("div", other, self)

    def __neg__(self) -> Value:
        inner = _drop_minus(self)
        return inner if inner is not None else self.graph.node("neg", self)

    def __bool__(self) -> bool:
        raise TypeError("a traced number has no truth value: branch on constants only")

    def apply(self, op: str, *args: Value) -> Value:
        """Note a function of this expression, or of `args`."""
        return self.graph.node(op, *(args or (self,)))


class VariedNumber(Expression):
    """A number that differs between scenarios: it counts as nonzero, so its term is present."""

    __slots__ = ()

    def __bool__(self) -> bool:
        return True


def mark_present(value: Any) -> Any:
    """Return an expression as one that counts as not zero, so that no term of it is left out."""
    return VariedNumber(value.graph, value.index) if isinstance(value, Expression) else value


def _folds(op: str) -> tuple[Callable[[Number, Value], Value], Callable[[Number, Value], Value]]:
    """Return an operator of numbers and its reflected form."""

    def forward(self: Number, other: Value) -> Value:
        return self._fold(op, self, other)

    def reflected(self: Number, other: Value) -> Value:
        return self._fold(op, other, self)

    return forward, reflected


class Number(float):
    """A constant that another scene of the same structure may have another value of.

    Arithmetic folds it as any float, but it never counts as 0 or 1, and it is the same as another
    one only if both come from the same numbers by the same operations: so what is traced depends on
    no value. `origin` says where it comes from.
    """

    origin: Any

    def __new__(cls, value: float, origin: Any) -> Number:
        """Make a number of a value."""
        number = super().__new__(cls, value)
        number.origin = origin
        return number

    def apply(self, op: str, *args: Value) -> Value:
        """Return a function of this number, or of `args`."""
        args = args or (self,)
        for entry in args:
            if isinstance(entry, Expression):
                return entry.apply(op, *args)
        values = tuple(map(float, args))
        if op in _OPERATORS:
            value = _OPERATORS[op](*values)
        else:
            value = max(*values, 0.0) if op == "positive" else getattr(math, op)(*values)
        return Number(value, (op, *map(_origin, args)))

    __add__, __radd__ = _folds("add")
    __sub__, __rsub__ = _folds("sub")
    __mul__, __rmul__ = _folds("mul")
    __truediv__, __rtruediv__ = _folds("div")

    def __neg__(self) -> Value:
        op, *args = self.origin if isinstance(self.origin, tuple) else ("",)
        return Number(-float(self), args[0] if op == "neg" else ("neg", self.origin))

    def _fold(self, op: str, *args: Value) -> Value:
        if any(isinstance(entry, Expression) for entry in args):
            return NotImplemented
        if op == "mul" and 0.0 in args and not all(isinstance(x, Number) for x in args):
            return 0.0
        return self.apply(op, *args)


@dataclass(frozen=True)
class Program:
    """A straight-line program.

    Attributes:
        inputs: names of the inputs.
        steps: (op, operands) in order; an operand is a float, or the number of an input or, from
            len(inputs) on, of a step.
        outputs: operands that are the results.

    """

    inputs: tuple[str, ...]
    steps: tuple[tuple[str, tuple[float | Operand, ...]], ...]
    outputs: tuple[float | Operand, ...]

    @property
    def operations(self) -> Counter[str]:
        """How often each operation is done."""
        return Counter(op for op, _ in self.steps)

    def first(self, count: int) -> Program:
        """Return the program of the first `count` outputs alone."""
        return Program(self.inputs, self.steps, self.outputs[:count]).prune()

    def prune(self) -> Program:
        """Return the program without steps that no output needs."""
        inputs, needed = len(self.inputs), set[int]()
        waiting = [out.number for out in self.outputs if isinstance(out, Operand)]
        while waiting:
            number = waiting.pop()
            if number >= inputs and number not in needed:
                needed.add(number)
                operands = self.steps[number - inputs][1]
                waiting += [x.number for x in operands if isinstance(x, Operand)]
        kept = sorted(needed)
        numbers = {old: new for new, old in enumerate([*range(inputs), *kept])}

        def renumber(operand: float | Operand) -> float | Operand:
            return Operand(numbers[operand.number]) if isinstance(operand, Operand) else operand

        steps = (self.steps[number - inputs] for number in kept)
        return Program(
            self.inputs,
            tuple((op, tuple(map(renumber, operands))) for op, operands in steps),
            tuple(map(renumber, self.outputs)),
        )

    def steps_of(self, inputs: Sequence[str]) -> list[bool]:
        """Return of each step whether it depends on one of these inputs."""
        depends = [name in inputs for name in self.inputs]
        for _, operands in self.steps:
            depends.append(any(depends[x.number] for x in operands if isinstance(x, Operand)))
        return depends[len(self.inputs) :]

    def source(self, name: str, slots: Slots | None = None) -> str:
        """Source of a flat function of all inputs that returns the tuple of outputs.

        With `slots` its last argument is the vector p, which it takes its numbers from.
        """
        lines, results = self.body(slots)
        given = self.inputs
        if slots is not None:
            given, lines = (*given, "p"), [*slots.reads([*lines, *results]), *lines]
        lines = [f"def {name}({', '.join(given)}):", *(f"    {line}" for line in lines)]
        return "\n".join([*lines, f"    return ({', '.join(results)},)\n"])

    def body(self, slots: Slots | None = None) -> tuple[list[str], list[str]]:
        """Lines v0 = .., v1 = .., one for each step, and the outputs; numbers have their slots."""
        names = [*self.inputs, *(f"v{i}" for i in range(len(self.steps)))]

        def word(operand: float | Operand) -> str:
            if isinstance(operand, Operand):
                return names[operand.number]
            if slots is not None and isinstance(operand, Number):
                return slots.name(operand)
            return repr(operand) if operand >= 0.0 else f"({operand!r})"

        lines = [
            f"v{i} = " + _TEMPLATES[op].format(*map(word, operands))
            for i, (op, operands) in enumerate(self.steps)
        ]
        return lines, [word(output) for output in self.outputs]


class Slots:
    """Where the numbers of some programs are in the vector p that their compiled code takes.

    Attributes:
        values: the vector, for the scene that the programs were traced for.

    """

    def __init__(self) -> None:
        self.values: list[float] = []
        self._slots: dict[Any, int] = {}

    def name(self, number: Number) -> str:
        """Return the name of a number, which is new if no number of its origin was there."""
        slot = self._slots.setdefault(number.origin, len(self.values))
        if slot == len(self.values):
            self.values.append(float(number))
        return f"c{slot}"

    def reads(self, lines: Sequence[str], place: str = "p[{}]") -> list[str]:
        """Lines that read what other lines name."""
        used = {int(found) for line in lines for found in re.findall(r"\bc(\d+)\b", line)}
        return [f"c{slot} = {place.format(slot)}" for slot in sorted(used)]


class Operand(NamedTuple):
    """Reference to an input or to the result of a step."""

    number: int


def trace(function: Callable[..., Sequence[Value]], inputs: Sequence[str]) -> Program:
    """Run `function` on one expression per input and return what it does."""
    return with_jacobian(function, inputs, ())


def number_constants(value: Any, origin: Place = ()) -> Any:
    """Return a tree of constants with a Number for each that is neither 0 nor 1 nor -1.

    Its sections become objects that are not checked.
    """
    numbers = {place: x for place, x in leaves(value).items() if abs(x) not in (0.0, 1.0)}
    return rebuild(value, {place: Number(x, (*origin, *place)) for place, x in numbers.items()})


def with_jacobian(
    function: Callable[..., Sequence[Value]], inputs: Sequence[str], by: Sequence[str]
) -> Program:
    """Trace `function` and its exact derivatives; outputs are f, then df/dx for each x in `by`."""
    graph = Graph()
    symbols = [graph.node("input", name) for name in inputs]
    outputs = tuple(function(*symbols))
    last = len(graph.nodes)
    everything = list(outputs)
    for name in by:
        everything += _differentiate(graph, last, outputs, {list(inputs).index(name): 1.0})
    return program_of(graph, tuple(inputs), tuple(everything))


def with_derivative_along(
    function: Callable[..., Sequence[Value]], inputs: Sequence[str], by: Sequence[str]
) -> Program:
    """Trace `function` and its exact derivative along one direction; outputs are both.

    The direction is given by further inputs, d_x for each x in `by`.
    """
    graph = Graph()
    names = (*inputs, *(f"d_{name}" for name in by))
    symbols = [graph.node("input", name) for name in names]
    outputs = tuple(function(*symbols[: len(inputs)]))
    direction = dict(zip(map(list(inputs).index, by), symbols[len(inputs) :], strict=True))
    slopes = _differentiate(graph, len(graph.nodes), outputs, direction)
    return program_of(graph, names, (*outputs, *slopes))


def program_of(graph: Graph, inputs: tuple[str, ...], outputs: Sequence[Value]) -> Program:
    """Return what a graph computes, whose first nodes are the inputs."""

    def operand(value: Value) -> float | Operand:
        if isinstance(value, Expression):
            return Operand(value.index)
        return value if isinstance(value, Number) else float(value)

    steps = tuple((op, tuple(map(operand, args))) for op, args in graph.nodes[len(inputs) :])
    return Program(inputs, steps, tuple(map(operand, outputs))).prune()


def _differentiate(
    graph: Graph, last: int, outputs: Sequence[Value], direction: Mapping[int, Value]
) -> list[Value]:
    """Differentiate outputs among the first `last` nodes along a direction (forward mode).

    It has a number or an expression for the indices of some inputs.
    """
    slopes: list[Value] = []
    for index in range(last):
        op, args = graph.nodes[index]
        here = Expression(graph, index)
        d = [slopes[a.index] if isinstance(a, Expression) else 0.0 for a in args]
        slopes.append(direction.get(index, 0.0) if op == "input" else _chain(op, args, d, here))
    return [slopes[out.index] if isinstance(out, Expression) else 0.0 for out in outputs]


def _chain(op: str, args: tuple[Value, ...], d: list[Value], here: Expression) -> Value:
    x = args[0]
    if op in ("add", "sub"):
        return d[0] + d[1] if op == "add" else d[0] - d[1]
    if op == "mul":
        return d[0] * args[1] + x * d[1]
    if op == "div":
        return (d[0] - here * d[1]) / args[1]
    if op == "atan2":
        return (d[0] * args[1] - x * d[1]) / (x * x + args[1] * args[1])
    inner: dict[str, Callable[[], Value]] = {
        "neg": lambda: -1.0,
        "sqrt": lambda: 0.5 / here,
        "tanh": lambda: 1.0 - here * here,
        "exp": lambda: here,
        "sin": lambda: x.apply("cos"),
        "cos": lambda: -x.apply("sin"),
        "positive": lambda: x.apply("step"),
        "step": lambda: 0.0,
    }
    return 0.0 if _is(d[0], 0.0) else inner[op]() * d[0]


def _is_constant(value: Value) -> bool:
    return not isinstance(value, Expression)


def _is(value: Value, number: float) -> bool:
    return not isinstance(value, (Expression, Number)) and float(value) == number


def _origin(value: float) -> Any:
    return value.origin if isinstance(value, Number) else value


def _drop_minus(value: Value) -> Value:
    """Return x where value is -x, else None."""
    if not isinstance(value, Expression):
        return None
    op, args = value.graph.nodes[value.index]
    return args[0] if op == "neg" else None


def compile_program(program: Program) -> Callable[..., tuple[float, ...]]:
    """Turn a program into a Python function of its inputs.

    The function raises ArithmeticError or ValueError where a float has no value.
    """
    return _compile(program, {name: getattr(math, name) for name in FUNCTIONS})


def compile_for_arrays(program: Program) -> Callable[..., tuple[Any, ...]]:
    """Turn a program into a function of NumPy arrays, element by element."""
    names: dict[str, Any] = {name: getattr(np, name) for name in FUNCTIONS if name != "atan2"}
    return _compile(program, names | {"atan2": np.arctan2, "max": np.maximum})


def _compile(program: Program, names: dict[str, Any]) -> Callable[..., tuple[Any, ...]]:
    exec(program.source("function"), names)
    function: Callable[..., tuple[Any, ...]] = names["function"]
    return function
