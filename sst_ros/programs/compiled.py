# SPDX-License-Identifier: Apache-2.0
"""Programs as functions of floats: machine code with llvmlite, else plain Python.

Both have the same bits. Neither raises an error where a number has no value: it is nan
then.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import refusal
from sst_ros.programs.expression import MATH_FUNCTIONS, Program, compile_program
from sst_ros.programs.llvm import (
    LANES,
    Function,
    RowFunction,
    llvmlite_version,
    write_module,
)
from sst_ros.removed import REMOVED_VARIABLES

Array: TypeAlias = NDArray[np.float64]
RowsFunction: TypeAlias = Callable[[Array], Array]


def compile_functions(
    programs: Mapping[str, Program], names: Sequence[str]
) -> dict[str, Function]:
    """Turn programs that call each other into functions of floats.

    Args:
        programs: by the names by which they call each other.
        names: of those that are wanted.

    """
    _refuse_variables()
    if llvmlite_version() is not None:
        module = write_module(programs)
        return {name: module.function(name) for name in names}
    raising_functions: dict[str, Callable[..., Sequence[float]]] = {}
    functions: dict[str, Function] = {}
    for name in _in_order(programs):
        raising_functions[name] = compile_program(
            programs[name], {**MATH_FUNCTIONS, **raising_functions}
        )
        functions[name] = without_errors(
            raising_functions[name], len(programs[name].outputs)
        )
    return {name: functions[name] for name in names}


def _refuse_variables() -> None:
    """Refuse variables that set how earlier versions compiled."""
    for name, advice in REMOVED_VARIABLES.items():
        if name in os.environ:
            raise refusal("environment", name, os.environ[name], advice)


def compile_rows(programs: Mapping[str, Program], name: str) -> RowsFunction:
    """Turn a program, which may call others, into a function of rows of inputs.

    It takes an array of shape (n, inputs) and returns one of shape (n, outputs), a row
    of which has the bits of the function of floats.
    """
    if llvmlite_version() is None:
        function = compile_functions(programs, (name,))[name]
        outputs = len(programs[name].outputs)

        def evaluate(rows: Array) -> Array:
            return np.array([function(*row) for row in rows.tolist()]).reshape(
                -1, outputs
            )

        return evaluate
    columns = RowFunction(write_module(programs, rows=(name,)), name)

    def compute(rows: Array) -> Array:
        count = len(rows)
        width = -(-count // LANES) * LANES  # the next multiple
        inputs = np.empty((columns.rows, width))
        inputs[:, :count] = rows.T
        inputs[:, count:] = inputs[:, :1]  # any numbers do: their results are not read
        results = np.empty((columns.outputs, width))
        columns.compute_table(inputs, results)
        by_row: Array = results[:, :count].T
        return by_row

    return compute


def _in_order(programs: Mapping[str, Program]) -> list[str]:
    """Return the names of programs, each behind those that it calls."""
    ordered: list[str] = []

    def add(name: str) -> None:
        for routine in programs[name].routines:
            add(routine.name)
        if name not in ordered:
            ordered.append(name)

    for name in programs:
        add(name)
    return ordered


def without_errors(function: Callable[..., Sequence[float]], outputs: int) -> Function:
    """Return a function that gives nan where a computation on floats has no value."""

    def evaluate(*inputs: float) -> list[float]:
        try:
            return [*function(*inputs)]
        except (ArithmeticError, ValueError):
            return [math.nan] * outputs

    return evaluate
