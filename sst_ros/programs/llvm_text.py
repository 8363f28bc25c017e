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
    wide: set[str] = set()  # programs that rows call
    for row in rows:
        for routine in programs[row].routines:
            wide |= _reach(programs, routine.name)
    narrow = set() if rows else set(programs)
    widths = sorted({1, lanes})
    sections = [_declare(widths)]
    if any(program.operations["tanh"] for program in programs.values()):
        sections += [_write_tanh(width) for width in widths]
    for name, program in programs.items():
        if name in narrow:
            sections.append(_write_function(name, program, slots, width=1))
        if name in wide:
            sections.append(_write_function(name, program, slots, width=lanes))
    for name in rows:
        # What only shared inputs go into is computed once, not in each lane.
        before, body = programs[name].hoist(shared)
        sections.append(_write_function(_before(name), before, slots, width=1))
        sections.append(
            _write_function(_body(name), body, slots, width=lanes, inline=True)
        )
        sections.append(_write_loop(name, len(before.outputs), body, shared, lanes))
    return ModuleText("\n".join(sections), tuple(slots.values))


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


def _type_of(width: int, element: str = "double") -> str:
    """Return the type of a number, or of a vector with one in each lane."""
    if width == 1:
        return element
    return f"<{width} x {element}>"


def _declare(widths: Iterable[int]) -> str:
    lines = []
    for width in widths:
        number_type = _type_of(width)
        suffix = _suffix(width)
        for name in ("sqrt", "fabs"):
            lines.append(f"declare {number_type} @llvm.{name}.{suffix}({number_type})")
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
    """Return a number as LLVM writes it, its bits, in each lane."""
    (bits,) = struct.unpack(">Q", struct.pack(">d", value))
    return _repeat(f"0x{bits:016X}", width, "double")


def _repeat(constant: str, width: int, element: str) -> str:
    """Return a constant of a type in each lane."""
    if width == 1:
        return constant
    return "<" + ", ".join([f"{element} {constant}"] * width) + ">"


def _pointer(target_type: str) -> str:
    return f"{target_type}*"


def _write_function(
    name: str, program: Program, slots: Slots, width: int, *, inline: bool = False
) -> str:
    """Write a program: `void name(inputs, numbers, outputs)`, each an array.

    With `inline` it becomes part of the function that calls it.
    """
    writer = _Writer(program, slots, width)
    writer.write_steps()
    for number, output in enumerate(program.outputs):
        writer.store(writer.operand_text(output), "%o", number)
    array = f"{_pointer(_type_of(width))} noalias"
    linkage = ""
    attribute = ""
    if inline:
        linkage = "internal "
        attribute = " alwaysinline"
    head = f"define {linkage}void {_function_name(name, width)}"
    head += f"({array} %x, double* noalias %p, {array} %o){attribute} {{"
    return "\n".join([head, *writer.first_lines, *writer.lines, "  ret void", "}", ""])


def _write_tanh(width: int) -> str:
    """Write the hyperbolic tangent as a function that becomes part of its callers."""
    program = tanh_program()
    writer = _Writer(program, Slots(), width)
    writer.write_steps()
    number_type = _type_of(width)
    name = _function_name(_TANH, width)
    head = f"define internal {number_type} {name}({number_type} %a0)"
    last_line = f"  ret {number_type} {writer.operand_text(program.outputs[0])}"
    return "\n".join([f"{head} alwaysinline {{", *writer.lines, last_line, "}", ""])


class _Writer:
    """Lines of one function; `first_lines` are those at its beginning."""

    def __init__(self, program: Program, slots: Slots, width: int) -> None:
        self._program = program
        self._slots = slots
        self._width = width
        self._number_type = _type_of(width)
        self._operand_names = [f"%a{i}" for i in range(len(program.inputs))]
        self._operand_names += [f"%v{i}" for i in range(len(program.steps))]
        self._numbers: dict[int, str] = {}  # names of loaded numbers by slot
        self._calls: dict[str, str] = {}  # arrays of results by the name of a call
        self._places = 0  # addresses that have been taken
        self.first_lines: list[str] = []
        self.lines: list[str] = []
        for number in range(len(program.inputs)):
            self.first_lines += self._load(
                f"%a{number}", self._number_type, "%x", number
            )

    def operand_text(self, operand: float | int) -> str:
        """Return how an operand is named in the text."""
        if isinstance(operand, Number):
            return self._number(self._slots.slot(operand))
        if isinstance(operand, int):
            return self._operand_names[operand]
        return _constant(operand, self._width)

    def write_steps(self) -> None:
        """Write all operations of the program."""
        for number, (op, operands) in enumerate(self._program.steps):
            self._write_step(f"%v{number}", op, operands)

    def _write_step(
        self, result: str, op: str | Routine, operands: Sequence[float | int]
    ) -> None:
        """Write one operation of a program."""
        if isinstance(op, Routine):
            self._write_call(result, op, operands)
            return
        if op == "part":
            call, place = operands
            results = self._calls[self._operand_names[int(call)]]
            self.lines += self._load(result, self._number_type, results, int(place))
            return
        number_type = self._number_type
        texts = [self.operand_text(operand) for operand in operands]
        if op in _ARITHMETIC:
            self._put(result, f"{_ARITHMETIC[op]} {number_type} {texts[0]}, {texts[1]}")
        elif op == "neg":
            self._put(result, f"fneg {number_type} {texts[0]}")
        elif op in _INTRINSIC:
            name = f"@llvm.{'fabs' if op == 'abs' else op}.{_suffix(self._width)}"
            self._put(result, f"call {number_type} {name}({number_type} {texts[0]})")
        elif op == "tanh":
            name = _function_name(_TANH, self._width)
            self._put(result, f"call {number_type} {name}({number_type} {texts[0]})")
        elif op == "power_of_two":
            self._write_power_of_two(result, texts[0])
        elif op == "positive":
            zero = self.operand_text(0.0)
            self._choose(result, zero, texts[0], zero, texts[0])
        elif op == "step":
            zero = self.operand_text(0.0)
            self._choose(result, texts[0], zero, self.operand_text(1.0), zero)
        elif op == "max":
            self._choose(result, texts[1], texts[0], texts[1], texts[0])
        elif op == "select":
            self._choose(result, texts[0], self.operand_text(0.0), texts[1], texts[2])
        else:
            self._call_libm(result, op, texts)

    def store(self, number_text: str, array: str, place: int) -> None:
        """Write a number into a place of an array."""
        address = self._address(self.lines, array, place)
        number_type = self._number_type
        self.lines.append(
            f"  store {number_type} {number_text}, {_pointer(number_type)} {address},"
            " align 8"
        )

    def _put(self, result: str, text: str) -> None:
        self.lines.append(f"  {result} = {text}")

    def _choose(self, result: str, left: str, right: str, yes: str, no: str) -> None:
        """Write: yes where left > right, else no."""
        truth = _type_of(self._width, "i1")
        condition = f"%c{result[1:]}"
        self._put(condition, f"fcmp ogt {self._number_type} {left}, {right}")
        self._put(
            result,
            f"select {truth} {condition}, {self._number_type} {yes},"
            f" {self._number_type} {no}",
        )

    def _write_power_of_two(self, result: str, exponent: str) -> None:
        """Write 2^k: k is added to the exponent of 1.

        The low bits of k + TO_WHOLE are those of k as a whole number. A conversion
        would have no value where k is no number.
        """
        number_type = self._number_type
        integer_type = _type_of(self._width, "i64")
        mantissa_size = _repeat("52", self._width, "i64")
        bits_of_one = _repeat(str(1023 << 52), self._width, "i64")
        name = f"%w{result[1:]}"
        self._put(
            f"{name}.k", f"fadd {number_type} {exponent}, {self.operand_text(TO_WHOLE)}"
        )
        self._put(f"{name}.i", f"bitcast {number_type} {name}.k to {integer_type}")
        self._put(f"{name}.e", f"shl {integer_type} {name}.i, {mantissa_size}")
        self._put(f"{name}.b", f"add {integer_type} {name}.e, {bits_of_one}")
        self._put(result, f"bitcast {integer_type} {name}.b to {number_type}")

    def _call_libm(self, result: str, name: str, texts: Sequence[str]) -> None:
        """Call a function of libm lane by lane, so each lane has Python's bits."""
        if self._width == 1:
            arguments = ", ".join(f"double {text}" for text in texts)
            self._put(result, f"call double @{name}({arguments})")
            return
        vector = "undef"
        for lane in range(self._width):
            numbers = []
            for k, text in enumerate(texts):
                numbers.append(f"{result}.{lane}.{k}")
                self._put(
                    numbers[-1],
                    f"extractelement {self._number_type} {text}, i32 {lane}",
                )
            arguments = ", ".join(f"double {number}" for number in numbers)
            self._put(f"{result}.{lane}", f"call double @{name}({arguments})")
            last = lane == self._width - 1
            filled = result if last else f"{result}.{lane}.v"
            self._put(
                filled,
                f"insertelement {self._number_type} {vector}, double {result}.{lane},"
                f" i32 {lane}",
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
            self.store(self.operand_text(operand), arguments, place)
        name = _function_name(routine.name, self._width)
        array = _pointer(self._number_type)
        self.lines.append(
            f"  call void {name}({array} {arguments}, double* %p, {array} {results})"
        )

    def _new_array(self, name: str, size: int) -> str:
        self.first_lines.append(
            f"  {name} = alloca {self._number_type}, i32 {size}, align 32"
        )
        return name

    def _number(self, slot: int) -> str:
        """Load a number of the scene, at the beginning of the function, once."""
        if slot not in self._numbers:
            name = f"%n{slot}"
            if self._width == 1:
                self.first_lines += self._load(name, "double", "%p", slot)
            else:
                self.first_lines += self._load(f"{name}.s", "double", "%p", slot)
                self.first_lines += _splat(name, f"{name}.s", self._width)
            self._numbers[slot] = name
        return self._numbers[slot]

    def _load(
        self, result: str, element_type: str, array: str, place: int
    ) -> list[str]:
        lines: list[str] = []
        address = self._address(lines, array, place, element_type)
        pointer = _pointer(element_type)
        lines.append(f"  {result} = load {element_type}, {pointer} {address}, align 8")
        return lines

    def _address(
        self, lines: list[str], array: str, place: int, element_type: str | None = None
    ) -> str:
        address = f"%q{self._places}"
        self._places += 1
        element_type = element_type or self._number_type
        lines.append(_element(address, element_type, array, place))
        return address


def _element(result: str, element_type: str, array: str, place: int | str) -> str:
    """Line that takes the address of an element of an array."""
    return (
        f"  {result} = getelementptr inbounds {element_type},"
        f" {_pointer(element_type)} {array}, i64 {place}"
    )


def _splat(result: str, scalar: str, width: int) -> list[str]:
    """Lines that give all lanes one number."""
    vector_type = _type_of(width)
    return [
        f"  {result}.1 = insertelement {vector_type} undef, double {scalar}, i32 0",
        (
            f"  {result} = shufflevector {vector_type} {result}.1, {vector_type} undef,"
            f" <{width} x i32> zeroinitializer"
        ),
    ]


def _spread_early(early: int, lanes: int) -> list[str]:
    """Lines that give all lanes what `_write_loop` computes before the loop."""
    vector_type = _type_of(lanes)
    lines: list[str] = []
    for i in range(early):
        lines.append(_element(f"%e{i}.a", "double", "%e", i))
        lines.append(f"  %e{i}.s = load double, double* %e{i}.a, align 8")
        lines += _splat(f"%e{i}", f"%e{i}.s", lanes)
        lines.append(_element(f"%x{i}", vector_type, "%x", i))
        pointer = _pointer(vector_type)
        lines.append(f"  store {vector_type} %e{i}, {pointer} %x{i}, align 8")
    return lines


def _read_columns(i: int, lanes: int) -> list[str]:
    """Lines of `_write_loop` that copy columns of a row to input i of the body."""
    vector_type = _type_of(lanes)
    array = _pointer(vector_type)
    return [
        _element(f"%l{i}.a", "double", f"%r{i}", "%k"),
        f"  %l{i}.v = bitcast double* %l{i}.a to {array}",
        f"  %l{i} = load {vector_type}, {array} %l{i}.v, align 8",
        _element(f"%x{i}", vector_type, "%x", i),
        f"  store {vector_type} %l{i}, {array} %x{i}, align 8",
    ]


def _write_columns(i: int, lanes: int) -> list[str]:
    """Lines of `_write_loop` that copy output i of the body to columns of a row."""
    vector_type = _type_of(lanes)
    array = _pointer(vector_type)
    return [
        _element(f"%o{i}.a", vector_type, "%o", i),
        f"  %o{i} = load {vector_type}, {array} %o{i}.a, align 8",
        _element(f"%t{i}", "double", f"%w{i}", "%k"),
        f"  %t{i}.v = bitcast double* %t{i} to {array}",
        f"  store {vector_type} %o{i}, {array} %t{i}.v, align 8",
    ]


def _write_loop(
    name: str, early: int, program: Program, shared: int, lanes: int
) -> str:
    """Write the loop over columns: `void name_rows(n, shared, numbers, ins, outs)`.

    `ins` and `outs` are arrays of addresses of rows; n is a multiple of the lanes. The
    first `early` inputs of the program are what is computed before the loop.

    Names in the text: %x and %o are inputs and outputs of the body, %e what is computed
    early; %r and %w are the rows that are read and written, %l and %t a place in each.
    """
    vector_type = _type_of(lanes)
    count = len(program.inputs)
    array = _pointer(vector_type)
    lines = [
        (
            f"define void @{row_name(name, shared)}"
            "(i64 %n, double* %s, double* %p, double** %ins, double** %outs) {"
        ),
        "entry:",
        f"  %x = alloca {vector_type}, i32 {count}, align 32",
        f"  %o = alloca {vector_type}, i32 {len(program.outputs)}, align 32",
        f"  %e = alloca double, i32 {early}, align 32",
        (
            f"  call void {_function_name(_before(name), 1)}(double* %s, double* %p,"
            " double* %e)"
        ),
    ]
    lines += _spread_early(early, lanes)
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
        lines += _read_columns(i, lanes)
    call = _function_name(_body(name), lanes)
    lines.append(f"  call void {call}({array} %x, double* %p, {array} %o)")
    for i in range(len(program.outputs)):
        lines += _write_columns(i, lanes)
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
