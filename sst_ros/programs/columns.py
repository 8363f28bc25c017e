# SPDX-License-Identifier: Apache-2.0
"""Programs over columns of arrays: machine code where there is llvmlite, else NumPy.

The bits are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.programs import llvm
from sst_ros.programs.expression import Program, compile_for_arrays


class ArrayFunction:
    """A program over rows of arrays by NumPy: what `RowFunction` is in machine code."""

    def __init__(self, program: Program) -> None:
        self._function = compile_for_arrays(program, exact=True)

    def __call__(
        self,
        shared: Sequence[float],
        inputs: Sequence[NDArray[np.float64]],
        outputs: Sequence[NDArray[np.float64]],
    ) -> None:
        """Compute rows of outputs from inputs all columns share, and rows of others."""
        with np.errstate(all="ignore"):
            results = self._function(*shared, *inputs)
        for row, result in zip(outputs, results, strict=True):
            row[:] = result

    def bind(
        self,
        inputs: Sequence[NDArray[np.float64]],
        outputs: Sequence[NDArray[np.float64]],
    ) -> Callable[..., None]:
        """Return a function of the shared inputs alone, for these rows."""
        return lambda *shared: self(shared, inputs, outputs)


ColumnFunction = Any
"""A `RowFunction` or an `ArrayFunction`."""


def compile_columns(
    programs: Mapping[str, Program], shared: int
) -> dict[str, ColumnFunction]:
    """Compile programs for rows of arrays.

    Their first `shared` inputs all columns share.
    """
    if llvm.llvmlite_version() is None:
        return {name: ArrayFunction(program) for name, program in programs.items()}
    module = llvm.write_module(programs, rows=[*programs], shared=shared)
    return {name: llvm.RowFunction(module, name, shared) for name in programs}
