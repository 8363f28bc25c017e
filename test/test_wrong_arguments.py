# SPDX-License-Identifier: Apache-2.0
"""Values of wrong types and ranges at every public name: refused by an SstError, in a
bounded time.

Functions that are thrown return wrong values; what they raise themselves is theirs.
"""

import random
import signal
from decimal import Decimal
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from slow_cases import slow_after

import sst_ros
from sst_ros import Batch, Simulation, SstError, Trajectory, load_scene, simulate
from sst_ros.control.controller import Measurement
from sst_ros.errors import Problem
from sst_ros.simulation.trajectory import RunRecord

LIST, DICT = [], {}
LIST.append(LIST)
DICT["star"] = DICT
NAN, INF = float("nan"), float("inf")
SCENE, MOVING, REST = load_scene("example2"), load_scene("spiral"), (0.0, 0.0, 0.0)
WRONG = [
    *(
        NAN,
        INF,
        -INF,
        1e308,
        10**400,
        10**5001,
        2**64,
        True,
        0,
        -1,
        1,
        2,
        7,
        1.5,
        -0.0,
        0.1,
    ),
    *(
        1e-320,
        1e9,
        1j,
        Decimal("0.5"),
        Fraction(1, 3),
        np.float32(1),
        np.uint64(2**63),
        np.bool_(1),
    ),
    *(
        (),
        [],
        [[]],
        [None],
        ["a"],
        [1, 2],
        [1, 2, 3],
        (0, 0, 0, 0),
        [0, 0, 0, "a"],
        [10**400] * 3,
    ),
    *(
        [1e-300] * 3,
        [[1, 2], [3]],
        [NAN] * 3,
        np.eye(3),
        np.zeros((0, 3)),
        np.zeros((2, 2, 3)),
    ),
    *(
        np.array("1"),
        np.array([None, 1]),
        np.datetime64("2026-01-01"),
        range(3),
        slice(1),
    ),
    *(
        "",
        "1",
        "x",
        "\0",
        "\ud800",
        b"1",
        "a/b.yaml",
        Path("/"),
        Path("x.npz"),
        "example2",
    ),
    *(lambda: 0, lambda t: 0, lambda t: "abc", lambda t: (1, 2), lambda state, t: 0),
    *(
        ["1", "2", "3"],
        [1, 2, 3, 4, 5, 6, 7],
        bytearray(b"12"),
        type(SCENE),
        pytest,
        "a" * 5000,
    ),
    *(
        None,
        object(),
        Ellipsis,
        set(),
        {},
        {"star": {}},
        {1: 2},
        {"a": [1]},
        LIST,
        DICT,
    ),
    *(10**18, range(10**12), [range(10**12)] * 3, {"gamma": range(10**12)}, dict, list),
]
TASK = {
    "scene": SCENE,
    "torque": REST,
    "duration": 0.01,
    "initial": None,
    "t_eval": None,
}
TASK |= {
    "samples": None,
    "method": "auto",
    "tolerance": 1e-9,
    "control_period": None,
    "breaks": (),
    "max_step": None,
}
PROOF = {
    name: TASK[name] for name in ("scene", "torque", "duration", "initial", "t_eval")
}
PROOF |= {"bound": 1e-9, "ranges": None, "progress": False}
ZONE = {"scene": SCENE, "gamma_box": None, "tilt": 0.3, "torsion": 0.3}
ZONE |= {"orientation": None, "ranges": None, "max_boxes": 500, "progress": False}
STUDY = {
    "scene": SCENE,
    "vary": {"star.inertia.zz": [0.26, 0.27]},
    "duration": 0.01,
    "n": 2,
}
STUDY |= {
    "seed": 0,
    "out": None,
    "client": None,
    "workers": 1,
    "resume": False,
    "progress": False,
}


def push_back(state):
    return (0.0, 0.0, -0.1)


def of(**arguments):
    return arguments


@pytest.fixture(scope="module")
def calls():
    """Public functions, and methods of their results, with arguments that are right."""
    pytest.importorskip("flint")
    geometry, settings = sst_ros.Geometry.of(SCENE), sst_ros.ControllerSettings()
    run, motion = simulate(**TASK), sst_ros.reference_motion(MOVING)
    inverse, batch = sst_ros.InverseDynamics(SCENE), Batch(SCENE)
    controller = sst_ros.Controller(MOVING, motion, settings, 1e-3)
    rows = {
        name: getattr(run, name) for name in ("t", "quaternion", "body_rate", "torque")
    }
    data = {name: getattr(run, name) for name in ("t", "gamma", "torque", "gamma_dot")}
    fit = of(
        method="inverse_dynamics", scene=SCENE, parameters=None, cutoff=None, noise=None
    )
    start = of(gamma=run.gamma[:3], gamma_dot=REST, torque=REST, step=1e-3, count=2)
    push = of(torque=REST, dt_ns=1000, moment=REST)
    measured = Measurement(MOVING.initial.gamma, REST)
    batch.run(**start)  # compiled before the clock runs

    def command(time, measured):
        controller.reset()
        controller.command(time, measured)

    def key(x):
        return x if x.__hash__ and not isinstance(x, float) else "star.mass"

    return [
        (simulate, TASK),
        (simulate, TASK | {"torque": lambda t: REST, "control_period": 1e-3}),
        (sst_ros.certify, PROOF),
        (sst_ros.certify_zone, ZONE),
        (sst_ros.plot_zone, of(zone=None)),
        (load_scene, of(scene="example2")),
        (SCENE.with_values, of(values={"star.mass": 1.0})),
        (lambda k, x: SCENE.with_values({key(k): x}), of(k="star.mass", x=1.0)),
        (sst_ros.equations, of(scene=SCENE, target="numpy", parameters=(),
                               outputs=None)),
        (sst_ros.own_load, of(name="load", potential=None, moment=push_back,
                              parameters=None)),
        (sst_ros.arc_inertia, of(mass=1.0, radius=1.0, begin=[1, 0, 0], end=[0, 1, 0])),
        (sst_ros.Geometry.of, of(scene=SCENE)),
        (sst_ros.Geometry.build, of(v=np.eye(3), alpha=[2.0, 2.0, 2.28], beta_max=1.5)),
        (sst_ros.direct_kinematics, of(geometry=geometry, gamma=run.gamma[0])),
        (sst_ros.inverse_kinematics, of(geometry=geometry, rotation=np.eye(3),
                                        signs=(1, 1, 1))),
        (sst_ros.workspace, of(geometry=geometry, divisions=3, turns=4)),
        (sst_ros.distance_to_singularity, of(where=SCENE, gamma=run.gamma[0])),
        (sst_ros.linearize, of(scene=SCENE, state=None, torque=REST, dt=None,
                               coordinates="gamma")),
        (sst_ros.equilibrium, of(scene=SCENE, gamma=run.gamma[0])),
        (sst_ros.plot_workspace, of(titles=["map"])),
        (sst_ros.InverseDynamics, of(scene=SCENE)),
        (inverse.torque, of(quaternion=(0, 0, 0, 1), body_rate=REST,
                            body_acceleration=REST)),
        (inverse.gravity_torque, of(at=run.gamma[0])),
        (inverse.mass_matrix, of(at=run.gamma[0])),
        (inverse.bias, of(state=Simulation(SCENE).state, moment=REST)),
        (inverse.torque_of_moment, of(at=run.gamma[0], moment=REST)),
        (inverse.reference_torque, of(reference=motion.at(0.1))),
        (sst_ros.reference_motion, of(scene=MOVING, read_motion=None)),
        (sst_ros.ReferenceMotion, of(inside=motion.at, pieces=(0.0, 1.0))),
        (motion.at, of(time=0.1)),
        (sst_ros.Controller, of(model=MOVING, motion=motion, settings=settings,
                                period_s=1e-3)),
        (command, of(time=0.1, measured=measured)),
        (sst_ros.ControllerSettings, vars(settings)),
        (sst_ros.SineTorque, of(amplitude=REST, frequency=REST, phase=REST)),
        (sst_ros.TorqueTable, of(times=[0, 1], torques=np.zeros((2, 3)))),
        (sst_ros.TorqueTable.read, of(path="x.csv")),
        (sst_ros.PolynomialTorque, of(coefficients=np.zeros((2, 1, 3)),
                                      breakpoints=[0, 1])),
        (Simulation, of(scene=SCENE, integrator="auto", tolerance=1e-9,
                        step_budget=None)),
        (lambda **given: Simulation(SCENE).step(**given), push),
        (lambda **given: Simulation(SCENE).steps(**given), push | {"count": 2}),
        (Simulation(SCENE).within, of(time_ns=0)),
        (Simulation(SCENE).acting, of(torque=REST)),
        (Trajectory, rows | {"scene": SCENE, "joints": None, "run": RunRecord()}),
        (RunRecord, of(status=0, law=None)),
        (run.at, of(t=0.005)),
        (run.save, of(path="run.txt", overwrite=True)),
        (Trajectory.load, of(path="run.npz")),
        (sst_ros.read_bag, of(path="x", damaged=False)),
        (sst_ros.Recording, of(found=None)),
        (sst_ros.identify, fit | {"data": run}),
        (sst_ros.identify, fit | {"data": {"t": [0], "gamma_1": [1]},
                                  "method": "simulation"}),
        (lambda **given: sst_ros.identify(given, SCENE), data | {"held": False}),
        (sst_ros.sweep, STUDY),
        (lambda k, x: sst_ros.sweep(**STUDY | {"vary": {key(k): x}, "outputs": ()}),
         of(k="", x=1)),
        (Batch, of(scene=SCENE, profile=False, parameters=None)),
        (lambda k, x: Batch(SCENE, parameters={key(k): x}),
         of(k="star.inertia.zz", x=[0.26])),
        (batch.run, start | {"keep_every": 0, "threads": 1}),
        (batch.scenario, of(row=0)),
    ]  # fmt: skip


def too_long(*_):
    raise TimeoutError


@pytest.mark.parametrize("seed", slow_after(1, [1, 2]))
def test_nothing_but_an_sst_error_comes_out(calls, seed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before, chosen = signal.signal(signal.SIGALRM, too_long), random.Random(seed)
    try:
        for number in range(2000):
            function, right = calls[number % len(calls)]
            names = chosen.sample(
                sorted(right), min(len(right), chosen.choice([1, 1, 1, 2]))
            )
            given = right | {name: chosen.choice(WRONG) for name in names}
            signal.alarm(60)
            try:
                function(**given)
            except SstError as error:
                assert str(error)
            except Exception as error:
                wrong = {name: Problem(name, given[name], "") for name in names}
                pytest.fail(
                    f"{function}: {type(error).__name__} of"
                    f" {[*map(str, wrong.values())]}"
                )
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


COMPLEX = [1j, 0.0, 0.0], np.array([1j, 0, 0]), np.array([1j, 0, 0], np.complex64)
COMPLEX += ((np.complex128(1.0), 0, 0),)


@pytest.mark.parametrize("torque", COMPLEX)
def test_complex_torques_are_refused_and_not_cut(torque, recwarn):
    def acting(t):
        return torque

    simulation = Simulation(SCENE)
    calls = [
        lambda: simulate(SCENE, torque, 0.01),
        lambda: simulate(SCENE, acting, 0.01),
        lambda: simulation.step(torque, 1000),
        lambda: simulation.step(acting, 1000),
        lambda: simulation.step(REST, 1000, torque),
        lambda: sst_ros.linearize(SCENE, None, torque),
        lambda: sst_ros.SineTorque(amplitude=torque, frequency=REST),
        lambda: sst_ros.TorqueTable([0.0], [torque]),
        lambda: Trajectory(SCENE, [0.0], [[0, 0, 0, 1]], [REST], [torque]),
    ]
    for call in calls:
        with pytest.raises(SstError):
            call()
    assert not recwarn.list


def test_what_is_given_stands_in_the_message():
    with pytest.raises(SstError, match="vary = None"):
        sst_ros.sweep(SCENE, None)
    with pytest.raises(SstError, match="count = 1000000000000000000: must be"):
        Simulation(SCENE).steps(REST, 1000, 10**18)
    with pytest.raises(SstError, match="class 'dict'"):
        simulate(SCENE, dict, 0.01)


def test_each_public_name_is_thrown_at(calls):
    thrown = [function for function, _ in calls]
    others = {name for name in sst_ros.__all__ if getattr(sst_ros, name) not in thrown}
    errors = {
        name for name in others if name.endswith(("Error", "Stopped", "Configuration"))
    }
    # A version, what gives others by methods above, and what only results have.
    results = {
        "Equations",
        "Scene",
        "Geometry",
        "Identification",
        "LinearModel",
        "ProvenMotion",
        "ProvenZone",
        "State",
    }
    assert others - errors == {"__version__", *results}
