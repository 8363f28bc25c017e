# SPDX-License-Identifier: Apache-2.0
"""The equations of a scene as a Python module on numbers of another library.

The module needs that library alone. Each function is straight-line code, an operation a
line, in which the functions beyond + - * / are those of the library.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from sst_ros.code_generation.named_programs import (
    INFIX,
    NamedProgram,
    SceneEquations,
    write_steps,
)

STACK = """
def _collect(values, *shape):
    whole = {library}.stack({library}.broadcast_arrays(*values))
    return whole.reshape(*shape, *whole.shape[1:])
"""
ARRAYS_NOTE = """\
An argument is an array whose first axis has the numbers below, in their order; further
axes, of many runs, follow, also in the results. {numbers}"""
DOUBLES = "Numbers are doubles."
ANY_PRECISION = """\
Functions are pure: jit, grad, vmap and scan take them.
Numbers have the precision of the arguments: for doubles call
`jax.config.update("jax_enable_x64", True)` before arrays are made."""

CASADI_TAIL = """
def _collect(values, *shape):
    whole = casadi.vertcat(*values)
    return casadi.reshape(whole, *shape[::-1]).T if shape[1:] else whole


def _function(equations, results, **sizes):
    symbols = {name: casadi.SX.sym(name, size) for name, size in sizes.items()}
    given = [*symbols.values()]
    return casadi.Function(results, given, [equations(*given)], [*symbols], [results])

"""
MPMATH = """\
Arguments are sequences of numbers; the precision is that of mpmath.mp.
The constants are the doubles of the package: more digits than theirs are
those of the equations with exactly these constants."""
MPMATH_TAIL = """
def _collect(values, rows, columns=None):
    if columns is None:
        return [*map(mpmath.mpf, values)]
    return mpmath.matrix([values[columns * i : columns * (i + 1)] for i in range(rows)])
"""
SYMPY = """\
Arguments are sequences of symbols or numbers. Of symbols the results share their
parts, which are many: derive and print one of them with `sympy.cse`."""
SYMPY_TAIL = """
def _collect(values, rows, columns=1):
    return sympy.Matrix(rows, columns, values)
"""


@dataclass(frozen=True)
class Library:
    """How a library spells what the equations need."""

    name: str
    imports: str
    about: str  # of arguments and results, for the head of the module
    collect: str  # defines _collect(values, *shape), which makes a vector or matrix
    unpack: str = "{}"  # of the numbers of an argument
    # names of functions where they differ from ours
    function_names: Mapping[str, str] = field(default_factory=dict)
    positive: str = "maximum({}, 0.0)"  # the larger of a number and zero
    step: str = "where({} > 0.0, 1.0, 0.0)"
    # lines that replace a function by what the module offers; by default itself
    wrapper: str = ""

    def expression(self, operation: str, operands: Sequence[str]) -> str:
        """Write an operation on operands."""
        if operation in INFIX:
            return f"{operands[0]} {INFIX[operation]} {operands[1]}"
        if operation == "neg":
            return f"-{operands[0]}"
        if operation in ("positive", "step"):
            pattern = self.positive if operation == "positive" else self.step
            return pattern.format(*operands)
        return f"{self.function_names.get(operation, operation)}({', '.join(operands)})"


def library_of_arrays(name: str, module: str, numbers: str) -> Library:
    """Return a library whose arrays and functions are NumPy's by name, in a module."""
    functions = "arctan2, cos, exp, maximum, sin, sqrt, tanh, where"
    return Library(
        name=name,
        imports=f"import {module}\nfrom {module} import {functions}",
        about=ARRAYS_NOTE.format(numbers=numbers),
        collect=STACK.format(library=module),
        function_names={"atan2": "arctan2"},
    )


LIBRARIES = {
    library.name: library
    for library in (
        library_of_arrays("numpy", "numpy", DOUBLES),
        library_of_arrays("jax", "jax.numpy", ANY_PRECISION),
        Library(
            name="casadi",
            imports=(
                "import casadi\n"
                "from casadi import atan2, cos, exp, fmax, if_else, sin, sqrt, tanh"
            ),
            about="Each is a `casadi.Function` of column vectors.",
            collect=CASADI_TAIL,
            unpack="casadi.vertsplit({})",
            positive="fmax({}, 0.0)",
            step="if_else({} > 0.0, 1.0, 0.0)",
            wrapper='{name} = _function({name}, "{name}", {sizes})',
        ),
        Library(
            name="mpmath",
            imports="import mpmath\n"
            "from mpmath import atan2, cos, exp, sin, sqrt, tanh",
            about=MPMATH,
            collect=MPMATH_TAIL,
            unpack="map(mpmath.mpf, {})",
            positive="max({}, 0)",
            step="(1 if {} > 0 else 0)",
        ),
        Library(
            name="sympy",
            imports="import sympy\nfrom sympy import atan2, cos, exp, sin, sqrt, tanh",
            about=SYMPY,
            collect=SYMPY_TAIL,
            unpack="map(sympy.sympify, {})",
            positive="sympy.Max({}, 0)",
            step="sympy.Heaviside({}, 0)",
        ),
    )
}


def python_module(equations: SceneEquations, library: Library) -> str:
    """Write the module."""
    head = "\n".join([*equations.header, "", library.about])
    values = dict(zip(equations.parameters, equations.values, strict=True))
    sections = [
        f'"""{head}\n"""',
        library.imports,
        f"INITIAL_STATE = {equations.initial!r}",
        f"PARAMETERS = {values!r}",
        library.collect.strip("\n"),
    ]
    for named in equations.programs:
        sections.append("\n".join(["", *_function(named, library)]))
    return "\n\n".join(sections) + "\n"


def _function(named: NamedProgram, library: Library) -> Iterator[str]:
    arguments = [argument.name for argument in named.arguments]
    yield f"def {named.name}({', '.join(arguments)}):"
    yield f'    """Return the {named.description}."""'
    for argument in named.arguments:
        symbols = ", ".join(argument.symbols)
        yield f"    {symbols}, = {library.unpack.format(argument.name)}"
    program = named.program
    lines = write_steps(program, library.expression)
    yield from (f"    {line}" for line in lines)
    results = ", ".join(map(program.operand_writer(), program.outputs))
    shape = ", ".join(map(str, named.shape))
    yield f"    return _collect(({results},), {shape})"
    if library.wrapper:
        sizes_by_name = ((argument.name, argument.size) for argument in named.arguments)
        sizes = ", ".join(f"{name}={size}" for name, size in sizes_by_name)
        yield f"\n\n{library.wrapper.format(name=named.name, sizes=sizes)}"
