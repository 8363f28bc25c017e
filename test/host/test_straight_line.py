# SPDX-License-Identifier: Apache-2.0
"""Texts that become instructions of LLVM at once: they have the bits of the interpreter."""

import itertools
import math

import numpy as np
import pytest
from programs import python

from sst_ros.host import compiled_module

pytestmark = pytest.mark.skipif(compiled_module.numba_version() is None, reason="needs numba")

INF, NAN = math.inf, math.nan
SPECIAL = (0.0, -0.0, 1.0, -2.5, 3e-310, INF, -INF, NAN)
RHS = """\
def rhs(x, y, p):
    c0 = p[1]
    v0 = x * c0 - y / 3.0
    v1 = -v0 + abs(x)
    v2 = max(v0, 0.0)
    v3 = (1.0 if x > 0.0 else 0.0)
    v4 = tanh(x) + exp(-abs(y)) * sin(v3) - cos(v3)
    return (v1, v2, v4, atan2(y, x), sqrt(abs(v0)),)
"""
ATTEMPT = """\
def attempt(x, y, p, place):
    a, b, c, d, e = rhs(x, y, p)
    place[0], place[1], = rhs2(a, b)
    for k in range(4):
        turn = 1.0 if k == 2 else 0.5
        place[2 + k] = turn * c
        place[2 * k + 6] = d
    place[13] = e
"""
CALL = "def compute(x, y, p, place):\n    attempt(x, y, p, place)\n    return rhs(x, y, p)\n"


def module_of(*, numba):
    texts = [RHS, "def evaluate(x, y):\n    return (x + y, x - y,)\n"]
    texts += [ATTEMPT.replace("rhs2", "evaluate"), CALL]
    return compiled_module.load(texts, {}, numba=numba)


def test_each_statement_has_the_bits_of_the_interpreter(tmp_path, monkeypatch):
    monkeypatch.setenv("SST_ROS_CACHE", str(tmp_path))
    fast, plain = (module_of(numba=numba) for numba in (True, False))
    random = np.random.default_rng(1).normal(size=(100, 2)).tolist()
    tried = 0
    for x, y in (*itertools.product(SPECIAL, repeat=2), *random):
        places, found = [], []
        for module, kind in ((fast, np.array), (plain, list)):
            place = kind([0.0] * 14)
            try:
                found.append(np.array(module.compute(x, y, kind([7.0, 1.1]), place)))
            except (ArithmeticError, ValueError):  # the interpreter's, of sin(inf) and the like
                continue
            places.append(np.array(place))
        if len(found) == 2:
            tried += 1
            for one, other in (found, places):
                assert np.array_equal(one, other, equal_nan=True)
                assert (np.signbit(one) == np.signbit(other))[~np.isnan(one)].all()
    assert tried > 150


FIRST = """\
import resource
from sst_ros import Simulation, load_scene

def used():
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in both)

scene, before = load_scene("general"), used()
simulation = Simulation(scene, compiled=True)
simulation.step((0.1, 0.2, 0.3), 1_000_000)
first = used()
simulation.load_code()
every = used()
other = scene.with_values({"star.inertia.zz": 1.1 * scene.star.inertia.zz})
Simulation(other, compiled=True).step((0.1, 0.2, 0.3), 1_000_000)
print(first - before, every - before, used() - every)
"""


@pytest.mark.slow
def test_a_new_structure_and_a_changed_scene_are_compiled_quickly(tmp_path):
    """Seconds of the processor, as the machine may be busy: numba is imported and warms up too."""
    out = python(FIRST, env={"SST_ROS_CACHE": str(tmp_path)}).stdout
    first, every, changed = map(float, out.split())
    assert first < 5.0 and every < 10.0 and changed < 0.3, out
