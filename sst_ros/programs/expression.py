# SPDX-License-Identifier: Apache-2.0
"""Straight-line programs out of ordinary functions: what a scene lacks vanishes.

A function is run once on expressions instead of numbers. Constants fold, products with
zero and sums with zero disappear, equal subexpressions are computed once, and what no
output needs is dropped. What is left is a list of operations: it can be counted,
differentiated, and written as the source of one flat Python function, for the
interpreter or for a compiler.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from typing import Any, TypeAlias

import numpy as np

from sst_ros.mechanism.generic_math import power_of_two, tanh_steps
from sst_ros.scene.schema import Place, leaves, rebuild

Value = Any  # an Expression, a Number or a float


def tanh_of_float(x: float) -> float:
    """Hyperbolic tangent of a float, see `generic_math.tanh_steps`."""
    result: float = _flat_tanh()(x)[0]
    return result


MATH_FUNCTIONS: dict[str, Callable[..., float]] = {
    name: getattr(math, name) for name in ("sqrt", "exp", "log", "sin", "cos", "atan2")
} | {"tanh": tanh_of_float}
_TEMPLATES = {
    "add": "{} + {}",
    "sub": "{} - {}",
    "mul": "{} * {}",
    "div": "{} / {}",
    "neg": "-{}",
    **{name: f"{name}({{}})" for name in MATH_FUNCTIONS},
    "atan2": "atan2({}, {})",
    "positive": "max({}, 0.0)",
    "step": "(1.0 if {} > 0.0 else 0.0)",
    "abs": "abs({})",
    "max": "max({}, {})",
    "select": "({1} if {0} > 0.0 else {2})",
    "power_of_two": "power_of_two({})",  # of `tanh_program` alone
}
_ON_ARRAYS = _TEMPLATES | {
    "step": "where({} > 0.0, 1.0, 0.0)",
    "select": "where({} > 0.0, {}, {})",
}
"""Choices between arrays are made element by element."""
_ON_FLOATS: dict[str, Callable[..., float]] = {
    op: eval(
        f"lambda x, y=0.0, z=0.0: {text.format('x', 'y', 'z')}", {**MATH_FUNCTIONS}
    )
    for op, text in _TEMPLATES.items()
}
"""Operations on constants: of the same text, so a constant has the program's bits."""
_SLOPE_RULES: dict[str, Callable[..., Value]] = {
    "add": lambda f, x, y, dx, dy: dx + dy,
    "sub": lambda f, x, y, dx, dy: dx - dy,
    "mul": lambda f, x, y, dx, dy: dx * y + x * dy,
    "div": lambda f, x, y, dx, dy: (dx - f * dy) / y,
    "atan2": lambda f, y, x, dy, dx: (dy * x - y * dx) / (y * y + x * x),
    "neg": lambda f, x: -1.0,
    "sqrt": lambda f, x: 0.5 / f,
    "tanh": lambda f, x: 1.0 - f * f,
    "exp": lambda f, x: f,
    "log": lambda f, x: 1.0 / x,
    "sin": lambda f, x: x.apply("cos"),
    "cos": lambda f, x: -x.apply("sin"),
    "positive": lambda f, x: x.apply("step"),
    "step": lambda f, x: 0.0,
    "abs": lambda f, x: x.apply("select", x, 1.0, -1.0),
    "max": lambda f, x, y, dx, dy: f.apply("select", y - x, dy, dx),
    "select": lambda f, c, x, y, dc, dx, dy: f.apply("select", c, dx, dy),
}
"""Slopes of f = f(x, y), whose arguments have the slopes dx and dy.

Those of f(x) are by x: `_slopes_of` multiplies them by dx.
"""


@dataclass(frozen=True)
class Routine:
    """A program that other programs call by its name.

    A call is one operation; each of its results is a "part" of it.
    """

    name: str
    inputs: int  #: how many numbers it takes
    outputs: int  #: how many it returns

    def __call__(self, *arguments: Value) -> tuple[Value, ...]:
        """Add a call to the graph of the arguments, at least one an expression."""
        if len(arguments) != self.inputs:
            raise TypeError(
                f"{self.name} takes {self.inputs} numbers, not {len(arguments)}"
            )
        graph = next(x.graph for x in arguments if isinstance(x, Expression))
        call = graph.node(self, *arguments)
        return tuple(graph.node("part", call, float(k)) for k in range(self.outputs))


Operation: TypeAlias = "str | Routine"


class Graph:
    """All expressions of one trace, each distinct one once."""

    def __init__(self) -> None:
        self.nodes: list[tuple[Operation, tuple[Value, ...]]] = []
        self._expressions: dict[tuple[Any, ...], Expression] = {}

    def node(self, op: Operation, *args: Value) -> Expression:
        """Return the expression op(args), an old one where there is one."""
        keys: list[tuple[str, Any]] = []
        for operand in args:
            # A node ("n") is never equal to a constant ("c").
            if isinstance(operand, Expression):
                keys.append(("n", operand.index))
            else:
                keys.append(("c", _origin(operand)))
        if op in ("add", "mul"):  # the same in either order
            keys.sort()
        key = (op, *keys)
        if key not in self._expressions:
            self._expressions[key] = Expression(self, len(self.nodes))
            self.nodes.append((op, args))
        return self._expressions[key]


class Expression:
    """A number without a value; arithmetic on it is added to its graph.

    One that `is_present` counts as nonzero, so that no term of it is left out: it is a
    number that scenarios differ in.
    """

    __slots__ = ("graph", "index", "is_present")
    # NumPy scalars must leave the arithmetic to us.
    __array_ufunc__ = None

    def __init__(self, graph: Graph, index: int, *, is_present: bool = False) -> None:
        self.graph = graph
        self.index = index
        self.is_present = is_present

    def __add__(self, operand: Value) -> Value:
        if _is(operand, 0.0):
            return self
        mine = _drop_minus(self)
        theirs = _drop_minus(operand)
        if theirs is not None:
            return self - theirs
        if mine is not None and isinstance(operand, Expression):
            return operand - mine
        return self.graph.node("add", self, operand)

    __radd__ = __add__

    def __sub__(self, operand: Value) -> Value:
        if operand is self:
            return 0.0
        if _is(operand, 0.0):
            return self
        theirs = _drop_minus(operand)
        if theirs is not None:
            return self + theirs
        return self.graph.node("sub", self, operand)

    def __rsub__(self, operand: Value) -> Value:
        return -self if _is(operand, 0.0) else self.graph.node("sub", operand, self)

    def __mul__(self, operand: Value) -> Value:
        if _is(operand, 0.0):
            return 0.0
        if _is(operand, 1.0) or _is(operand, -1.0):
            return self if operand > 0.0 else -self
        mine = _drop_minus(self)
        theirs = _drop_minus(operand)
        if mine is not None and theirs is not None:
            return mine * theirs
        if mine is not None:
            if isinstance(operand, Expression):
                return -(mine * operand)
            return mine * -operand
        if theirs is not None:
            return -(self * theirs)
        return self.graph.node("mul", self, operand)

    __rmul__ = __mul__

    def __truediv__(self, operand: Value) -> Value:
        if _is(operand, 1.0) or _is(operand, -1.0):
            return self * operand
        mine = _drop_minus(self)
        if mine is not None:
            return -(mine / operand)
        return self.graph.node("div", self, operand)

    def __rtruediv__(self, operand: Value) -> Value:
        return 0.0 if _is(operand, 0.0) else self.graph.node("div", operand, self)

    def __neg__(self) -> Value:
        mine = _drop_minus(self)
        return mine if mine is not None else self.graph.node("neg", self)

    def __bool__(self) -> bool:
        if not self.is_present:
            raise TypeError(
                "a traced number has no truth value: branch on constants only"
            )
        return True

    def apply(self, op: str, *args: Value) -> Value:
        """Add a function of this expression, or of `args`, to the graph."""
        return self.graph.node(op, *(args or (self,)))


def mark_present(value: Any) -> Any:
    """Return an expression that counts as not zero: no term of it is left out."""
    if not isinstance(value, Expression):
        return value
    return Expression(value.graph, value.index, is_present=True)


def _folds(
    op: str,
) -> tuple[Callable[[Number, Value], Value], Callable[[Number, Value], Value]]:
    """Return an operator of numbers and its reflected form."""

    def operator(x: Number, operand: Value) -> Value:
        return x.fold(op, x, operand)

    def reflected(x: Number, operand: Value) -> Value:
        return x.fold(op, operand, x)

    return operator, reflected


class Number(float):
    """A constant that another scene of the same structure may have another value of.

    Arithmetic folds it as any float, but it never counts as 0 or 1, and it is the same
    as another one only if both come from the same numbers by the same operations: so
    what is traced depends on no value. `origin` says where it comes from.
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
        return Number(_ON_FLOATS[op](*map(float, args)), (op, *map(_origin, args)))

    def fold(self, op: str, *args: Value) -> Value:
        """Return what an operator gives, of which one operand is this number."""
        if any(isinstance(entry, Expression) for entry in args):
            return NotImplemented
        if op == "mul" and 0.0 in args and not all(isinstance(x, Number) for x in args):
            return 0.0
        return self.apply(op, *args)

    __add__, __radd__ = _folds("add")
    __sub__, __rsub__ = _folds("sub")
    __mul__, __rmul__ = _folds("mul")
    __truediv__, __rtruediv__ = _folds("div")

    def __neg__(self) -> Value:
        return Number(-float(self), ("neg", self.origin))


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


def number_constants(value: Any, origin: Place = ()) -> Any:
    """Return a tree of constants with a Number for each that is neither 0 nor 1 nor -1.

    Its sections become objects that are not checked.
    """
    numbers: dict[Place, Number] = {}
    for place, constant in leaves(value).items():
        if abs(constant) not in (0.0, 1.0):
            numbers[place] = Number(constant, (*origin, *place))
    return rebuild(value, numbers)


def references(operands: Iterable[float | int]) -> list[int]:
    """Return the operands that are numbers of inputs or steps, not constants."""
    return [operand for operand in operands if isinstance(operand, int)]


@dataclass(frozen=True)
class Program:
    """A straight-line program."""

    inputs: tuple[str, ...]  #: names of the inputs
    #: (op, operands) in order; an operand is a float, or an int: the number of an
    #: input or, from len(inputs) on, of a step; "part" takes a call and the place of
    #: one of its results
    steps: tuple[tuple[Operation, tuple[float | int, ...]], ...]
    outputs: tuple[float | int, ...]  #: operands that are the results

    @property
    def operations(self) -> Counter[str]:
        """How often each operation is done, that of routines not counted."""
        return Counter(
            op for op, _ in self.steps if isinstance(op, str) and op != "part"
        )

    @property
    def routines(self) -> tuple[Routine, ...]:
        """The routines that are called, each once."""
        return tuple(
            dict.fromkeys(op for op, _ in self.steps if isinstance(op, Routine))
        )

    def prune(self, outputs: Sequence[float | int]) -> Program:
        """Return the program of some outputs alone, without steps they do not need."""
        inputs = len(self.inputs)
        needed = set(references(outputs))
        # Operands are earlier than their step: one pass from the last step finds all.
        for number in reversed(range(inputs, inputs + len(self.steps))):
            if number in needed:
                _, operands = self.steps[number - inputs]
                needed.update(references(operands))
        step_numbers = sorted(number for number in needed if number >= inputs)
        return self._select_steps(self.inputs, range(inputs), step_numbers, outputs)

    def hoist(self, shared: int) -> tuple[Program, Program]:
        """Return what depends on the first `shared` inputs alone, and all the rest.

        The results of the first program are the first inputs of the second one, in
        place of those that are shared. Calls of routines are part of the second one.
        """
        inputs = len(self.inputs)
        is_late = [number >= shared for number in range(inputs)]
        early_steps = []
        late_steps = []
        used = set(references(self.outputs))  # by the second program
        for number, (op, operands) in enumerate(self.steps, start=inputs):
            calls = isinstance(op, Routine) or op == "part"
            if calls or any(is_late[x] for x in references(operands)):
                is_late.append(True)
                late_steps.append(number)
                used.update(references(operands))
            else:
                is_late.append(False)
                early_steps.append(number)
        shared_results = sorted(x for x in used if not is_late[x])
        names = (
            *(f"shared_{i}" for i in range(len(shared_results))),
            *self.inputs[shared:],
        )
        early_program = self._select_steps(
            self.inputs[:shared], range(shared), early_steps, shared_results
        )
        late_inputs = [*shared_results, *range(shared, inputs)]
        late_program = self._select_steps(names, late_inputs, late_steps, self.outputs)
        return early_program, late_program

    def _select_steps(
        self,
        names: tuple[str, ...],
        input_numbers: Sequence[int],
        step_numbers: Sequence[int],
        outputs: Sequence[float | int],
    ) -> Program:
        """Return the program of some steps.

        Its inputs, by `names`, are the operands `input_numbers`.
        """
        places = {old: new for new, old in enumerate([*input_numbers, *step_numbers])}

        def renumber(operands: Sequence[float | int]) -> tuple[float | int, ...]:
            return tuple(places[x] if isinstance(x, int) else x for x in operands)

        steps = (self.steps[number - len(self.inputs)] for number in step_numbers)
        renumbered = tuple((op, renumber(operands)) for op, operands in steps)
        return Program(names, renumbered, renumber(outputs))

    def source(
        self,
        name: str,
        templates: Mapping[str, str] = _TEMPLATES,
    ) -> str:
        """Source of a flat function of all inputs that returns the tuple of outputs."""
        steps, results = self.lines(templates)
        lines = [f"def {name}({', '.join(self.inputs)}):"]
        lines += [f"    {line}" for line in steps]
        lines.append(f"    return ({', '.join(results)},)\n")
        return "\n".join(lines)

    def lines(
        self, templates: Mapping[str, str] = _TEMPLATES
    ) -> tuple[list[str], list[str]]:
        """Return the lines v0 = .., v1 = .., a step each, and the outputs' texts."""
        write = self.operand_writer()
        lines = []
        for i, (op, operands) in enumerate(self.steps):
            if isinstance(op, Routine):
                text = f"{op.name}({', '.join(map(write, operands))})"
            elif op == "part":
                call, place = operands
                text = f"{write(call)}[{int(place)}]"
            else:
                text = templates[op].format(*map(write, operands))
            lines.append(f"v{i} = {text}")
        return lines, [write(output) for output in self.outputs]

    def split(self, late: Container[int]) -> tuple[list[str], list[str], list[str]]:
        """Return `lines` in two parts, then the texts of the outputs.

        The first part depends on none of the inputs whose numbers are in `late`.
        """
        lines, outputs = self.lines()
        is_late = [number in late for number in range(len(self.inputs))]
        early_lines: list[str] = []
        late_lines: list[str] = []
        for line, (_, operands) in zip(lines, self.steps, strict=True):
            is_late.append(any(is_late[x] for x in references(operands)))
            if is_late[-1]:
                late_lines.append(line)
            else:
                early_lines.append(line)
        return early_lines, late_lines, outputs

    def operand_writer(self) -> Callable[[float | int], str]:
        """Return a function that writes an operand, in Python and in C.

        It writes the name of an input, v0, v1, .. for a step, or a constant.
        """
        names = [*self.inputs, *(f"v{i}" for i in range(len(self.steps)))]

        def write(operand: float | int) -> str:
            if isinstance(operand, int):
                return names[operand]
            return constant_text(operand)

        return write


def constant_text(value: float) -> str:
    """Write a constant, in brackets if it is negative."""
    text = repr(float(value))
    return f"({text})" if text.startswith("-") else text


class Slots:
    """Places of programs' numbers in the vector p that their compiled code takes.

    `values` is the vector for the scene that the programs were traced for.
    """

    def __init__(self) -> None:
        self.values: list[float] = []
        self._slots: dict[Any, int] = {}

    def slot(self, number: Number) -> int:
        """Return the place of a number, a new one if its origin had none."""
        slot = self._slots.setdefault(number.origin, len(self.values))
        if slot == len(self.values):
            self.values.append(float(number))
        return slot


def trace(
    function: Callable[..., Sequence[Value]],
    inputs: Sequence[str],
    by: Sequence[str] = (),
) -> Program:
    """Run a function on one expression per input and return what it does.

    The outputs are those of the function, then their derivatives by each input in `by`,
    which are exact.
    """
    graph = Graph()
    names = tuple(inputs)
    outputs = tuple(function(*[graph.node("input", name) for name in names]))
    results = list(outputs)
    nodes = graph.nodes[:]  # those of the outputs: slopes add others to the graph
    for variable in by:
        results += _slopes_of(outputs, graph, nodes, {variable: 1.0})
    return _program_of(graph, names, results)


def trace_along(
    function: Callable[..., Sequence[Value]],
    inputs: Sequence[str],
    moving: Sequence[str],
) -> Program:
    """Trace a function and how its outputs change where some inputs change.

    Args:
        function: as for `trace`.
        inputs: names of its inputs.
        moving: those of them that change. The program has a further input for each,
            after all others: its rate of change.

    Returns:
        The program of the outputs and then of their rates of change, which are exact.

    """
    graph = Graph()
    expressions = [graph.node("input", name) for name in inputs]
    names = (*inputs, *(f"rate_of_{name}" for name in moving))
    rates = {
        name: graph.node("input", rate_name)
        for name, rate_name in zip(moving, names[len(inputs) :], strict=True)
    }
    outputs = tuple(function(*expressions))
    slopes = _slopes_of(outputs, graph, graph.nodes[:], rates)
    return _program_of(graph, names, [*outputs, *slopes])


def _slopes_of(
    outputs: Sequence[Value],
    graph: Graph,
    nodes: Sequence[tuple[Operation, tuple[Value, ...]]],
    slopes_of_inputs: Mapping[str, Value],
) -> list[Value]:
    """Return the slopes of outputs by forward mode, of those of the inputs by name."""
    slopes: list[Value] = []
    for index, (op, args) in enumerate(nodes):
        d: list[Value] = []  # slopes of the arguments
        for operand in args:
            is_traced = isinstance(operand, Expression)
            d.append(slopes[operand.index] if is_traced else 0.0)
        expression = Expression(graph, index)
        if isinstance(op, Routine):
            raise TypeError(
                f"the program {op.name} is called: it has no derivative here"
            )
        if op == "input":
            slopes.append(slopes_of_inputs.get(args[0], 0.0))
        elif len(args) > 1:
            slopes.append(_SLOPE_RULES[op](expression, *args, *d))
        elif _is(d[0], 0.0):
            slopes.append(0.0)
        else:
            slopes.append(_SLOPE_RULES[op](expression, *args) * d[0])
    return [
        slopes[output.index] if isinstance(output, Expression) else 0.0
        for output in outputs
    ]


def _program_of(
    graph: Graph, names: tuple[str, ...], results: Sequence[Value]
) -> Program:
    """Return the program of a graph's results, without what they do not need."""

    def operand(value: Value) -> float | int:
        if isinstance(value, Expression):
            return value.index
        return value if isinstance(value, Number) else float(value)

    steps = tuple(
        (op, tuple(map(operand, args))) for op, args in graph.nodes[len(names) :]
    )
    return Program(names, steps, ()).prune([operand(result) for result in results])


def execute(
    text: str | bytes, names: dict[str, Any], origin: str = "<program>"
) -> None:
    """Execute the text of a program with its names; a traceback calls it `origin`.

    The text is compiled first: where Ctrl-C comes in the `exec` of a text, CPython ends
    with the signal as its status, even if the KeyboardInterrupt is caught.
    """
    exec(compile(text, origin, "exec"), names)


def compile_program(
    program: Program, functions: Mapping[str, Any] | None = None
) -> Callable[..., tuple[Any, ...]]:
    """Turn a program into a Python function of its inputs, of plain floats by default.

    The function raises ArithmeticError or ValueError where a float has no value.
    """
    names: dict[str, Any] = {**(functions or MATH_FUNCTIONS)}
    execute(program.source("function"), names)
    function: Callable[..., tuple[Any, ...]] = names["function"]
    return function


@lru_cache(maxsize=1)
def tanh_program() -> Program:
    """Trace the hyperbolic tangent, as written for "tanh" in machine code and C."""
    return trace(lambda x: (tanh_steps(x),), ("x",))


@lru_cache(maxsize=1)
def _flat_tanh() -> Callable[..., tuple[Any, ...]]:
    return compile_program(tanh_program(), {"power_of_two": power_of_two})


def _tanh_of_array(x: Any) -> Any:
    """Hyperbolic tangent of an array, with the bits of `tanh_of_float`."""
    names: dict[str, Any] = {"where": np.where, "power_of_two": _powers_of_two}
    execute(tanh_program().source("function", templates=_ON_ARRAYS), names)
    (result,) = names["function"](x)
    return result


def _powers_of_two(k: Any) -> Any:
    return np.ldexp(1.0, np.nan_to_num(k).astype(np.int32))


def compile_for_arrays(
    program: Program, *, exact: bool = False
) -> Callable[..., tuple[Any, ...]]:
    """Turn a program into a function of NumPy arrays, element by element.

    NumPy's own sine and others may differ from libm's in the last bit: `exact` takes
    libm's for each element, which takes ten times as long.
    """
    names: dict[str, Any] = {"where": np.where, "max": _larger}
    for name, of_floats in MATH_FUNCTIONS.items():
        numpy_name = "arctan2" if name == "atan2" else name
        names[name] = getattr(np, numpy_name)
        if exact and name != "sqrt":  # IEEE 754 leaves a square root no choice
            names[name] = _by_element(of_floats)
    if exact:
        names["tanh"] = _tanh_of_array
    execute(program.source("function", templates=_ON_ARRAYS), names)
    function: Callable[..., tuple[Any, ...]] = names["function"]
    return function


def _larger(x: Any, y: Any) -> Any:
    """Return the larger number; x where they are equal or y is nan."""
    return np.where(y > x, y, x)


def _by_element(function: Callable[..., float]) -> Callable[..., Any]:
    """Return a function of floats as one of arrays; nan where it has no value."""

    def of_floats(*numbers: float) -> float:
        try:
            return function(*numbers)
        except (ArithmeticError, ValueError):
            return math.nan

    argument_count = 2 if function is math.atan2 else 1
    of_objects = np.frompyfunc(of_floats, argument_count, 1)
    return lambda *arrays: np.asarray(of_objects(*arrays), dtype=float)


def divide(sizes: Mapping[str, int], numbers: Iterable[Any]) -> dict[str, Any]:
    """Divide numbers into tuples by name, as inputs of a program come."""
    remaining = iter(numbers)
    return {name: tuple(islice(remaining, size)) for name, size in sizes.items()}
