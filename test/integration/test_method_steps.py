# SPDX-License-Identifier: Apache-2.0
"""Steps of every method: the same bits as machine code and as plain Python, order,
Jacobians.
"""

from __future__ import annotations

import copy
import functools
import math
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from loaded_scenes import IGNORE, loaded, start_of, viscous
from models import seeded_samples
from slow_cases import slow_after, slow_except

from benchmark.plain_python import without_llvmlite
from sst_ros.dynamics import kernel
from sst_ros.dynamics.kernel import derivative
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics, recent_ode
from sst_ros.integration.applied_torque import AppliedTorque
from sst_ros.integration.function_steps import FunctionSteps
from sst_ros.integration.method_steps import MethodSteps
from sst_ros.integration.methods import DOP853, DORMAND_PRINCE, METHODS, RK4, RODAS5P
from sst_ros.integration.point import Drive, Point
from sst_ros.programs.expression import compile_program, number_constants, trace
from sst_ros.programs.llvm import write_module
from sst_ros.scene.loads import Friction, JointFriction
from sst_ros.scene.scene import load
from sst_ros.scene.schema import Section

DRIVE = (3.0, -2.0, 1.0)
MOMENT = (0.1, 0.2, 0.3)
EXAMPLE2 = load("example2_heavy")


def system_of(scene, torque=None, work=False):
    return ODE(Dynamics.of(scene), torque, work=work)


SINE = (replace(EXAMPLE2, **IGNORE), 0.4, EXAMPLE2.torque)
SPIN = (replace(load("fast_spin"), **IGNORE), 0.01, None)
ORDERS = [
    *(
        (SINE, method, n)
        for method, n in ((RK4, 256), (DORMAND_PRINCE, 64), (DOP853, 16))
    ),
    (SINE, RODAS5P, 128),
    *(
        (SPIN, method, n)
        for method, n in ((RK4, 256), (DORMAND_PRINCE, 96), (RODAS5P, 96))
    ),
]


@functools.cache
def truth_of(scene, span, torque):
    """DOP853 in steps that err below rounding, for two lengths of them agree."""
    system = system_of(scene, torque)
    y, drive = start_of(scene), () if torque else (1000.0, -500.0, 700.0)
    steps = MethodSteps(system, DOP853)
    few, many = (steps.fixed(0.0, span / n, n, y, Drive(drive)) for n in (100, 200))
    assert math.dist(few[:4], many[:4]) < 2e-14
    return system, y, drive, many


@pytest.mark.parametrize(
    ("case", "method", "steps"),
    ORDERS,
    ids=[
        f"{'sine' if case[2] else 'spin'}-{method.name}" for case, method, _ in ORDERS
    ],
)
def test_measured_order_is_that_of_the_theory(case, method, steps):
    """Errors stay well above rounding.

    Under sine torques the d/dt of Rodas5P is at work.
    """
    system, y, drive, truth = truth_of(*case)
    machine = MethodSteps(system, method)
    errors = []
    for count in (steps, 2 * steps):
        end = machine.fixed(0.0, case[1] / count, count, y, Drive(drive))
        size = 7 if case is SINE else 4  # rates of 100 rad/s have rounding of their own
        errors.append(math.dist(end[:size], truth[:size]))
    assert errors[1] > 2e-14
    assert math.log2(errors[0] / errors[1]) == pytest.approx(method.order, abs=0.1)


def linearised(scene, torque, t, y, drive):
    system = system_of(scene, torque, work=True)
    size = len(system.state)
    results = system.linearised(t, *y, *drive[: len(system.drive)])
    slope, by_time, *columns = np.array(results).reshape(size + 2, size)
    return slope, by_time, np.array(columns).T


@pytest.mark.parametrize("seed", slow_after(1, range(3)))
@pytest.mark.parametrize("what", slow_after(1, ["inertia", "loaded"]))
def test_jacobians_are_exact(what, seed):
    """Against the complex step through the kernel itself, which has no difference to
    cancel.

    At rest of contact: the elastic stops are not in touch, where complex steps have no
        meaning.
    """
    (sample,) = seeded_samples(seed + 80, 1)
    scene = loaded() if what == "loaded" else sample.scene
    dynamics = Dynamics.of(scene)
    y = [
        *start_of(scene)[:4],
        *(0.3, -0.2, 0.4),
        *(0.5, -0.4, 0.2)[: len(dynamics.state) - 7],
    ]
    y = [x + 0.003 * (seed + 1) * (-1) ** i for i, x in enumerate(y)]
    slope, by_time, matrix = linearised(scene, None, 0.0, [*y, 0.0], (*DRIVE, *MOMENT))
    moment = MOMENT if dynamics.has_moment_topic else None
    size = len(y)
    truth = np.zeros((size, size))
    for j in range(size):
        stepped = [complex(x) for x in y]
        stepped[j] += 1e-30j
        truth[:, j] = (
            np.imag(derivative(dynamics.model, tuple(stepped), DRIVE, moment)) / 1e-30
        )
    assert np.abs(truth).max() > 1.0
    np.testing.assert_allclose(
        matrix[:size, :size], truth, rtol=0, atol=1e-12 * np.abs(truth).max()
    )
    assert not by_time.any()
    assert not matrix[:, -1].any()  # nothing depends on the work done
    assert np.all(np.isfinite(slope))


def test_the_derivative_by_time_is_exact():
    """With M_dot = 0 it is M^-1 J^T tau_dot: linear in tau, so two exact torques give
    it.
    """
    t, torque = 0.13, EXAMPLE2.torque
    y = [*start_of(EXAMPLE2)[:4], 0.3, -0.2, 0.4, 0.0]
    slope, by_time, _ = linearised(EXAMPLE2, torque, t, y, ())
    rows = list(zip(torque.amplitude, torque.frequency, torque.phase, strict=True))
    model = Dynamics.of(EXAMPLE2).model
    now = tuple(a * math.sin(f * t + p) for a, f, p in rows)
    rate = tuple(a * f * math.cos(f * t + p) for a, f, p in rows)
    moving, free = (
        np.array(derivative(model, tuple(y[:7]), tau)) for tau in (rate, (0.0,) * 3)
    )
    np.testing.assert_allclose(by_time[:7], moving - free, atol=1e-12)
    np.testing.assert_allclose(
        slope[:7], derivative(model, tuple(y[:7]), now), atol=1e-12
    )
    assert np.abs(by_time).max() > 1.0


def test_a_step_without_a_finite_result_has_an_infinite_error():
    steps = MethodSteps(system_of(EXAMPLE2), DORMAND_PRINCE)
    y = start_of(EXAMPLE2)
    at = Point(y, y, (0.0,) * 18, DORMAND_PRINCE)
    assert steps.pair(0.0, 1e-3, at, Drive((1e308, 1e308, 0.0))).size == math.inf


def test_a_slope_of_its_own_needs_an_explicit_method():
    system = system_of(viscous(1.0))
    with pytest.raises(ValueError, match="has no Jacobian, which the method needs"):
        torque = AppliedTorque(system.dynamics, None)
        FunctionSteps(system, RODAS5P, torque, derivative=lambda *x: x)


# Compiled code belongs to a structure: scenes that differ in numbers alone share it.

SCENES = sorted(path.stem for path in Path("config/scenes").glob("*.yaml"))
QUICK = ("elastic_stops", "general")


def perturb(value, rng, size=0.1):
    """Change all numbers of a scene that are neither 0 nor 1, without a look at
    physics.
    """
    if isinstance(value, float):
        return (
            value
            if value in (0.0, 1.0, -1.0)
            else value * (1.0 + size * rng.uniform(-1.0, 1.0))
        )
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
    programs = {"slope": ode.program, "joints": ode.dynamics.joints_program}
    if implicit:
        programs["linearise"] = ode.jacobian
    module = write_module(programs)
    return module.text, module.numbers


@pytest.mark.parametrize("name", slow_except(QUICK, [*SCENES, "loaded"]))
def test_all_scenes_of_a_kind_have_one_text(name):
    """The shipped ones have equal legs and equal moments, which the others have not."""
    scene, rng = loaded() if name == "loaded" else load(name), np.random.default_rng(7)
    text, numbers = text_of(ode_of(scene))
    others = [text_of(ode_of(perturb(scene, rng))) for _ in range(20)]
    assert {other for other, _ in others} == {text}
    assert len({tuple(values) for _, values in others}) == 20
    assert all(len(values) == len(numbers) for _, values in others)
    one, other = (
        text_of(ode_of(x), implicit=True) for x in (scene, perturb(scene, rng))
    )
    assert one[0] == other[0]


def test_a_term_or_a_zero_more_is_another_structure():
    text, _ = text_of(ode_of(EXAMPLE2))
    rubbing = replace(EXAMPLE2, friction=JointFriction(gamma=Friction(viscous=0.1)))
    skew = replace(EXAMPLE2.star, inertia=replace(EXAMPLE2.star.inertia, xz=1e-4))
    assert (
        text_of(ode_of(rubbing))[0]
        != text
        != text_of(ode_of(replace(EXAMPLE2, star=skew)))[0]
    )


def test_the_torques_of_a_scene_are_numbers_too():
    rng, scene = np.random.default_rng(3), EXAMPLE2
    texts = {
        text_of(ode_of(one, one.torque, limit=2.5 * rng.uniform(0.5, 2.0)))[0]
        for one in (scene, *(perturb(scene, rng) for _ in range(3)))
    }
    assert len(texts) == 1
    assert len(re.findall(r"= call double @sin\(", texts.pop())) == 3


def test_coincidences_of_numbers_change_no_text():
    """Equal ones, powers of two, and sums that vanish.

    The value is that of the floats.
    """

    def function(a, b, c):
        def of(x, y):
            folded = (2.0 - a) * (b - 2.0) + 1.0 / -b - (1.0 + c) / 3.0
            return (
                x / a
                + x * b
                + (y * b + y * c)
                + (b - c) * x
                + 2.0 * a * y
                + folded * x,
            )

        return of

    texts, given = (
        set(),
        [(3.0, 5.0, 7.0), (4.0, 5.0, 5.0), (0.5, 2.0, 0.3), (2.0, 0.25, -0.25)],
    )
    for values in given:
        program = trace(function(*number_constants(values)), ("x", "y"))
        module = write_module({"f": program})
        texts.add(module.text)
        expected = function(*values)(0.7, -1.3)
        assert compile_program(program)(0.7, -1.3) == expected
        assert tuple(module.function("f")(0.7, -1.3)) == expected
    assert len(texts) == 1


@functools.cache
def like_loaded():
    """Scenes of one structure that has every term there is."""
    rng = np.random.default_rng(11)
    return [loaded(), *(perturb(loaded(), rng, 0.03) for _ in range(5))]


def march(scene, method, y):
    """Two pairs, then 200 steps through contact and sliding."""
    steps, drive = MethodSteps(ode_of(scene), method), Drive((*DRIVE, *MOMENT))
    first = steps.pair(0.0, 1e-3, Point(y, y, (0.0,) * 18, method), drive)
    middle = Point(first.y, first.z, first.joints, method)
    second = steps.pair(1e-3, 2e-3, middle, drive)
    return first, second, steps.fixed(0.0, 1e-3, 200, y, drive)


@pytest.fixture(scope="module")
def start():
    return start_of(loaded(), 11)


@pytest.mark.parametrize(
    "method", slow_except([METHODS["dop853"]], METHODS.values()), ids=[*METHODS]
)
def test_one_code_gives_the_bits_of_plain_python_for_each_scene(method, start):
    pytest.importorskip("llvmlite", reason="needs llvmlite: pip install .[fast]")
    scenes = like_loaded() if method is not RODAS5P else like_loaded()[:2]
    ends = [march(scene, method, start) for scene in scenes]
    with without_llvmlite():
        assert ends == [march(scene, method, start) for scene in scenes]
    assert len({str(end) for end in ends}) == len(ends)


def test_scenes_in_turns_and_threads_keep_their_own_numbers(start):
    scenes = like_loaded()[:2]
    alone = [march(scene, DORMAND_PRINCE, start) for scene in scenes]
    assert [march(scene, DORMAND_PRINCE, start) for scene in scenes * 3] == alone * 3

    def repeat(scene):
        return [march(scene, DORMAND_PRINCE, start) for _ in range(20)]

    with ThreadPoolExecutor(2) as pool:
        assert [*pool.map(repeat, scenes)] == [[end] * 20 for end in alone]


def test_many_steps_at_once_have_the_bits_of_each(start):
    scene = loaded()
    steps, rng = MethodSteps(ode_of(scene), DOP853), np.random.default_rng(5)
    rows = [
        [
            t,
            h,
            *np.array(start) * (1.0 + 1e-3 * rng.uniform(-1, 1, len(start))),
            *DRIVE,
            *MOMENT,
        ]
        for t, h in rng.uniform(1e-4, 1e-2, (11, 2))
    ]
    size, after = len(start), steps.states_after(np.array(rows))
    for row, state in zip(rows, after.tolist(), strict=True):
        y, drive = row[2 : 2 + size], Drive(tuple(row[2 + size :]))
        assert state == steps.single(row[0], row[1], y, drive)


@pytest.mark.parametrize("name", slow_except(QUICK, SCENES))
def test_a_text_for_all_scenes_has_hardly_more_operations(name):
    """Against the trace that merges and folds whatever is equal in this scene."""
    ode = recent_ode(Dynamics.of(load(name)), work=True)
    own = trace(ode.derivative, ode.program.inputs)
    assert own.operations.total() <= ode.program.operations.total()
    assert ode.program.operations.total() <= own.operations.total() + 5
