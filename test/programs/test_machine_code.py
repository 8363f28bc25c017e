# SPDX-License-Identifier: Apache-2.0
"""Machine code of programs has the bits of the same program in plain Python."""

import math
import random
import struct
import subprocess
import sys
import textwrap

import numpy as np
import pytest

from sst_ros.mechanism.generic_math import absolute, larger, select
from sst_ros.programs.expression import (
    MATH_FUNCTIONS,
    Routine,
    compile_program,
    number_constants,
    trace,
)
from sst_ros.programs.llvm import LANES, RowFunction, write_module

pytest.importorskip("llvmlite", reason="needs llvmlite: pip install .[fast]")

SPECIAL = (0.0, -0.0, 1.0, -1.0, 1e-310, 1e308, math.inf, -math.inf, math.nan)
UNARY = ("tanh", "exp", "sin", "cos", "positive", "step", "abs")


def random_function(random, inputs, operations):
    """Return a function of any numbers, by operations that are drawn."""
    drawn = []
    for position in range(inputs, inputs + operations):
        kind = random.choice(("+", "-", "*", "/", "max", "select", "atan2", *UNARY))
        places = [random.randrange(position) for _ in range(3)]
        drawn.append((kind, places, random.uniform(-2.0, 2.0)))

    def function(*numbers):
        values = list(numbers)
        for kind, places, constant in drawn:
            x, y, z = (values[place] for place in places)
            if kind == "+":
                result = x + y
            elif kind == "-":
                result = x - constant * y
            elif kind == "*":
                result = x * y
            elif kind == "/":
                result = x / (y * y + 1.5)
            elif kind in ("max", "select", "atan2"):
                arguments = {"max": (x, y), "select": (x, y, z), "atan2": (x, y)}[kind]
                result = x.apply(kind, *arguments)
            else:
                result = x.apply(kind)
            values.append(result)
        return values[-6:]

    return function


def bits(numbers):
    """Return the bits of numbers; all that are no number are the same."""
    return [
        "nan" if math.isnan(x) else struct.pack("d", x).hex()
        for x in map(float, numbers)
    ]


def rows_of(program, columns):
    """Compute a program over columns, the first input shared by all."""
    inputs = [np.array(row) for row in zip(*columns, strict=True)][1:]
    outputs = [np.empty(len(columns)) for _ in program.outputs]
    module = write_module({"f": program}, rows=["f"], shared=1)
    RowFunction(module, "f", 1)([columns[0][0]], inputs, outputs)
    return np.array(outputs).T


@pytest.mark.parametrize("seed", range(20))
def test_machine_code_and_lanes_have_the_bits_of_python(seed):
    draw = random.Random(seed)
    names = ("a", "b", "c", "d")
    program = trace(random_function(draw, len(names), 40), names)
    plain = compile_program(program)
    fast = write_module({"f": program}).function("f")
    columns = []
    for _ in range(3 * LANES + 1):
        column = [draw.choice((*SPECIAL, draw.gauss(0.0, 2.0))) for _ in names]
        column[0] = columns[0][0] if columns else draw.gauss(0.0, 2.0)
        columns.append(column)
    by_rows = rows_of(program, columns)
    for column, row in zip(columns, by_rows, strict=True):
        machine = fast(*column)
        assert bits(machine) == bits(row)
        try:
            expected = plain(*column)
        except (ArithmeticError, ValueError):  # Python has no value there
            continue
        assert bits(machine) == bits(expected)


def test_a_program_calls_another_by_its_name_scalar_and_in_lanes():
    inner = trace(lambda x, y: (x * y, x / y, -x), ("x", "y"))
    routine = Routine("inner", 2, 3)

    def twice(t, x):
        first = routine(x, 2.0)
        second = routine(first[0] + t, first[1])
        return (*second, first[2])

    def written_out(t, x):
        first = (x * 2.0, x / 2.0, -x)
        y, z = first[0] + t, first[1]
        return (y * z, y / z, -y, first[2])

    programs = {"inner": inner, "f": trace(twice, ("t", "x"))}
    fast = write_module(programs).function("f")
    plain = compile_program(
        programs["f"], {**MATH_FUNCTIONS, "inner": compile_program(inner)}
    )
    assert tuple(fast(0.3, 0.7)) == plain(0.3, 0.7) == written_out(0.3, 0.7)
    x = np.linspace(0.1, 2.0, 2 * LANES + 3)
    outputs = [np.empty_like(x) for _ in range(4)]
    RowFunction(write_module(programs, rows=["f"], shared=1), "f", 1)(
        [0.3], [x], outputs
    )
    assert [tuple(row) for row in np.array(outputs).T] == [
        written_out(0.3, v) for v in x
    ]


def test_a_call_with_the_wrong_count_of_numbers_is_refused():
    routine = Routine("inner", 2, 1)
    with pytest.raises(TypeError, match="inner takes 2 numbers, not 1"):
        trace(lambda x: routine(x), ("x",))


def test_scenes_of_one_structure_share_the_text():
    def of(factor):
        numbers = number_constants((factor, 2.5))
        return trace(lambda x: (numbers[0] * x + numbers[1] * numbers[0],), ("x",))

    first, second = (write_module({"f": of(factor)}) for factor in (3.25, 0.75))
    assert first.text == second.text
    assert first.function("f")(2.0) == [3.25 * 2.0 + 2.5 * 3.25]
    assert second.function("f")(2.0) == [0.75 * 2.0 + 2.5 * 0.75]


def test_outputs_may_take_the_inputs_place_and_some_columns_stay():
    program = trace(lambda x, y: (x + y, x - y), ("x", "y"))
    step = RowFunction(write_module({"f": program}, rows=["f"]), "f")
    x, y = np.arange(11.0), np.ones(11)
    step((), (x, y), (x, y), slice(2, 9))
    inside = np.arange(11) % 11
    moved = (inside >= 2) & (inside < 9)
    assert np.array_equal(x, np.where(moved, inside + 1.0, inside))
    assert np.array_equal(y, np.where(moved, inside - 1.0, 1.0))


@pytest.mark.parametrize("x", [-2.0, -0.0, 0.0, 3.0, math.nan])
@pytest.mark.parametrize("y", [-1.0, 0.0, 4.0])
def test_functions_that_choose_agree_for_all_kinds_of_numbers(x, y):
    def choose(x, y):
        return absolute(x), larger(x, y), select(x, y, x)

    expected = bits(choose(x, y))
    program = trace(choose, ("x", "y"))
    assert bits(compile_program(program)(x, y)) == expected
    assert bits(write_module({"f": program}).function("f")(x, y)) == expected
    if not math.isnan(x):
        by_columns = choose(np.array([x]), np.array([y]))
        assert bits([float(row[0]) for row in by_columns]) == expected


def test_derivatives_of_choices_are_those_of_the_chosen_side():
    program = trace(
        lambda x, y: (absolute(x), larger(x * x, y), select(y, x * y, x)),
        ("x", "y"),
        ("x", "y"),
    )
    assert compile_program(program)(-3.0, 2.0)[3:] == (-1.0, -6.0, 2.0, 0.0, 0.0, -3.0)
    assert compile_program(program)(1.0, 2.0)[3:] == (1.0, 0.0, 2.0, 0.0, 1.0, 1.0)


COLD = """
    import os, sys, threading
    from sst_ros.programs.expression import trace
    from sst_ros.programs.llvm import write_module

    def function_of(power):
        def product(x):
            for _ in range(300 + power):
                x = x * x - 0.75
            return (x,)
        return write_module({"f": trace(product, ("x",))}).function("f")

    def truth(power):
        x = 0.5
        for _ in range(300 + power):
            x = x * x - 0.75
        return [x]
"""


def run_cold(code):
    text = textwrap.dedent(COLD) + textwrap.dedent(code)
    done = subprocess.run(
        [sys.executable, "-c", text], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr


def test_the_first_use_may_be_in_many_threads_at_once():
    run_cold("""
        results = {}
        def work(k):
            results[k] = function_of(k % 3)(0.5) == truth(k % 3)
        threads = [threading.Thread(target=work, args=(k,)) for k in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert results == {k: True for k in range(8)}, results
    """)


def test_a_process_may_fork_while_a_thread_compiles():
    run_cold("""
        stop = threading.Event()
        def compile_on():
            power = 10
            while not stop.is_set():
                function_of(power)
                power += 1
        thread = threading.Thread(target=compile_on)
        thread.start()
        for k in range(8):
            child = os.fork()
            if child == 0:
                os._exit(0 if function_of(500 + k)(0.5) == truth(500 + k) else 1)
            assert os.waitpid(child, 0)[1] == 0
        stop.set()
        thread.join()
    """)


@pytest.mark.slow
def test_code_lives_as_long_as_a_function_that_uses_it():
    program = trace(lambda x: (x * 1.25,), ("x",))
    function = write_module({"f": program}).function("f")
    for k in range(200):
        other = trace(lambda x, k=k: (x + 0.5 * k,), ("x",))
        write_module({"f": other}).function("f")
    assert function(2.0) == [2.5]
