# SPDX-License-Identifier: Apache-2.0
"""Own loads as the dynamics run them, and Python functions written as such.

Formulas become straight-line programs. That of a potential also has its exact
derivatives, which are the torques: by an angle at that joint, by the rotation on the
star. With G_i = dU/dR_i for the rows R_i of R, a turn d of the star in {E} changes them
by R_i x d, so the moment in {E} is -sum_i G_i x R_i.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from sst_ros.errors import check_kinds, refusal, refuse_unless
from sst_ros.mechanism import generic_math
from sst_ros.mechanism.generic_math import Scalar
from sst_ros.programs.expression import (
    Expression,
    Program,
    constant_text,
    references,
    trace,
)
from sst_ros.scene.own_loads import (
    BODY_RATE,
    OMEGA,
    POSE_NAMES,
    ROTATION,
    STATE_NAMES,
    FormulaLoad,
    LoadParameter,
    names_in,
    parse,
    power_of,
)


@dataclass(frozen=True)
class LoadFormula:
    """What an own load says, without the values of its parameters."""

    name: str
    parameters: tuple[str, ...]
    terms: tuple[tuple[str, str], ...]
    potential: str | None
    moment: tuple[str, ...]
    in_star: bool  #: whether the moment has the axes of {E}

    @property
    def outputs(self) -> tuple[str, ...]:
        """Return the formula of the energy, or those of the moment."""
        return self.moment if self.potential is None else (self.potential,)


class LoadConstants(NamedTuple):
    """An own load with the values of its parameters, numbers of any kind."""

    formula: LoadFormula
    parameters: tuple[Scalar, ...]


def load_constants(load: FormulaLoad) -> LoadConstants:
    """Collect what the dynamics need of an own load."""
    formula = LoadFormula(
        name=load.name,
        parameters=tuple(parameter.name for parameter in load.parameters),
        terms=tuple(dict(load.terms).items()),
        potential=load.potential,
        moment=tuple(load.moment),
        in_star=load.frame == "star",
    )
    values = tuple(parameter.value for parameter in load.parameters)
    return LoadConstants(formula, values)


class LoadProgram(NamedTuple):
    """The program of an own load: inputs are state quantities, then parameters.

    Its outputs are the energy and the derivatives by each quantity, or the three
    moments.
    """

    quantities: tuple[str, ...]
    program: Program


@lru_cache(maxsize=256)
def load_program(formula: LoadFormula) -> LoadProgram:
    """Trace the formulas of an own load.

    InputError where constants in it have no value.
    """
    texts = [*dict(formula.terms).values(), *formula.outputs]
    used = names_in(texts)
    quantities = tuple(name for name in STATE_NAMES if name in used)
    inputs = (*quantities, *formula.parameters)

    def run(*values: Any) -> list[Any]:
        variables = dict(zip(inputs, values, strict=True)) | {"pi": math.pi}
        for name, text in formula.terms:
            variables[name] = _evaluate(parse(text), variables)
        return [_evaluate(parse(text), variables) for text in formula.outputs]

    by = () if formula.potential is None else quantities
    try:
        return LoadProgram(quantities, trace(run, inputs, by))
    except (ArithmeticError, ValueError) as error:
        requirement = f"must have a value: {error}"
        raise refusal("own_loads", formula.name, texts, requirement) from None


def _evaluate(node: ast.expr, variables: Mapping[str, Any]) -> Any:
    """Compute a part of a formula, which has been checked, on numbers of any kind."""
    if isinstance(node, ast.Constant):
        return float(node.value)  # type: ignore[arg-type]
    if isinstance(node, ast.Name):
        return variables[node.id]
    if isinstance(node, ast.UnaryOp):
        value = _evaluate(node.operand, variables)
        return -value if isinstance(node.op, ast.USub) else value
    if isinstance(node, ast.Call):
        assert isinstance(node.func, ast.Name)
        arguments = [_evaluate(argument, variables) for argument in node.args]
        return _CALL_FUNCTIONS[node.func.id](*arguments)
    assert isinstance(node, ast.BinOp)
    left = _evaluate(node.left, variables)
    if isinstance(node.op, ast.Pow):
        power = power_of(node)
        assert power is not None  # the formula has been checked
        return _raise(left, power)
    return _OPERATOR_FUNCTIONS[type(node.op)](left, _evaluate(node.right, variables))


def _raise(base: Any, power: int) -> Any:
    """Return a whole power, not zero, as products."""
    result = base
    for _ in range(abs(power) - 1):
        result = result * base
    return result if power > 0 else 1.0 / result


def _absolute(x: Any) -> Any:
    return generic_math.positive(x) + generic_math.positive(-x)


def _tangent(x: Any) -> Any:
    return generic_math.sin(x) / generic_math.cos(x)


def _smaller(x: Any, y: Any) -> Any:
    return x - generic_math.positive(x - y)


def _larger(x: Any, y: Any) -> Any:
    return x + generic_math.positive(y - x)


_OPERATOR_FUNCTIONS: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}
_PLAIN_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "sqrt": generic_math.sqrt,
    "exp": generic_math.exp,
    "sin": generic_math.sin,
    "cos": generic_math.cos,
    "tanh": generic_math.tanh,
    "atan2": generic_math.atan2,
    "positive": generic_math.positive,
}
"""Functions that have the same name in a formula and in a program."""
_CALL_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **_PLAIN_FUNCTIONS,
    "tan": _tangent,
    "abs": _absolute,
    "min": _smaller,
    "max": _larger,
}


def _step(x: Any) -> Any:
    """Return 1 where x > 0 and 0 elsewhere: the slope of `positive`."""
    if hasattr(x, "apply"):
        return x.apply("step")
    if isinstance(x, np.ndarray):
        return np.where(np.real(x) > 0, 1.0, 0.0)
    return float(x > 0)


_STEP_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": operator.truediv,
    "neg": operator.neg,
    "step": _step,
    **_PLAIN_FUNCTIONS,
}


def run_program(program: Program, values: Sequence[Scalar]) -> list[Scalar]:
    """Run a straight-line program on numbers of any kind, expressions included."""
    numbers = list(values)

    def number(operand: float | int) -> Scalar:
        return numbers[operand] if isinstance(operand, int) else operand

    for operation, operands in program.steps:
        assert isinstance(operation, str)  # no routine: a load has none
        numbers.append(_STEP_FUNCTIONS[operation](*map(number, operands)))
    return [number(operand) for operand in program.outputs]


# Python functions as formulas.


class Symbol:
    """A number of the state or a parameter inside the function of an own load.

    It takes part in arithmetic, in arrays of NumPy, and in NumPy's sqrt, exp, sin, cos,
    tan, tanh, arctan2 and abs. It has no value, so nothing can be decided by it.
    """

    def __init__(self, value: Any) -> None:
        self.value = value

    def _with(self, function: Callable[[Any, Any], Any], operand: Any) -> Any:
        if isinstance(operand, np.ndarray):
            return NotImplemented
        return Symbol(function(self.value, _value_of(operand)))

    def __add__(self, operand: Any) -> Any:
        return self._with(operator.add, operand)

    __radd__ = __add__

    def __sub__(self, operand: Any) -> Any:
        return self._with(operator.sub, operand)

    def __rsub__(self, operand: Any) -> Any:
        return self._with(lambda mine, theirs: theirs - mine, operand)

    def __mul__(self, operand: Any) -> Any:
        return self._with(operator.mul, operand)

    __rmul__ = __mul__

    def __truediv__(self, operand: Any) -> Any:
        return self._with(operator.truediv, operand)

    def __rtruediv__(self, operand: Any) -> Any:
        return self._with(lambda mine, theirs: theirs / mine, operand)

    def __pow__(self, power: Any) -> Symbol:
        if power == 0.5:
            return self.sqrt()
        if power != int(power) or power == 0:
            raise TypeError("powers must be whole numbers or 0.5")
        return Symbol(_raise(self.value, int(power)))

    def __neg__(self) -> Symbol:
        return Symbol(-self.value)

    def __pos__(self) -> Symbol:
        return self

    def __abs__(self) -> Symbol:
        return Symbol(_absolute(self.value))

    def sqrt(self) -> Symbol:
        """Return the square root."""
        return Symbol(generic_math.sqrt(self.value))

    def exp(self) -> Symbol:
        """Return the exponential."""
        return Symbol(generic_math.exp(self.value))

    def sin(self) -> Symbol:
        """Return the sine."""
        return Symbol(generic_math.sin(self.value))

    def cos(self) -> Symbol:
        """Return the cosine."""
        return Symbol(generic_math.cos(self.value))

    def tan(self) -> Symbol:
        """Return the tangent."""
        return Symbol(_tangent(self.value))

    def tanh(self) -> Symbol:
        """Return the hyperbolic tangent."""
        return Symbol(generic_math.tanh(self.value))

    def arctan2(self, x: Any) -> Symbol:
        """Return the angle of the point (x, self)."""
        return Symbol(generic_math.atan2(self.value, _value_of(x)))

    def positive(self) -> Symbol:
        """Return the number where it is positive, zero elsewhere."""
        return Symbol(generic_math.positive(self.value))

    def _refuse(self, *_: Any) -> Any:
        raise TypeError(
            "it decides by a number of the state, or needs its value: use arithmetic, "
            "x.positive() and NumPy's sqrt, exp, sin, cos, tan, tanh, arctan2, abs"
        )

    __bool__ = __float__ = __lt__ = __le__ = __gt__ = __ge__ = _refuse


def _value_of(number: Any) -> Any:
    return number.value if isinstance(number, Symbol) else float(number)


@dataclass(frozen=True)
class LoadState:
    """What the function of an own load is given: arrays of symbols.

    - rotation: R of {E} in {B}, shape (3, 3); column 2 is the direction of E.
    - gamma, mu, beta: angles of the joints [rad], shape (3,).
    - omega: angular velocity of the star in {B} [rad/s], shape (3,). For a moment only,
      as are the following.
    - body_rate: the same in {E}.
    - gamma_dot, mu_dot, beta_dot: rates of the joints [rad/s], shape (3,).
    """

    rotation: Any
    gamma: Any
    mu: Any
    beta: Any
    omega: Any
    body_rate: Any
    gamma_dot: Any
    mu_dot: Any
    beta_dot: Any

    @classmethod
    def of(cls, symbols: Mapping[str, Symbol]) -> LoadState:
        """Collect symbols by name; None stands for what is not there."""

        def array(names: Sequence[str]) -> Any:
            if names[0] not in symbols:
                return None
            return np.array([symbols[name] for name in names], dtype=object)

        def of_legs(quantity: str) -> Any:
            return array([f"{quantity}_{leg}" for leg in (1, 2, 3)])

        return cls(
            rotation=array(ROTATION).reshape(3, 3),
            gamma=of_legs("gamma"),
            mu=of_legs("mu"),
            beta=of_legs("beta"),
            omega=array(OMEGA),
            body_rate=array(BODY_RATE),
            gamma_dot=of_legs("gamma_dot"),
            mu_dot=of_legs("mu_dot"),
            beta_dot=of_legs("beta_dot"),
        )


@check_kinds
def own_load(
    name: str,
    *,
    potential: Any = None,
    moment: Any = None,
    parameters: Mapping[str, float] | None = None,
    frame: str = "base",
) -> FormulaLoad:
    """Write a load of your own for `Scene.own_loads`: by potential energy or moment.

    A function is run once, on symbols, and what it does becomes formulas of the scene.
    So all that takes a scene has the load: `simulate`, `Simulation`, `Batch`, `sweep`,
    `linearize`, controllers, `certify` and the nodes.

    Args:
        name: short name.
        potential: potential energy [J]: a formula, or a function of a `LoadState` and
            of the parameters by name.
        moment: moment on the star [N m]: three formulas, or a function of the same that
            returns three numbers.
        parameters: numbers by name, in SI units. They are numbers of the scene, as in
            "own_loads[0].parameters[0].value".
        frame: axes of the moment: "base" for {B} or "star" for {E}.

    Raises:
        InputError: a function decides by a number of the state or does more than
            formulas can, or a text is no formula.

    """
    parameter_values = dict(parameters or {})
    exactly_one = (potential is None) != (moment is None)
    refuse_unless(
        "own_load", ("potential, moment", None, exactly_one, "give one of them")
    )
    document: dict[str, Any] = {"name": name, "frame": frame}
    document["parameters"] = tuple(
        LoadParameter(name=key, value=x) for key, x in parameter_values.items()
    )
    if callable(potential):
        terms, (energy,) = _write(
            potential, parameter_values, POSE_NAMES, 1, "potential"
        )
        document["terms"] = terms
        document["potential"] = energy
    elif callable(moment):
        terms, moments = _write(moment, parameter_values, STATE_NAMES, 3, "moment")
        document["terms"] = terms
        document["moment"] = moments
    elif potential is not None:
        document["potential"] = potential
    else:
        document["moment"] = moment
    return FormulaLoad(**document)


def _write(
    function: Callable[..., Any],
    parameters: Mapping[str, float],
    names: Sequence[str],
    count: int,
    key: str,
) -> tuple[tuple[tuple[str, str], ...], tuple[str, ...]]:
    """Trace a function of a `LoadState` and write it as terms and formulas."""
    inputs = (*names, *parameters)

    def run(*values: Expression) -> list[Any]:
        symbols = dict(zip(inputs, map(Symbol, values), strict=True))
        state = LoadState.of(symbols)
        result = function(state, **{name: symbols[name] for name in parameters})
        numbers = [result] if count == 1 else list(result)
        if len(numbers) != count:
            raise TypeError(f"it must return {count} numbers, not {len(numbers)}")
        return [_value_of(number) for number in numbers]

    try:
        program = trace(run, inputs)
    except (TypeError, ValueError, AttributeError, ArithmeticError) as error:
        requirement = f"must be a function that formulas can say: {error}"
        raise refusal("own_load", key, function, requirement) from None
    return write_formulas(program)


def write_formulas(
    program: Program,
) -> tuple[tuple[tuple[str, str], ...], tuple[str, ...]]:
    """Write a program as terms and a formula for each output.

    The terms are what is used more than once.
    """
    first = len(program.inputs)  # number of the first step
    uses = [0] * (first + len(program.steps))
    for _, operands in program.steps:
        for number in references(operands):
            uses[number] += 1
    prefix = "s"
    while any(name.startswith(prefix) for name in program.inputs):
        prefix += "_"
    value_texts = list(program.inputs)
    terms: dict[str, str] = {}

    def operand_text(operand: float | int) -> str:
        if isinstance(operand, int):
            return value_texts[operand]
        return constant_text(operand)

    for index, (operation, operands) in enumerate(program.steps, start=first):
        assert isinstance(operation, str)  # no routine: a load has none
        form = _FORMS.get(operation, operation + "({})")
        text = form.format(*map(operand_text, operands))
        if uses[index] > 1 or len(text) > _LONG:
            name = f"{prefix}{len(terms) + 1}"
            terms[name] = text
            text = name
        value_texts.append(text)
    return tuple(terms.items()), tuple(map(operand_text, program.outputs))


_LONG = 200  # characters after which a formula continues in another term: readable
_FORMS = {
    "add": "({} + {})",
    "sub": "({} - {})",
    "mul": "({} * {})",
    "div": "({} / {})",
    "neg": "(-{})",
    "atan2": "atan2({}, {})",
}
