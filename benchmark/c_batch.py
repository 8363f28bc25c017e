# SPDX-License-Identifier: Apache-2.0
"""The text of a batch in C, line by line: the floor of many scenarios at once.

`integration.blocks` writes loops over lanes of constant length without branches; each becomes a
loop of C under `#pragma omp simd`.
"""

from __future__ import annotations

import ctypes
import re
import subprocess
from pathlib import Path

from sst_ros.dynamics.expression import Program
from sst_ros.integration.batch_source import batch_source
from sst_ros.integration.methods import Tableau

HEAD = """\
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


def source(program: Program, margins: Program, tableau: Tableau, size: int) -> tuple[str, int]:
    """C text, and the number of its loops that shall be SIMD."""
    nodes = ", ".join(map(repr, tableau.c))
    lines = [HEAD, f"static const double NODES[] = {{{nodes}}};", SIGNATURE]
    scopes: list[tuple[int, set[str]]] = [(0, set())]
    for raw in batch_source(program, margins, tableau, size).splitlines()[1:]:
        line = raw.strip()
        deep = len(raw) - len(raw.lstrip())
        while deep <= scopes[-1][0]:
            scopes.pop()
            lines.append("}")
        lines += _translated(line, scopes)
        if line.endswith(":"):
            scopes.append((deep, set()))
    lines += ["}"] * len(scopes)
    text = "\n".join(lines) + "\n"
    return text, text.count("#pragma omp simd")


def _translated(line: str, scopes: list[tuple[int, set[str]]]) -> list[str]:
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


def built(text: str, folder: Path, name: str, *flags: str) -> tuple[ctypes.CDLL, int]:
    """Compile with gcc and load; also say how many loops gcc reports as vectorised."""
    file, library = folder / f"{name}.c", folder / f"{name}.so"
    file.write_text(text, encoding="utf-8")
    done = subprocess.run(
        ["gcc", *flags, "-fopenmp-simd", "-fopt-info-vec-optimized", "-shared", "-fPIC",
         "-o", str(library), str(file), "-lm"],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    loaded = ctypes.CDLL(str(library))
    loaded.batch.argtypes = [
        ctypes.c_double, *(ctypes.c_long,) * 5, *(ctypes.c_void_p,) * 5,
    ]  # fmt: skip
    loaded.batch.restype = None
    lines = {line.split(": optimized")[0] for line in done.stderr.splitlines() if "loop" in line}
    return loaded, len(lines)
