# SPDX-License-Identifier: Apache-2.0
"""The own hyperbolic tangent: its error, its bits in all paths, what is no number."""

import math

import numpy as np
import pytest
from mpmath import mp, mpf

from sst_ros.mechanism.generic_math import tanh
from sst_ros.programs.expression import compile_for_arrays, tanh_of_float, trace
from sst_ros.programs.llvm import LANES, RowFunction, write_module

ULP = 2.6
"""Largest error, in units in the last place; that of glibc 2.36 is 2.0."""


def numbers():
    rng = np.random.default_rng(11)
    steps = (np.arange(-64, 65) + 0.5) * math.log(2.0) / 2.0  # where k changes
    return np.concatenate(
        [
            rng.uniform(-25.0, 25.0, 4000),
            rng.uniform(-1.0, 1.0, 4000),
            rng.choice([-1.0, 1.0], 4000) * 10.0 ** rng.uniform(-320.0, 2.0, 4000),
            steps,
            np.nextafter(steps, 0.0),
            [0.0, -0.0, 22.0, -22.0, 1e308, np.inf, -np.inf, 5e-324],
        ]
    )


def test_error_is_a_few_units_in_the_last_place():
    with mp.workdps(40):
        for x in numbers().tolist():
            truth = mp.tanh(mpf(x))
            unit = math.ulp(float(truth))
            assert abs(mpf(tanh(x)) - truth) <= ULP * unit, x
            assert tanh(-x) == -tanh(x)


def test_numpy_numbers_are_floats():
    assert tanh_of_float(np.float64(0.3)) == tanh_of_float(0.3) == tanh(0.3)
    assert tanh_of_float(1) == tanh_of_float(1.0)


def test_no_number_stays_none():
    assert math.isnan(tanh(math.nan)) and math.isnan(tanh_of_float(math.nan))


def test_all_paths_have_the_same_bits():
    pytest.importorskip("llvmlite", reason="needs llvmlite: pip install .[fast]")
    x = np.append(numbers(), np.nan)
    x = np.resize(x, -(-len(x) // LANES) * LANES)
    program = trace(lambda x: (x.apply("tanh"),), ("x",))
    machine = write_module({"f": program}).function("f")
    in_lanes = np.empty(len(x))
    RowFunction(write_module({"f": program}, rows=["f"]), "f")([], [x], [in_lanes])
    expected = np.array([tanh(value) for value in x.tolist()])
    is_number = ~np.isnan(x)
    results = (
        np.array([machine(value)[0] for value in x.tolist()]),
        np.array([tanh_of_float(value) for value in x.tolist()]),
        in_lanes,
        compile_for_arrays(program, exact=True)(x)[0],
    )
    for result in results:
        bits = result[is_number].view(np.int64)
        assert (bits == expected[is_number].view(np.int64)).all()
        assert np.isnan(result[~is_number]).all()
