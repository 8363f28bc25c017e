# SPDX-License-Identifier: Apache-2.0
"""Machine code of straight-line programs: functions of floats, and of rows of arrays.

`llvm_text.py` writes programs as a module of LLVM. llvmlite compiles it in tenths of a
second, once for each text in a process.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import os
import re
import struct
import sys
import threading
import weakref
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sst_ros.programs.expression import Program
from sst_ros.programs.llvm_text import row_name, write_text

LANES = 8
"""Columns at a time, at most.

A number of columns that is a multiple of it fits all machines.
"""

_NARROW_LANES = 4
"""Columns at a time without AVX-512. A register then has four doubles, and with eight
lanes half of what is computed finds no place in registers."""

_OPTIMISATION = 2
"""LLVM's level; the third takes longer and gains nothing in straight-line code."""

Function = Callable[..., "list[float]"]


def llvmlite_version() -> str | None:
    """Version of llvmlite, None where it cannot be imported."""
    with _ENGINE_LOCK:
        try:
            import llvmlite
        except ImportError:
            return None
        return str(llvmlite.__version__)


class Module(NamedTuple):
    """Programs as one text of LLVM, and the vector of numbers that they take."""

    text: str
    programs: Mapping[str, Program]
    numbers: tuple[float, ...]

    def function(self, name: str) -> Function:
        """Return a program as a function of floats whose results are a list."""
        program = self.programs[name]
        code = compile_text(self.text)
        # A call takes microseconds: to hand the interpreter's lock to another thread
        # and wait for it again would take longer, up to a thousand times.
        signature = ctypes.PYFUNCTYPE(None, _BYTES, _BYTES, ctypes.c_void_p)
        call = signature(code.address(name))
        call.code = code  # type: ignore[attr-defined]  # lives as long as the function
        pack = struct.Struct(f"{len(program.inputs)}d").pack
        numbers = struct.pack(f"{len(self.numbers)}d", *self.numbers)
        new_results = ctypes.c_double * len(program.outputs)

        def evaluate(*inputs: float) -> list[float]:
            results = new_results()
            call(pack(*inputs), numbers, results)
            return results[:]

        return evaluate


_BYTES = ctypes.c_char_p


class RowFunction:
    """A program over the columns of arrays, compiled for several columns at a time.

    It releases the interpreter's lock, and allocates nothing but for the last columns.

    Args:
        module: what `write_module` has written with `shared`.
        name: of the program.
        shared: how many of its first inputs are the same for all columns.

    """

    def __init__(self, module: Module, name: str, shared: int = 0) -> None:
        program = module.programs[name]
        self.shared = shared
        self.rows = len(program.inputs) - shared
        self.outputs = len(program.outputs)
        code = compile_text(module.text)
        pointer = ctypes.c_void_p
        signature = ctypes.CFUNCTYPE(None, ctypes.c_int64, *(pointer,) * 4)
        self._call = signature(code.address(row_name(name, shared)))
        self._code = code
        # one more, so that the array is never empty and has an address
        self._numbers = np.array([*module.numbers, 0.0])
        self._numbers_address = self._numbers.ctypes.data

    def __call__(
        self,
        shared: Sequence[float],
        inputs: Sequence[NDArray[np.float64]],
        outputs: Sequence[NDArray[np.float64]],
        columns: slice = slice(None),
    ) -> None:
        """Compute rows of outputs from rows of inputs, for some columns of them.

        Args:
            shared: inputs that all columns share, shape (shared,).
            inputs: the other inputs, a contiguous array of shape (n,) each.
            outputs: where the results go, alike; an output may be the row of an input.
            columns: which are computed, a slice without a step.

        """
        self._check_rows(inputs, outputs)
        begin, end, _ = columns.indices(len(outputs[0]))
        blocks_end = begin + (end - begin) // LANES * LANES
        # one more, as in `_numbers`
        scalars = (ctypes.c_double * (len(shared) + 1))(*shared)
        if blocks_end > begin:
            ins = _addresses(inputs, begin)
            self._run(blocks_end - begin, scalars, ins, _addresses(outputs, begin))
        if blocks_end < end:  # the last columns, in rows that are as long as the lanes
            count = end - blocks_end
            last = [np.resize(row[blocks_end:end], LANES) for row in inputs]
            results = np.empty((self.outputs, LANES))
            self._run(LANES, scalars, _addresses(last, 0), _addresses([*results], 0))
            for row, result in zip(outputs, results, strict=True):
                row[blocks_end:end] = result[:count]

    def compute_table(
        self, inputs: NDArray[np.float64], outputs: NDArray[np.float64]
    ) -> None:
        """Compute a table of outputs from one of inputs, where no input is shared.

        Args:
            inputs: shape (inputs, n), contiguous; n is a multiple of `LANES`.
            outputs: where the results go, shape (outputs, n), contiguous.

        """
        self._check_rows([*inputs], [*outputs])
        count = outputs.shape[1]
        if count % LANES:
            raise ValueError(f"{count} columns: must be a multiple of {LANES}")
        if count == 0:  # the loop is made for one column at least
            return
        ins = _row_addresses(inputs)
        outs = _row_addresses(outputs)
        self._run(count, (ctypes.c_double * 1)(), ins.ctypes.data, outs.ctypes.data)

    def bind(
        self,
        inputs: Sequence[NDArray[np.float64]],
        outputs: Sequence[NDArray[np.float64]],
    ) -> Callable[..., None]:
        """Return a function of the shared inputs alone.

        It is for rows of a multiple of `LANES`. It keeps the addresses of the rows, so
        a call takes about a microsecond besides its work. It is for one thread at a
        time.
        """
        self._check_rows(inputs, outputs)
        count = len(outputs[0])
        if count % LANES:
            raise ValueError(f"{count} columns: must be a multiple of {LANES}")
        rows = inputs, outputs  # they live as long as the function
        ins = _addresses(inputs, 0)
        outs = _addresses(outputs, 0)
        scalars = (ctypes.c_double * self.shared)()
        call = self._call
        fixed = count, ctypes.addressof(scalars), self._numbers_address, ins, outs

        def run(*shared: float, _rows: Any = rows) -> None:
            scalars[:] = [*shared]
            call(*fixed)

        return run

    def _check_rows(self, inputs: Sequence[Any], outputs: Sequence[Any]) -> None:
        if len(inputs) != self.rows or len(outputs) != self.outputs:
            raise ValueError("as many rows as the program has inputs and outputs")

    def _run(self, count: int, scalars: Any, ins: Any, outs: Any) -> None:
        self._call(count, ctypes.addressof(scalars), self._numbers_address, ins, outs)


def _addresses(rows: Sequence[NDArray[np.float64]], first: int) -> Any:
    """Return the addresses of an element of each row, as an array for C."""
    addresses = [row.ctypes.data + first * row.itemsize for row in rows]
    return (ctypes.c_void_p * len(rows))(*addresses)


def _row_addresses(table: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Return the addresses of the rows of a contiguous table."""
    step, _ = table.strides
    first = table.ctypes.data
    return np.arange(first, first + len(table) * step, step, dtype=np.uint64)


def write_module(
    programs: Mapping[str, Program], *, rows: Sequence[str] = (), shared: int = 0
) -> Module:
    """Write programs as one module of LLVM.

    Args:
        programs: by the names by which they call each other.
        rows: names of those that are written for rows of arrays, with what they call
            and nothing else; by default all are written for floats.
        shared: how many of the first inputs of `rows` all columns share.

    """
    lanes = count_lanes() if rows else 1
    text, numbers = write_text(programs, rows, shared, lanes)
    return Module(text, dict(programs), numbers)


@lru_cache(maxsize=1)
def count_lanes() -> int:
    """Return how many columns this machine computes at a time."""
    with _ENGINE_LOCK:
        import llvmlite.binding as llvm

        features = llvm.get_host_cpu_features()
    return LANES if features.get("avx512f") else _NARROW_LANES


# Compilation.


_ENGINE_LOCK = threading.RLock()
"""Held in each call of LLVM. A fork waits for it, for the child would find LLVM halfway
through a module, and its locks held by a thread that it does not have."""

os.register_at_fork(
    before=_ENGINE_LOCK.acquire,
    after_in_parent=_ENGINE_LOCK.release,
    after_in_child=_ENGINE_LOCK.release,
)
# The end of the process waits for it, and keeps it: LLVM would take down its tables
# below a daemon thread that compiles, and the process would end by SIGABRT or SIGSEGV.
atexit.register(_ENGINE_LOCK.acquire)


def is_compiling() -> bool:
    """Return whether another thread of this process is inside LLVM."""
    if _ENGINE_LOCK.acquire(blocking=False):
        _ENGINE_LOCK.release()
        return False
    return True


def _close(
    engine: Any, lock: Any = _ENGINE_LOCK, ends: Callable[[], bool] = sys.is_finalizing
) -> None:
    """Free an engine, but not while the process ends: its globals have gone then."""
    if not ends():
        with lock:
            engine.close()


class MachineCode:
    """Compiled code of one module; it is freed with the last function that uses it.

    LLVM is called with `_ENGINE_LOCK` held alone, see there.
    """

    def __init__(self, engine: Any) -> None:
        self._engine = engine
        finalizer = weakref.finalize(self, _close, engine)
        finalizer.atexit = False  # the end of the process frees all

    def address(self, name: str) -> int:
        """Return the address of a function."""
        with _ENGINE_LOCK:
            return int(self._engine.get_function_address(name))


def compile_text(text: str) -> MachineCode:
    """Compile a module, unless this process has done so already."""
    with _ENGINE_LOCK:
        return _compile(text)


@lru_cache(maxsize=128)
def _compile(text: str) -> MachineCode:
    import llvmlite.binding as llvm

    if llvm.llvm_version_info[0] >= _OPAQUE_POINTERS:
        text = _TYPED_POINTER.sub("ptr", text)
    module = llvm.parse_assembly(text)
    machine = _target_machine()
    _optimise(module, machine)
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    return MachineCode(engine)


_OPAQUE_POINTERS = 15
"""Version of LLVM from which on pointers have no type."""
_TYPED_POINTER = re.compile(r"(?:double|<\d+ x double>)\*+")


def _target_machine() -> Any:
    """Return the machine that code is made for, this one; an engine takes it over."""
    import llvmlite.binding as llvm

    with contextlib.suppress(RuntimeError):  # newer versions do it by themselves
        llvm.initialize()
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=_OPTIMISATION,
    )


def _optimise(module: Any, machine: Any) -> None:
    """Run LLVM's passes; versions of llvmlite differ in how they are called."""
    import llvmlite.binding as llvm

    if hasattr(llvm, "create_pass_builder"):
        tuning = llvm.create_pipeline_tuning_options(speed_level=_OPTIMISATION)
        builder = llvm.create_pass_builder(machine, tuning)
        builder.getModulePassManager().run(module, builder)
        return
    builder = llvm.create_pass_manager_builder()
    builder.opt_level = _OPTIMISATION
    manager = llvm.create_module_pass_manager()
    builder.populate(manager)
    manager.run(module)
