# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sst_ros.mechanism.generic_math import atan2, exp, positive, sqrt, tanh
from sst_ros.programs.expression import compile_program, trace, trace_along

FINITE = st.floats(-10.0, 10.0)


@pytest.mark.parametrize(
    ("function", "operations"),
    [
        (lambda x, y: (0.0 * x + y,), 0),
        (lambda x, y: (x - 0.0, 1.0 * y, y / 1.0), 0),
        (lambda x, y: (x - x + 0.0 * y,), 0),
        (lambda x, y: (-(0.0 - x),), 0),
        (lambda x, y: (x * y, y * x), 1),
        (lambda x, y: (x + -y,), 1),
        (lambda x, y: (0.0 / x,), 0),
        (lambda x, y: ((2.0 + 3.0) * x,), 1),
        (lambda x, y: (x * y + 0.0 * sqrt(x) * tanh(y),), 1),
        (lambda x, y: (exp(x * y), x + y)[1:], 1),
    ],
)
def test_constants_fold_and_what_is_not_needed_costs_nothing(function, operations):
    assert trace(function, ("x", "y")).operations.total() == operations


def everything(x, y):
    angle = atan2(x * y + 1.0, y - 3.0)
    return (
        angle / (2.0 + x * x),
        -sqrt(1.0 + y * y) * tanh(x),
        exp(-x * x) - positive(y - 1.0) * 4.0,
    )


@given(FINITE, FINITE)
def test_a_program_gives_the_bits_of_its_function(x, y):
    assert compile_program(trace(everything, ("x", "y")))(x, y) == everything(x, y)


@given(FINITE, FINITE.filter(lambda y: abs(y - 1.0) > 1e-6 and abs(y - 3.0) > 1e-6))
def test_derivatives_equal_the_complex_step(x, y):
    program = trace(everything, ("x", "y"), ("x", "y"))
    values = compile_program(program)(x, y)
    step = 1e-200
    by_x = [np.imag(f) / step for f in everything(complex(x, step), complex(y))]
    by_y = [np.imag(f) / step for f in everything(complex(x), complex(y, step))]
    assert values[:3] == everything(x, y)
    assert values[3:] == pytest.approx([*by_x, *by_y], rel=1e-12, abs=1e-14)


@given(FINITE, FINITE.filter(lambda y: abs(y - 1.0) > 1e-6), FINITE, FINITE)
def test_rates_of_outputs_equal_the_complex_step(x, y, x_rate, y_rate):
    program = trace_along(everything, ("x", "y"), ("y", "x"))
    assert program.inputs == ("x", "y", "rate_of_y", "rate_of_x")
    values = compile_program(program)(x, y, y_rate, x_rate)
    step = 1e-200
    moved = everything(complex(x, step * x_rate), complex(y, step * y_rate))
    assert values[:3] == everything(x, y)
    rates = [np.imag(f) / step for f in moved]
    assert values[3:] == pytest.approx(rates, rel=1e-12, abs=1e-13)


def test_an_input_that_does_not_change_gives_outputs_no_rate():
    program = trace_along(lambda x, y: (x * y, x), ("x", "y"), ("y",))
    assert compile_program(program)(3.0, 5.0, 2.0) == (15.0, 3.0, 6.0, 0.0)


def test_a_branch_on_a_traced_number_is_refused():
    with pytest.raises(TypeError, match="branch on constants only"):
        trace(lambda x: (1.0 if x else 0.0,), ("x",))


def test_numpy_constants_do_not_capture_expressions():
    program = trace(lambda x: (np.float64(2.0) * x, np.float64(1.0) + x), ("x",))
    assert compile_program(program)(3.0) == (6.0, 4.0)
    assert compile_program(trace(lambda x: (x / 4.0,), ("x",)))(3.0) == (0.75,)
