# SPDX-License-Identifier: Apache-2.0
"""The same programs in C, one state or many at a time: the floor for compiled Python.

The C text is the Python text that a run or a batch compiles, line by line, with types; it is
written to a temporary folder, compiled by gcc, and forgotten. Of a right-hand side

    def rhs(t, q0, ...):
        x1 = q0 * q0
        x2 = a if x1 > b else c
        return (x1, x2,)

it makes

    static inline void rhs(double t, double q0, ..., double *restrict out) {
        double x1, x2;
        x1 = q0 * q0;
        x2 = (x1 > b) ? (a) : (c);
        out[0] = x1;
        out[1] = x2;
    }

A batch has loops over lanes of constant length without branches: `for i in range(8):` becomes
`#pragma omp simd` and `for (long i = 0; i < 8; i++) {`.
"""

from __future__ import annotations

import ast
import ctypes
import re
import shutil
import subprocess
import sys
from pathlib import Path

from sst_ros.integration.methods import Tableau
from sst_ros.integration.simd_source import batch_source
from sst_ros.integration.step_loops import explicit_step
from sst_ros.programs.expression import Program

HEAD = "#include <math.h>\n#define abs fabs\n#define max fmax\n#define nan NAN\n"

INLINE = "static inline __attribute__((always_inline))"

LOOPS = """
double slopes(long count, double *y) {{
    double k[{size}];
    for (long i = 0; i < count; i++) {{
        rhs(i * 1e-9, {state}, k);
        for (int j = 0; j < {size}; j++) y[j] += 1e-9 * k[j];
    }}
    return y[0];
}}

double march(double t, double h, long count, double *y, double *error) {{
    double r[{size}];
    for (long i = 0; i < count; i++) {{
        attempt(t + i * h, h, y, y, 0, 0, r, error);
        double s = 1.0 / sqrt(r[0]*r[0] + r[1]*r[1] + r[2]*r[2] + r[3]*r[3]);
        for (int j = 0; j < 4; j++) y[j] = r[j] * s;
        for (int j = 4; j < {size}; j++) y[j] = r[j];
    }}
    return y[0];
}}
"""


def has_gcc() -> bool:
    """Whether there is a compiler; says so where there is none."""
    found = shutil.which("gcc") is not None
    if not found:
        print("gcc is missing: NO C FLOOR. Only Python and numba are timed.", file=sys.stderr)
    return found


def read_version() -> str:
    """First line of gcc --version."""
    done = subprocess.run(["gcc", "--version"], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[0].removeprefix("gcc ")


def compile_c(text: str, folder: Path, name: str, *flags: str) -> tuple[ctypes.CDLL, str]:
    """Compile with gcc and load; also return what gcc says."""
    file, library = folder / f"{name}.c", folder / f"{name}.so"
    file.write_text(text, encoding="utf-8")
    command = ["gcc", *flags, "-shared", "-fPIC", "-o", str(library), str(file), "-lm"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return ctypes.CDLL(str(library)), done.stderr


def write_step(program: Program, tableau: Tableau) -> str:
    """C text of rhs, step and loops around them, of a program without drive."""
    size = len(program.outputs)
    state = ", ".join(f"y[{j}]" for j in range(size))
    texts = [_function(program.source("rhs")), _function(explicit_step(tableau, size, 0))]
    loops = LOOPS.format(size=size, state=state)
    return "\n".join([HEAD, *texts, loops])


def compile_step(text: str, folder: Path, name: str, *flags: str) -> ctypes.CDLL:
    """Compile the text of a step."""
    loaded, _ = compile_c(text, folder, name, *flags)
    numbers = ctypes.POINTER(ctypes.c_double)
    loaded.slopes.argtypes = [ctypes.c_long, numbers]
    loaded.march.argtypes = [ctypes.c_double, ctypes.c_double, ctypes.c_long, numbers, numbers]
    loaded.slopes.restype = loaded.march.restype = ctypes.c_double
    return loaded


def _function(text: str) -> str:
    """A flat Python function as a C function, which writes a tuple that it returns to `out`."""
    head, *body = text.splitlines()
    name, *inputs = re.findall(r"\w+", head.removeprefix("def "))
    arrays = {*inputs[2:]} if "new_y" in inputs else {"out"}
    inputs += arrays - {*inputs}
    given = ", ".join(f"double {'*restrict ' * (one in arrays)}{one}" for one in inputs)
    lines = []
    for line in body:
        if match := re.fullmatch(r"    return \((.*),\)", line):
            results = enumerate(_split(match[1]))
            lines += [f"    out[{i}] = {result};" for i, result in results]
        else:
            lines += _assignment(line.strip())
    declared = {name for line in lines for name in re.findall(r"^    (\w+) = ", line)}
    names = f"    double {', '.join(sorted(declared))};"
    return "\n".join([f"{INLINE} void {name}({given}) {{", names, *lines, "}"]) + "\n"


def _assignment(line: str) -> list[str]:
    left, right = line.split(" = ", 1)
    names = left.split(", ")
    if len(names) > 1:
        array = f"a_{names[0]}"
        return [
            f"    double {array}[{len(names)}]; {right[:-1]}, {array});",
            *(f"    {name} = {array}[{i}];" for i, name in enumerate(names)),
        ]
    if match := re.fullmatch(r"\(?(.*) if (.*) else (.*?)\)?", right):
        right = f"({match[2]}) ? ({match[1]}) : ({match[3]})"
    return [f"    {left} = {right};"]


def _split(text: str) -> list[str]:
    """Split the entries of a tuple."""
    entries = ast.parse(f"({text},)", mode="eval").body
    return [ast.unparse(entry) for entry in ast.iter_child_nodes(entries) if entry._fields]


BATCH_HEAD = """\
#include <math.h>
#define abs fabs
#define min(a, b) ((a) < (b) ? (a) : (b))
"""

SIGNATURE = """\
void batch(double h, long first, long count, long begin, long end, long columns, double *restrict y,
           double *restrict d, long *restrict code, double *restrict when, double *restrict error) {
"""

NUMBERS = ("lo", "last", "n")
"""Names that are whole numbers; all others are double."""


def write_batch(program: Program, margins: Program, tableau: Tableau, size: int) -> tuple[str, int]:
    """C text, and the number of its loops that shall be SIMD."""
    nodes = ", ".join(map(repr, tableau.c))
    lines = [BATCH_HEAD, f"static const double NODES[] = {{{nodes}}};", SIGNATURE]
    scopes: list[tuple[int, set[str]]] = [(0, set())]
    for raw in batch_source(program, margins, tableau, size).splitlines()[1:]:
        line = raw.strip()
        deep = len(raw) - len(raw.lstrip())
        while deep <= scopes[-1][0]:
            scopes.pop()
            lines.append("}")
        lines += _translate(line, scopes)
        if line.endswith(":"):
            scopes.append((deep, set()))
    lines += ["}"] * len(scopes)
    text = "\n".join(lines) + "\n"
    return text, text.count("#pragma omp simd")


def _translate(line: str, scopes: list[tuple[int, set[str]]]) -> list[str]:
    line = re.sub(r"\b([yd])\[(\d+), (.*?)\]", r"\1[\2 * columns + \3]", line)
    line = line.replace("y.shape[1]", "columns").replace("int(", "(long)(")
    if match := re.fullmatch(r"for (\w+) in range\((?:(.*), )?(.*)\):", line):
        name, start, stop = match[1], match[2] or "0", match[3]
        # Loops over lanes have a number for their length.
        simd = ["#pragma omp simd"] if name in "ix" and stop.isdigit() else []
        return [*simd, f"for (long {name} = {start}; {name} < {stop}; {name}++) {{"]
    if match := re.fullmatch(r"(el)?if (.*):", line):
        return [f"{'else ' if match[1] else ''}if ({match[2]}) {{"]
    left, right = line.split(" = ", 1)
    if match := re.fullmatch(r"vector\((\d+)\)", right):
        return [f"double {left}[{match[1]}] __attribute__((aligned(64)));"]
    if match := re.fullmatch(r"(.*) if (.*) else (.*)", right):
        condition = match[2].replace(" and ", " & ")
        right = f"({condition}) ? ({match[1]}) : ({match[3]})"
    known = any(left in names for _, names in scopes)
    if left.isidentifier() and not known:
        scopes[-1][1].add(left)
        left = f"{'long' if left in NUMBERS else 'double'} {left}"
    return [f"{left} = {right};"]


def compile_batch(text: str, folder: Path, name: str, *flags: str) -> tuple[ctypes.CDLL, int]:
    """Compile the text of a batch; also say how many loops gcc reports as vectorised."""
    simd = (*flags, "-fopenmp-simd", "-fopt-info-vec-optimized")
    loaded, said = compile_c(text, folder, name, *simd)
    numbers, arrays = (ctypes.c_long,) * 5, (ctypes.c_void_p,) * 5
    loaded.batch.argtypes = [ctypes.c_double, *numbers, *arrays]
    loaded.batch.restype = None
    return loaded, len(
        {line.split(": optimized")[0] for line in said.splitlines() if "loop" in line}
    )
