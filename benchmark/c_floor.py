# SPDX-License-Identifier: Apache-2.0
"""The same traced program and the same step in C: the floor that compiled Python is held against.

The C text is the Python text of `trace` and `steps`, line by line, with types; it is written to a
temporary folder, compiled by gcc, and forgotten.
"""

from __future__ import annotations

import ast
import ctypes
import re
import shutil
import subprocess
from pathlib import Path

from sst_ros.dynamics.expression import Program
from sst_ros.integration.codegen import explicit_step
from sst_ros.integration.methods import Tableau

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
    double r[{twice}];
    for (long i = 0; i < count; i++) {{
        step(t + i * h, h, {state}, r);
        double s = 1.0 / sqrt(r[0]*r[0] + r[1]*r[1] + r[2]*r[2] + r[3]*r[3]);
        for (int j = 0; j < 4; j++) y[j] = r[j] * s;
        for (int j = 4; j < {size}; j++) y[j] = r[j];
        for (int j = 0; j < {size}; j++) error[j] = r[{size} + j];
    }}
    return y[0];
}}
"""


def compiler() -> str | None:
    """Path of gcc, None where there is none."""
    return shutil.which("gcc")


def version() -> str:
    """First line of gcc --version."""
    done = subprocess.run(["gcc", "--version"], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[0].removeprefix("gcc ")


def source(program: Program, tableau: Tableau) -> str:
    """C text of rhs, step and loops around them, of a program without drive."""
    size = len(program.outputs)
    state = ", ".join(f"y[{j}]" for j in range(size))
    texts = [_function(program.source("rhs")), _function(explicit_step(tableau, size, 0))]
    loops = LOOPS.format(size=size, twice=2 * size, state=state)
    return "\n".join([HEAD, *texts, loops])


def built(text: str, folder: Path, name: str, *flags: str) -> ctypes.CDLL:
    """Compile with gcc and load."""
    file, library = folder / f"{name}.c", folder / f"{name}.so"
    file.write_text(text, encoding="utf-8")
    command = ["gcc", *flags, "-shared", "-fPIC", "-o", str(library), str(file), "-lm"]
    subprocess.run(command, check=True)
    loaded = ctypes.CDLL(str(library))
    numbers = ctypes.POINTER(ctypes.c_double)
    loaded.slopes.argtypes = [ctypes.c_long, numbers]
    loaded.march.argtypes = [ctypes.c_double, ctypes.c_double, ctypes.c_long, numbers, numbers]
    loaded.slopes.restype = loaded.march.restype = ctypes.c_double
    return loaded


def _function(text: str) -> str:
    """A flat Python function as a C function that writes its tuple to `out`."""
    lines = []
    for line in text.splitlines():
        if match := re.fullmatch(r"def (\w+)\((.*)\):", line):
            inputs = ", ".join(f"double {name}" for name in match[2].split(", "))
            lines.append(f"{INLINE} void {match[1]}({inputs}, double *restrict out) {{")
        elif match := re.fullmatch(r"    return \((.*),\)", line):
            results = _split(match[1])
            lines += [f"    out[{i}] = {result};" for i, result in enumerate(results)]
            lines.append("}")
        else:
            lines += _assignment(line.strip())
    declared = {name for line in lines for name in re.findall(r"^    (\w+) = ", line)}
    return "\n".join([lines[0], f"    double {', '.join(sorted(declared))};", *lines[1:]]) + "\n"


def _assignment(line: str) -> list[str]:
    left, right = line.split(" = ", 1)
    names = left.split(", ")
    if len(names) > 1:
        call = right.replace("rhs(", "rhs(", 1)[:-1]
        array = f"a_{names[0]}"
        return [
            f"    double {array}[{len(names)}]; {call}, {array});",
            *(f"    {name} = {array}[{i}];" for i, name in enumerate(names)),
        ]
    if match := re.fullmatch(r"\(?(.*) if (.*) else (.*?)\)?", right):
        right = f"({match[2]}) ? ({match[1]}) : ({match[3]})"
    return [f"    {left} = {right};"]


def _split(text: str) -> list[str]:
    """Split the entries of a tuple."""
    entries = ast.parse(f"({text},)", mode="eval").body
    return [ast.unparse(entry) for entry in ast.iter_child_nodes(entries) if entry._fields]
