# SPDX-License-Identifier: Apache-2.0
"""The same programs in C, one state or many at a time: the floor for machine code.

A line of C is made of each operation of a program; it is written to a temporary folder,
compiled by gcc, and forgotten. Of

    x1 = q0 * q0
    x2 = (a if x1 > 0.0 else c)

it makes

    const double x1 = q0 * q0;
    const double x2 = (x1 > 0.0) ? (a) : (c);

Of many states at a time these are the lines of a loop over columns, under `#pragma omp
simd`.
"""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sst_ros.integration.methods import Tableau
from sst_ros.integration.steps import explicit_step, normalise
from sst_ros.programs.expression import Program, Routine, trace

HEAD = """\
#include <math.h>
#define abs fabs
#define max(a, b) ((b) > (a) ? (b) : (a))
"""

LOOPS = """
double slopes(long count, double *y) {{
    double k[{size}];
    for (long i = 0; i < count; i++) {{
        double x[] = {{i * 1e-9, {state}}};
        rhs(x, k);
        for (int j = 0; j < {size}; j++) y[j] += 1e-9 * k[j];
    }}
    return y[0];
}}

double march(double t, double h, long count, double *y, double *error) {{
    double r[2 * {size}];
    for (long i = 0; i < count; i++) {{
        double x[] = {{t + i * h, h, {state}}};
        attempt(x, r);
        for (int j = 0; j < {size}; j++) {{
            y[j] = r[j];
            error[j] = r[{size} + j];
        }}
    }}
    return y[0];
}}
"""

BATCH = """
void batch(long n, const double *restrict s, double **ins, double **outs) {{
    {before}
    #pragma omp simd
    for (long k = 0; k < n; k++) {{
        {inside}
    }}
}}
"""


def has_gcc() -> bool:
    """Whether there is a compiler; says so where there is none."""
    path = shutil.which("gcc") is not None
    if not path:
        print(
            "gcc is missing: NO C FLOOR. Only Python and its machine code are timed.",
            file=sys.stderr,
        )
    return path


def read_version() -> str:
    """First line of gcc --version."""
    process = subprocess.run(
        ["gcc", "--version"], capture_output=True, text=True, check=True
    )
    return process.stdout.splitlines()[0].removeprefix("gcc ")


def compile_c(
    text: str, folder: Path, name: str, *flags: str
) -> tuple[ctypes.CDLL, str]:
    """Compile with gcc and load; also return what gcc says.

    The flags are for compilation alone: linked with -ffast-math, a library makes the
    processor treat small numbers as zero in the whole process that loads it.
    """
    file = folder / f"{name}.c"
    code = folder / f"{name}.o"
    library = folder / f"{name}.so"
    file.write_text(text, encoding="utf-8")
    compile_it = ["gcc", *flags, "-fPIC", "-c", "-o", str(code), str(file)]
    process = subprocess.run(compile_it, check=True, capture_output=True, text=True)
    link = ["gcc", "-shared", "-o", str(library), str(code), "-lm"]
    subprocess.run(link, check=True, capture_output=True, text=True)
    return ctypes.CDLL(str(library)), process.stderr


def write_step(program: Program, tableau: Tableau) -> str:
    """C text of rhs, step and loops around them, of a program without drive."""
    size = len(program.outputs)
    rhs = Routine("rhs", len(program.inputs), size)

    def attempt(t: Any, h: Any, *y: Any) -> tuple[Any, ...]:
        def derivative(time: Any, at: Sequence[Any], _: Any) -> Sequence[Any]:
            return rhs(time, *at)

        new, error = explicit_step(derivative, tableau, t, h, y, [()] * len(tableau.b))
        return (*normalise(new), *(error or [0.0] * size))

    step = trace(attempt, ("t", "h", *program.inputs[1:]))
    state = ", ".join(f"y[{j}]" for j in range(size))
    texts = [_function("rhs", program), _function("attempt", step)]
    return "\n".join([HEAD, *texts, LOOPS.format(size=size, state=state)])


def compile_step(text: str, folder: Path, name: str, *flags: str) -> ctypes.CDLL:
    """Compile the text of a step."""
    loaded, _ = compile_c(text, folder, name, *flags)
    numbers = ctypes.POINTER(ctypes.c_double)
    loaded.slopes.argtypes = [ctypes.c_long, numbers]
    loaded.march.argtypes = [
        ctypes.c_double,
        ctypes.c_double,
        ctypes.c_long,
        numbers,
        numbers,
    ]
    loaded.slopes.restype = loaded.march.restype = ctypes.c_double
    return loaded


def _function(name: str, program: Program) -> str:
    """C function of a program: from an array of inputs to one of results."""
    lines, results = program.lines()
    text = [f"static void {name}(const double *restrict in_, double *restrict out_) {{"]
    text += [f"const double {one} = in_[{i}];" for i, one in enumerate(program.inputs)]
    text += [*map(_statement, lines), *_stores(results, "out_[{}]"), "}"]
    return "\n    ".join(text) + "\n"


def _statement(line: str) -> str:
    """One operation in C; a call of another program fills an array of its results."""
    name, value = line.split(" = ", 1)
    if match := re.fullmatch(r"rhs\((.*)\)", value):
        given = f"const double {name}_x[] = {{{match[1]}}}; double {name}[8];"
        return f"{given} rhs({name}_x, {name});"
    if match := re.fullmatch(r"\((.*) if (.*) else (.*)\)", value):
        value = f"({match[2]}) ? ({match[1]}) : ({match[3]})"
    return f"const double {name} = {value};"


def _stores(results: Sequence[str], place: str) -> list[str]:
    return [f"{place.format(i)} = {result};" for i, result in enumerate(results)]


def write_batch(program: Program, shared: int) -> str:
    """C text of a program over the columns of arrays.

    The first inputs are shared by all.
    """
    names = program.inputs
    before, after, results = program.split(range(shared, len(names)))
    head = [f"const double {name} = s[{i}];" for i, name in enumerate(names[:shared])]
    head += map(_statement, before)
    inside = []
    for i, name in enumerate(names[shared:]):
        head.append(f"const double *restrict in{i} = ins[{i}];")
        inside.append(f"const double {name} = in{i}[k];")
    for i in range(len(results)):
        head.append(f"double *restrict out{i} = outs[{i}];")
    inside += [*map(_statement, after), *_stores(results, "out{}[k]")]
    return HEAD + BATCH.format(
        before="\n    ".join(head), inside="\n        ".join(inside)
    )


class RowsInC:
    """A program over rows of arrays, compiled by gcc: what `RowFunction` is in LLVM's
    code.

    `vectorised` says whether gcc reports its loop as vectorised.
    """

    def __init__(
        self, program: Program, shared: int, folder: Path, name: str, *flags: str
    ) -> None:
        simd = (*flags, "-fopenmp-simd", "-fopt-info-vec-optimized")
        loaded, said = compile_c(write_batch(program, shared), folder, name, *simd)
        self.vectorised = "loop vectorized" in said
        loaded.batch.argtypes = [ctypes.c_long, *(ctypes.c_void_p,) * 3]
        loaded.batch.restype = None
        self._call, self._shared = loaded.batch, shared

    def bind(
        self, inputs: Sequence[np.ndarray], outputs: Sequence[np.ndarray]
    ) -> Callable[..., None]:
        """Return a function of the shared inputs alone, for these rows."""
        scalars = (ctypes.c_double * self._shared)()
        arrays = [
            (ctypes.c_void_p * len(rows))(*(row.ctypes.data for row in rows))
            for rows in (inputs, outputs)
        ]

        def run(*shared: float) -> None:
            scalars[:] = [*shared]
            self._call(len(outputs[0]), scalars, *arrays)

        return run
