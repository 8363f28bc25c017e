# SPDX-License-Identifier: Apache-2.0
"""The equations of a scene as C99: a file and its header, with nothing but libm.

The functions do the operations of the package in its order, so they give its bits where
the functions of libm do; tanh is written out. A compiler must neither fuse a
multiplication and an addition nor reorder them: the source switches the former off for
GCC, Clang and all others that know the pragma of C99; the latter happens only with
-ffast-math, which must not be given.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from sst_ros.code_generation.named_programs import (
    INFIX,
    Argument,
    NamedProgram,
    SceneEquations,
    write_steps,
)
from sst_ros.programs.expression import Program, references, tanh_program

PATTERNS = {
    "neg": "-{}",
    "positive": "0.0 > {0} ? 0.0 : {0}",
    "step": "{} > 0.0 ? 1.0 : 0.0",
    "atan2": "atan2({}, {})",
    "abs": "fabs({})",
    "select": "{} > 0.0 ? {} : {}",
    "tanh": "tanh_steps({})",
    "power_of_two": "ldexp(1.0, {0} == {0} ? (int){0} : 0)",
}
NO_FUSION = """\
/* A fused multiplication and addition rounds once where the package rounds twice. */
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("fp-contract=off")
#else
#pragma STDC FP_CONTRACT OFF
#endif
"""


def identifier(equations: SceneEquations) -> str:
    """Return the name of the scene as an identifier of C and a name of files."""
    name = re.sub(r"\W", "_", equations.scene.name, flags=re.A)
    return re.sub(r"^(?=\d)", "scene_", name)


def c_files(equations: SceneEquations) -> dict[str, str]:
    """Write the source and its header, by name."""
    name = identifier(equations)
    return {f"{name}.h": c_header(equations), f"{name}.c": c_source(equations)}


def c_header(equations: SceneEquations) -> str:
    """Write the header."""
    name = identifier(equations)
    guard = name.upper()
    lines = [
        *_comment([*equations.header, "", "Results may be where the arguments are."]),
        f"#ifndef {guard}_H",
        f"#define {guard}_H",
        "",
        f'#define {guard}_SCENE_SHA256 "{equations.scene_hash}"',
    ]
    for argument in (equations.state, *equations.acting, *equations.open):
        lines.append(f"#define {guard}_{argument.name.upper()}_SIZE {argument.size}")
    lines += ["", "#ifdef __cplusplus", 'extern "C" {', "#endif"]
    lines += ["", f"extern const double {name}_initial_state[{equations.state.size}];"]
    for argument in equations.open:
        lines.append(f"extern const double {name}_scene_parameters[{argument.size}];")
    for named in equations.programs:
        lines += ["", *_comment([f"The {named.description}.", *_shape_note(named)])]
        lines.append(f"{_signature(name, named)};")
    lines += ["", "#ifdef __cplusplus", "}", "#endif"]
    lines += ["", f"#endif /* {guard}_H */", ""]
    return "\n".join(lines)


def c_source(equations: SceneEquations) -> str:
    """Write the source."""
    name = identifier(equations)
    lines = [*_comment(equations.header), f'#include "{name}.h"', "#include <math.h>"]
    lines += ["", NO_FUSION]
    lines += _constant(f"{name}_initial_state", equations.initial)
    if equations.parameters:
        lines += _constant(f"{name}_scene_parameters", equations.values)
    if any(named.program.operations["tanh"] for named in equations.programs):
        lines += ["", *_tanh_function()]
    for named in equations.programs:
        lines += ["", f"{_signature(name, named)}", "{", *_body(named), "}"]
    return "\n".join([*lines, ""])


def _comment(lines: list[str]) -> Iterator[str]:
    yield "/*"
    yield from (f" * {line}".rstrip().replace("*/", "* /") for line in lines)
    yield " */"


def _shape_note(named: NamedProgram) -> list[str]:
    if len(named.shape) == 1:
        return []
    columns = named.shape[1]
    return [f"Entry (i, j) is result[{columns} * i + j]."]


def _constant(name: str, values: tuple[float, ...]) -> Iterator[str]:
    yield f"const double {name}[{len(values)}] = {{"
    yield from (f"    {value!r}," for value in values)
    yield "};"


def _signature(name: str, named: NamedProgram) -> str:
    parameters = [
        f"const double {argument.name}[{argument.size}]" for argument in named.arguments
    ]
    size = len(named.program.outputs)
    arguments = ", ".join([*parameters, f"double result[{size}]"])
    return f"void {name}_{named.name}({arguments})"


def _tanh_function() -> Iterator[str]:
    """Write the hyperbolic tangent of the package; that of libm has other bits."""
    program = tanh_program()
    yield "static double tanh_steps(double x)"
    yield "{"
    yield from _statements(program)
    (result,) = map(program.operand_writer(), program.outputs)
    yield f"    return {result};"
    yield "}"


def _body(named: NamedProgram) -> Iterator[str]:
    """Write the statements: read arguments, compute, store results."""
    program = named.program
    used = set(references(program.outputs))
    for _, operands in program.steps:
        used.update(references(operands))
    first = 0
    for argument in named.arguments:
        indices = [i for i in range(argument.size) if first + i in used]
        yield from _reads(argument, indices)
        first += argument.size
    yield from _statements(program)
    write = program.operand_writer()
    for i, output in enumerate(program.outputs):
        yield f"    result[{i}] = {write(output)};"


def _statements(program: Program) -> Iterator[str]:
    yield from (
        f"    const double {line};" for line in write_steps(program, _expression)
    )


def _reads(argument: Argument, used: list[int]) -> Iterator[str]:
    if not used:
        yield f"    (void){argument.name};"
    for i in used:
        yield f"    const double {argument.symbols[i]} = {argument.name}[{i}];"


def _expression(operation: str, operands: list[str]) -> str:
    if operation in INFIX:
        return f"{operands[0]} {INFIX[operation]} {operands[1]}"
    return PATTERNS.get(operation, f"{operation}({{}})").format(*operands)
