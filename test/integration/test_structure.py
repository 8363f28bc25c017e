# SPDX-License-Identifier: Apache-2.0
"""Compiled code belongs to a structure: scenes that differ in numbers alone share it."""

from __future__ import annotations

import copy
import functools
import re
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from loaded_scenes import loaded, start_of

from sst_ros.dynamics import kernel
from sst_ros.dynamics.expression import Number, Slots, number_constants, trace
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics, ode_with_work
from sst_ros.integration import codegen, gauss
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.methods import DORMAND_PRINCE, RODAS4
from sst_ros.scene.scene import Friction, JointFriction, load
from sst_ros.scene.schema import Section

needs_numba = pytest.mark.skipif(codegen.numba_version() is None, reason="numba is missing")
SCENES = sorted(path.stem for path in Path("config/scenes").glob("*.yaml"))
EXAMPLE2 = load("example2_heavy")
DRIVE = (3.0, -2.0, 1.0, 0.1, 0.2, 0.3)


def perturb(value, rng, size=0.1):
    """Change all numbers of a scene that are neither 0 nor 1, without a look at physics."""
    if isinstance(value, float):
        return value if value in (0.0, 1.0, -1.0) else value * (1.0 + size * rng.uniform(-1.0, 1.0))
    if isinstance(value, tuple):
        return tuple(perturb(part, rng, size) for part in value)
    if not isinstance(value, Section):
        return value
    changed = copy.copy(value)
    for name, part in vars(value).items():
        if name != "initial":
            object.__setattr__(changed, name, perturb(part, rng, size))
    return changed


def ode_of(scene, torque=None, **options):
    topic = scene.moment is not None and scene.moment.topic
    dynamics = Dynamics(kernel.model_of(scene), has_moment_topic=topic)
    return ODE(dynamics, torque, work=True, **options)


def text_of(ode, *, implicit=False):
    """What is compiled, and the numbers that it takes."""
    slots = Slots()
    programs = {"rhs": ode.program, "joints": ode.joints}
    if implicit:
        programs["jacobian"] = ode.jacobian
    return "".join(one.source(name, slots) for name, one in programs.items()), slots.values


@pytest.mark.parametrize("name", [*SCENES, "loaded"])
def test_all_scenes_of_a_kind_have_one_text(name):
    """The shipped ones have equal legs and equal moments, which the others have not."""
    scene, rng = loaded() if name == "loaded" else load(name), np.random.default_rng(7)
    text, numbers = text_of(ode_of(scene))
    others = [text_of(ode_of(perturb(scene, rng))) for _ in range(20)]
    assert {other for other, _ in others} == {text}
    assert len({tuple(values) for _, values in others}) == 20
    assert all(len(values) == len(numbers) for _, values in others)
    one, other = (text_of(ode_of(x), implicit=True) for x in (scene, perturb(scene, rng)))
    assert one[0] == other[0]


def test_a_term_or_a_zero_more_is_another_structure():
    text, _ = text_of(ode_of(EXAMPLE2))
    rubbing = replace(EXAMPLE2, friction=JointFriction(gamma=Friction(viscous=0.1)))
    skew = replace(EXAMPLE2.star, inertia=replace(EXAMPLE2.star.inertia, xz=1e-4))
    assert text_of(ode_of(rubbing))[0] != text != text_of(ode_of(replace(EXAMPLE2, star=skew)))[0]


def test_the_torques_of_a_scene_are_numbers_too():
    rng, scene = np.random.default_rng(3), EXAMPLE2
    texts = {
        text_of(ode_of(one, one.torque, limit=2.5 * rng.uniform(0.5, 2.0)))[0]
        for one in (scene, perturb(scene, rng), perturb(scene, rng))
    }
    assert len(texts) == 1
    assert len(re.findall(r"= sin\(", texts.pop())) == 3


def test_coincidences_of_numbers_change_no_text():
    """Equal ones, powers of two, and sums that vanish; the value is that of the floats."""

    def function(a, b, c):
        def of(x, y):
            return (x / a + x * b + (y * b + y * c) + (b - c) * x + 2.0 * a * y,)

        return of

    texts, given = set(), [(3.0, 5.0, 7.0), (4.0, 5.0, 5.0), (0.5, 2.0, 0.3), (2.0, 0.25, -0.25)]
    for values in given:
        program = trace(function(*number_constants(values)), ("x", "y"))
        slots = Slots()
        texts.add(program.source("f", slots))
        names = {}
        exec(program.source("f") + program.source("g", slots).replace("f(", "g("), names)
        expected = function(*values)(0.7, -1.3)
        assert names["f"](0.7, -1.3) == names["g"](0.7, -1.3, slots.values) == expected
    assert len(texts) == 1


def test_numbers_fold_as_floats_do():
    a, b = number_constants((0.3, -0.7))
    opposite = -a
    twice = -opposite

    def fold(x, y):
        opposite = -x
        return x + y, 2.0 - x, x - 2.0, x * y, 1.0 / y, x / 3.0, opposite, -opposite, 1.0 + x

    for folded, value in zip(fold(a, b), fold(0.3, -0.7), strict=True):
        assert isinstance(folded, Number) and float(folded) == value
    assert (a + b).origin == (a + b).origin != (b - a).origin and twice.origin == a.origin
    assert type(0.0 * a) is float


@functools.cache
def like_loaded():
    """Scenes of one structure that has every term there is."""
    rng = np.random.default_rng(11)
    return [loaded(), *(perturb(loaded(), rng, 0.03) for _ in range(5))]


def machine_of(scene, method, *, compiled):
    return CompiledMethod(ode_of(scene), method, compiled=compiled)


def march(machine, y):
    drive = DRIVE[: len(machine.system.drive)]
    first = machine.step_pair(0.0, 1e-3, y, y, drive)
    return first, machine.step_fixed(1e-3, 5e-4, 10, first[0], drive)


@pytest.fixture(scope="module")
def start():
    return start_of(loaded(), 11)


@needs_numba
@pytest.mark.parametrize(
    "method",
    [
        pytest.param(DORMAND_PRINCE, id="dopri5"),
        pytest.param(RODAS4, id="rodas4", marks=pytest.mark.slow),
    ],
)
def test_one_code_gives_the_bits_of_plain_python_for_each_scene(method, start):
    machines = [machine_of(scene, method, compiled=True) for scene in like_loaded()]
    assert len({machine._module.__name__ for machine in machines}) == 1
    ends = [march(machine, start) for machine in machines]
    plain = [machine_of(scene, method, compiled=False) for scene in like_loaded()]
    assert ends == [march(machine, start) for machine in plain]
    assert len({str(end) for end in ends}) == len(ends)


@needs_numba
def test_scenes_take_turns_and_threads_and_keep_their_own_numbers(start):
    machines = [machine_of(scene, DORMAND_PRINCE, compiled=True) for scene in like_loaded()[:2]]
    alone = [march(machine, start) for machine in machines]
    assert [march(machine, start) for machine in machines * 3] == alone * 3
    found = {}

    def run(k):
        found[k] = [march(machines[k], start) for _ in range(200)]

    threads = [threading.Thread(target=run, args=(k,)) for k in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(end == alone[k] for k in (0, 1) for end in found[k])


def test_collocation_has_one_text_and_its_numbers_in_its_block():
    rng = np.random.default_rng(5)
    scenes = [EXAMPLE2, *(perturb(EXAMPLE2, rng) for _ in range(3))]
    texts = set()
    for scene in scenes:
        ode = ode_of(scene, scene.torque)
        slots = gauss.slots_of(ode, None)
        texts.add("".join(gauss.source(ode, 4, None, slots)))
    assert len(texts) == 1


@pytest.mark.parametrize("name", SCENES)
def test_a_text_that_serves_all_scenes_has_hardly_more_operations(name):
    """Against the trace that merges and folds whatever is equal in this scene."""
    ode = ode_with_work(Dynamics.of(load(name)))
    own = trace(ode.derivative, ode.program.inputs)
    assert own.operations.total() <= ode.program.operations.total()
    assert ode.program.operations.total() <= own.operations.total() + 5
