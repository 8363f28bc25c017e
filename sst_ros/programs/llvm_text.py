# SPDX-License-Identifier: Apache-2.0
"""The text of straight-line programs in LLVM's language.

1. `write_text` writes programs that call each other as one module, an instruction an
   operation, in their order. No operation is contracted or reordered, so machine code
   has the bits of the same program in plain Python.
2. A number of the scene is read from a vector: scenes of one structure share the text.
3. A function takes floats, or, written for lanes, rows of arrays: as many columns at a
   time as a register has doubles, each with the operations of a single run.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from sst_ros.mechanism.generic_math import TO_WHOLE
from sst_ros.programs.expression import (
    MATH_FUNCTIONS,
    Number,
    Program,
    Routine,
    Slots,
    tanh_program,
)

_ARITHMETIC = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}
_INTRINSIC = ("sqrt", "abs")
"""Functions that LLVM computes itself, exactly as IEEE 754 asks; others are libm's."""

_TANH = "tanh_steps"
"""Name of the own hyperbolic tangent in a module."""


class ModuleText(NamedTuple):
    """A module, and the vector of numbers that its functions take."""

    text: str
    numbers: tuple[float, ...]


def write_text(
    programs: Mapping[str, Program], rows: Sequence[str], shared: int, lanes: int
) -> ModuleText:
    """Write programs as one module of LLVM.

    Args:
        programs: by the names by which they call each other.
        rows: names of those that are written for rows of arrays, with what they call
            and nothing else; by default all are written for floats.
        shared: how many of the first inputs of `rows` all columns share.
        lanes: columns at a time of what is written for rows.

    """
    slots = Slots()
    wide = {
        called
        for row in rows
        for routine in programs[row].routines
        for called in _reach(programs, routine.name)
    }
    narrow = set() if rows else set(programs)
    widths = sorted({1, lanes})
    parts = [_declare(widths)]
    if any(program.operations["tanh"] for program in programs.values()):
        parts += [_write_tanh(width) for width in widths]
    for name, program in programs.items():
        if name in narrow:
            parts.append(_write_function(name, program, slots, width=1))
        if name in wide:
            parts.append(_write_function(name, program, slots, width=lanes))
    for name in rows:
        # What only shared inputs go into is computed once, not in each lane.
        before, body = programs[name].hoist(shared)
        parts.append(_write_function(_before(name), before, slots, width=1))
        parts.append(
            _write_function(_body(name), body, slots, width=lanes, inline=True)
        )
        parts.append(_write_loop(name, len(before.outputs), body, shared, lanes))
    return ModuleText("\n".join(parts), tuple(slots.values))


def row_name(name: str, shared: int) -> str:
    """Return the name of a program's loop over columns."""
    return f"{name}_rows_{shared}"


def _before(name: str) -> str:
    return f"{name}_before"


def _body(name: str) -> str:
    return f"{name}_body"


def _reach(programs: Mapping[str, Program], name: str) -> set[str]:
    """Return the names of a program and of those that it calls, directly or not."""
    names = {name}
    for routine in programs[name].routines:
        names |= _reach(programs, routine.name)
    return names


def _type_of(width: int) -> str:
    return "double" if width == 1 else f"<{width} x double>"


def _declare(widths: Iterable[int]) -> str:
    lines = []
    for width in widths:
        kind, suffix = _type_of(width), _suffix(width)
        for name in ("sqrt", "fabs"):
            lines.append(f"declare {kind} @llvm.{name}.{suffix}({kind})")
    for name in MATH_FUNCTIONS:
        if name not in (*_INTRINSIC, "tanh"):
            arguments = "double, double" if name == "atan2" else "double"
            lines.append(f"declare double @{name}({arguments})")
    return "\n".join(lines) + "\n"


def _suffix(width: int) -> str:
    return "f64" if width == 1 else f"v{width}f64"


def _function_name(name: str, width: int) -> str:
    return f"@{name}" if width == 1 else f"@{name}_x{width}"


def _constant(value: float, width: int) -> str:
    """Return a number as LLVM writes it: its bits."""
    bits = f"0x{struct.unpack('>Q', struct.pack('>d', value))[0]:016X}"
    if width == 1:
        return bits
    return "<" + ", ".join([f"double {bits}"] * width) + ">"


def _whole_constant(value: int, width: int) -> str:
    """Return a whole number as an operand."""
    if width == 1:
        return str(value)
    return "<" + ", ".join([f"i64 {value}"] * width) + ">"


def _pointer(kind: str) -> str:
    return f"{kind}*"


def _write_function(
    name: str, program: Program, slots: Slots, width: int, *, inline: bool = False
) -> str:
    """Write a program: `void name(inputs, numbers, outputs)`, each an array.

    With `inline` it becomes part of the function that calls it.
    """
    writer = _Writer(program, slots, width)
    for number, (op, operands) in enumerate(program.steps):
        writer.write_step(f"%v{number}", op, operands)
    for number, output in enumerate(program.outputs):
        writer.store(writer.word(output), "%o", number)
    array = f"{_pointer(_type_of(width))} noalias"
    kind, end = ("internal ", " alwaysinline") if inline else ("", "")
    head = f"define {kind}void {_function_name(name, width)}"
    head += f"({array} %x, double* noalias %p, {array} %o){end} {{"
    return "\n".join([head, *writer.first_lines, *writer.lines, "  ret void", "}", ""])


def _write_tanh(width: int) -> str:
    """Write the hyperbolic tangent as a function that becomes part of its callers."""
    program = tanh_program()
    writer = _Writer(program, Slots(), width)
    for number, (op, operands) in enumerate(program.steps):
        writer.write_step(f"%v{number}", op, operands)
    kind = _type_of(width)
    head = f"define internal {kind} {_function_name(_TANH, width)}({kind} %a0)"
    end = f"  ret {kind} {writer.word(program.outputs[0])}"
    return "\n".join([f"{head} alwaysinline {{", *writer.lines, end, "}", ""])


class _Writer:
    """Lines of one function; `first_lines` are those at its begin."""

    def __init__(self, program: Program, slots: Slots, width: int) -> None:
        self._slots, self._width, self._kind = slots, width, _type_of(width)
        self._words = [f"%a{i}" for i in range(len(program.inputs))]
        self._words += [f"%v{i}" for i in range(len(program.steps))]
        self._numbers: dict[int, str] = {}
        self._calls: dict[str, str] = {}
        self._places = 0
        self.first_lines: list[str] = []
        self.lines: list[str] = []
        for number in range(len(program.inputs)):
            self.first_lines += self._load(f"%a{number}", self._kind, "%x", number)

    def word(self, operand: float | int) -> str:
        """Return how an operand is named in the text."""
        if isinstance(operand, Number):
            return self._number(self._slots.slot(operand))
        if isinstance(operand, int):
            return self._words[operand]
        return _constant(operand, self._width)

    def write_step(
        self, result: str, op: str | Routine, operands: Sequence[float | int]
    ) -> None:
        """Write one operation of a program."""
        if isinstance(op, Routine):
            self._write_call(result, op, operands)
            return
        if op == "part":
            call, place = operands
            results = self._calls[self._words[int(call)]]
            self.lines += self._load(result, self._kind, results, int(place))
            return
        kind, words = self._kind, [self.word(operand) for operand in operands]
        if op in _ARITHMETIC:
            self._put(result, f"{_ARITHMETIC[op]} {kind} {words[0]}, {words[1]}")
        elif op == "neg":
            self._put(result, f"fneg {kind} {words[0]}")
        elif op in _INTRINSIC:
            name = f"@llvm.{'fabs' if op == 'abs' else op}.{_suffix(self._width)}"
            self._put(result, f"call {kind} {name}({kind} {words[0]})")
        elif op == "tanh":
            name = _function_name(_TANH, self._width)
            self._put(result, f"call {kind} {name}({kind} {words[0]})")
        elif op == "power_of_two":
            self._write_power_of_two(result, words[0])
        elif op == "positive":
            self._choose(result, self.word(0.0), words[0], self.word(0.0), words[0])
        elif op == "step":
            one, zero = self.word(1.0), self.word(0.0)
            self._choose(result, words[0], zero, one, zero)
        elif op == "max":
            self._choose(result, words[1], words[0], words[1], words[0])
        elif op == "select":
            self._choose(result, words[0], self.word(0.0), words[1], words[2])
        else:
            self._call_libm(result, op, words)

    def store(self, word: str, array: str, place: int) -> None:
        """Write a number into a place of an array."""
        address = self._address(self.lines, array, place)
        kind = self._kind
        self.lines.append(f"  store {kind} {word}, {_pointer(kind)} {address}, align 8")

    def _put(self, result: str, text: str) -> None:
        self.lines.append(f"  {result} = {text}")

    def _choose(self, result: str, left: str, right: str, yes: str, no: str) -> None:
        """Write: yes where left > right, else no."""
        truth = "i1" if self._width == 1 else f"<{self._width} x i1>"
        condition = f"%c{result[1:]}"
        self._put(condition, f"fcmp ogt {self._kind} {left}, {right}")
        self._put(
            result,
            f"select {truth} {condition}, {self._kind} {yes}, {self._kind} {no}",
        )

    def _write_power_of_two(self, result: str, word: str) -> None:
        """Write 2^k: k is added to the exponent of 1.

        The low bits of k + TO_WHOLE are those of k as a whole number. A conversion
        would have no value where k is no number.
        """
        kind = self._kind
        whole = "i64" if self._width == 1 else f"<{self._width} x i64>"
        place, one = (_whole_constant(n, self._width) for n in (52, 1023 << 52))
        name = f"%w{result[1:]}"
        self._put(f"{name}.k", f"fadd {kind} {word}, {self.word(TO_WHOLE)}")
        self._put(f"{name}.i", f"bitcast {kind} {name}.k to {whole}")
        self._put(f"{name}.e", f"shl {whole} {name}.i, {place}")
        self._put(f"{name}.b", f"add {whole} {name}.e, {one}")
        self._put(result, f"bitcast {whole} {name}.b to {kind}")

    def _call_libm(self, result: str, name: str, words: Sequence[str]) -> None:
        """Call a function of libm lane by lane, so each lane has Python's bits."""
        if self._width == 1:
            arguments = ", ".join(f"double {word}" for word in words)
            self._put(result, f"call double @{name}({arguments})")
            return
        vector = "undef"
        for lane in range(self._width):
            numbers = []
            for k, word in enumerate(words):
                numbers.append(f"{result}.{lane}.{k}")
                self._put(
                    numbers[-1], f"extractelement {self._kind} {word}, i32 {lane}"
                )
            arguments = ", ".join(f"double {number}" for number in numbers)
            self._put(f"{result}.{lane}", f"call double @{name}({arguments})")
            last = lane == self._width - 1
            filled = result if last else f"{result}.{lane}.v"
            self._put(
                filled,
                f"insertelement {self._kind} {vector}, double {result}.{lane}, i32"
                f" {lane}",
            )
            vector = filled

    def _write_call(
        self, result: str, routine: Routine, operands: Sequence[float | int]
    ) -> None:
        """Call another program of the module; its arrays are on the stack."""
        arguments = self._new_array(f"{result}.x", routine.inputs)
        results = self._new_array(f"{result}.o", routine.outputs)
        self._calls[result] = results
        for place, operand in enumerate(operands):
            self.store(self.word(operand), arguments, place)
        name = _function_name(routine.name, self._width)
        array = _pointer(self._kind)
        self.lines.append(
            f"  call void {name}({array} {arguments}, double* %p, {array} {results})"
        )

    def _new_array(self, name: str, size: int) -> str:
        self.first_lines.append(f"  {name} = alloca {self._kind}, i32 {size}, align 32")
        return name

    def _number(self, slot: int) -> str:
        """Load a number of the scene, at the begin of the function, once."""
        if slot not in self._numbers:
            name = f"%n{slot}"
            if self._width == 1:
                self.first_lines += self._load(name, "double", "%p", slot)
            else:
                self.first_lines += self._load(f"{name}.s", "double", "%p", slot)
                self.first_lines += _splat(name, f"{name}.s", self._width)
            self._numbers[slot] = name
        return self._numbers[slot]

    def _load(self, result: str, kind: str, array: str, place: int) -> list[str]:
        lines: list[str] = []
        address = self._address(lines, array, place, kind)
        return [
            *lines,
            f"  {result} = load {kind}, {_pointer(kind)} {address}, align 8",
        ]

    def _address(
        self, lines: list[str], array: str, place: int, kind: str | None = None
    ) -> str:
        address = f"%q{self._places}"
        self._places += 1
        kind = kind or self._kind
        lines.append(_element(address, kind, array, place))
        return address


def _element(result: str, kind: str, array: str, place: int | str) -> str:
    """Line that takes the address of an element of an array."""
    return (
        f"  {result} = getelementptr inbounds {kind}, {_pointer(kind)} {array}, i64"
        f" {place}"
    )


def _splat(result: str, scalar: str, width: int) -> list[str]:
    """Lines that give all lanes one number."""
    kind = _type_of(width)
    return [
        f"  {result}.1 = insertelement {kind} undef, double {scalar}, i32 0",
        (
            f"  {result} = shufflevector {kind} {result}.1, {kind} undef, "
            f"<{width} x i32> zeroinitializer"
        ),
    ]


def _write_loop(
    name: str, early: int, program: Program, shared: int, lanes: int
) -> str:
    """Write the loop over columns: `void name_rows(n, shared, numbers, ins, outs)`.

    `ins` and `outs` are arrays of addresses of rows; n is a multiple of the lanes. The
    first `early` inputs of the program are what is computed before the loop.
    """
    kind, count = _type_of(lanes), len(program.inputs)
    array = _pointer(kind)
    lines = [
        (
            f"define void @{row_name(name, shared)}"
            "(i64 %n, double* %s, double* %p, double** %ins, double** %outs) {"
        ),
        "entry:",
        f"  %x = alloca {kind}, i32 {count}, align 32",
        f"  %o = alloca {kind}, i32 {len(program.outputs)}, align 32",
        f"  %e = alloca double, i32 {early}, align 32",
        (
            f"  call void {_function_name(_before(name), 1)}(double* %s, double* %p,"
            " double* %e)"
        ),
    ]
    for i in range(early):
        lines.append(_element(f"%e{i}.a", "double", "%e", i))
        lines.append(f"  %e{i}.s = load double, double* %e{i}.a, align 8")
        lines += _splat(f"%e{i}", f"%e{i}.s", lanes)
        lines.append(_element(f"%x{i}", kind, "%x", i))
        lines.append(f"  store {kind} %e{i}, {array} %x{i}, align 8")
    for i in range(early, count):
        lines.append(_element(f"%r{i}.a", "double*", "%ins", i - early))
        lines.append(f"  %r{i} = load double*, double** %r{i}.a, align 8")
    for i in range(len(program.outputs)):
        lines.append(_element(f"%w{i}.a", "double*", "%outs", i))
        lines.append(f"  %w{i} = load double*, double** %w{i}.a, align 8")
    lines += [
        "  br label %loop",
        "loop:",
        "  %k = phi i64 [0, %entry], [%next, %loop]",
    ]
    for i in range(early, count):
        lines.append(_element(f"%l{i}.a", "double", f"%r{i}", "%k"))
        lines.append(f"  %l{i}.v = bitcast double* %l{i}.a to {array}")
        lines.append(f"  %l{i} = load {kind}, {array} %l{i}.v, align 8")
        lines.append(_element(f"%x{i}", kind, "%x", i))
        lines.append(f"  store {kind} %l{i}, {array} %x{i}, align 8")
    call = _function_name(_body(name), lanes)
    lines.append(f"  call void {call}({array} %x, double* %p, {array} %o)")
    for i in range(len(program.outputs)):
        lines.append(_element(f"%o{i}.a", kind, "%o", i))
        lines.append(f"  %o{i} = load {kind}, {array} %o{i}.a, align 8")
        lines.append(_element(f"%t{i}", "double", f"%w{i}", "%k"))
        lines.append(f"  %t{i}.v = bitcast double* %t{i} to {array}")
        lines.append(f"  store {kind} %o{i}, {array} %t{i}.v, align 8")
    lines += [
        f"  %next = add i64 %k, {lanes}",
        "  %more = icmp slt i64 %next, %n",
        "  br i1 %more, label %loop, label %end",
        "end:",
        "  ret void",
        "}",
        "",
    ]
    return "\n".join(lines)
