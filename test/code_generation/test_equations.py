# SPDX-License-Identifier: Apache-2.0
"""The equations for other programs: their values, derivatives, parameters and files."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import sys
from functools import cache

import numpy as np
import pytest
from loaded_scenes import loaded
from slow_cases import slow_except

import sst_ros
from sst_ros import InputError, equations, load_scene
from sst_ros.__main__ import main
from sst_ros.code_generation.equations import TARGETS
from sst_ros.code_generation.python_module import LIBRARIES
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.errors import EXTRAS, MissingDependency
from sst_ros.scene.own_loads import FormulaLoad
from sst_ros.scene.scene import names
from sst_ros.scene.yaml_document import plain

SCENES = [*names(), "loaded", "own loads"]
QUICK = ("own loads",)
"""The scene with every function."""
QUICK_IN_C = ("general", "elastic_stops")
OWN = (
    "tanh(beta_2) + positive(mu_1 - 0.1)**2"
    " + max(R11, -2) * abs(R22) / (2 + min(R33, 5))"
    " + abs(gamma_1 - 0.7) * atan2(beta_1, 2) + tan(0.2 * gamma_2) - max(R11, R22)"
)
"""A potential with every function that formulas have."""
CLOSE = 1e-12  # relative to the largest number of a result
STRICT = ("-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror", "-O1")
FAST = ("-std=gnu11", "-O3", "-march=native")
"""Where GCC would fuse a multiplication and an addition, on a machine that can."""


@cache
def with_double_precision():
    """JAX, which is imported by no other test."""
    jax = pytest.importorskip("jax", reason="needs jax: pip install .[test]")
    jax.config.update("jax_enable_x64", True)
    return jax


def scene_of(name):
    if name == "own loads":
        load = FormulaLoad(name="own", potential=OWN)
        return load_scene("general").with_values({"own_loads": [plain(load)]})
    return loaded() if name == "loaded" else load_scene(name)


def states(scene, count=5):
    """Random states near the initial one, with torques and, from a topic, a moment."""
    dynamics, rng = Dynamics.of(scene), np.random.default_rng(7)
    start = np.array(equations(scene, "numpy").initial_state)
    for _ in range(count):
        state = start + rng.uniform(-0.1, 0.1, len(start))
        drive = rng.uniform(-2.0, 2.0, len(dynamics.drive))
        yield state, [drive[:3], drive[3:]][: len(drive) // 3]


@cache
def expected(name):
    """State, drive, and the results that the package has for them, by output."""
    scene, rows = scene_of(name), []
    dynamics, ode = Dynamics.of(scene), ODE(Dynamics.of(scene))
    size = len(dynamics.state)
    for state, drive in states(scene):
        inputs = [*state.tolist(), *np.concatenate(drive).tolist()]
        by_state = (
            np.array(ode.linearised(0.0, *inputs)[2 * size :]).reshape(size, size).T
        )
        by_torque = ode.linearised_by_torque(0.0, *inputs)[-3 * size :]
        results = {
            "derivative": np.array(dynamics.derivative(*inputs)),
            "joints": np.array(dynamics.joints(*inputs[:7])),
            "energies": np.array(dynamics.energies(*inputs[:size])),
            "derivative_by_state": by_state,
            "derivative_by_torque": np.array(by_torque).reshape(3, size).T,
        }
        rows.append((state, drive, results))
    return rows


class Compiled:
    """The C of a scene, compiled and loaded."""

    def __init__(self, scene, folder, flags, **options):
        written = equations(scene, "c", **options)
        source = next(path for path in written.write(folder) if path.suffix == ".c")
        library = source.with_suffix(".so")
        words = ["cc", *flags, "-shared", "-fPIC", "-o", library, source, "-lm"]
        subprocess.run(words, check=True, timeout=60)
        self.library, self.name = ctypes.CDLL(str(library)), source.stem

    def __call__(self, output, shape, *arguments):
        result = np.empty(shape)
        given = [
            np.ascontiguousarray(argument, dtype=float)
            for argument in (*arguments, result)
        ]
        function = getattr(self.library, f"{self.name}_{output}")
        function.restype = None
        pointers = [
            one.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for one in given
        ]
        function(*pointers)
        return given[-1]


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.parametrize("name", slow_except(QUICK_IN_C, SCENES))
def test_c_has_the_bits_of_the_package(name, tmp_path):
    flags = FAST if name in ("friction", "loaded", "general") else STRICT
    compiled = Compiled(scene_of(name), tmp_path, flags)
    for state, drive, results in expected(name):
        for output, result in results.items():
            given = drive if output.startswith("derivative") else ()
            assert (compiled(output, result.shape, state, *given) == result).all(), (
                output
            )


def import_library(name):
    """Skip where a library is missing."""
    if name == "jax":
        with_double_precision()
    pytest.importorskip(name, reason=f"needs {name}: pip install .[test]")


def call(functions, output, state, drive):
    given = drive if output.startswith("derivative") else ()
    result = getattr(functions, output)(state, *given)
    return np.array(
        result.tolist() if hasattr(result, "tolist") else result, dtype=float
    )


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.parametrize("name", slow_except(QUICK, SCENES))
def test_a_library_of_python_has_the_values_of_the_package(name, library):
    import_library(library)
    functions = equations(scene_of(name), library)
    for state, drive, results in expected(name)[:2]:
        for output, result in results.items():
            found = call(functions, output, state, drive).reshape(result.shape)
            assert np.abs(found - result).max() <= CLOSE * np.abs(result).max(), output


@pytest.mark.parametrize("name", slow_except(["loaded"], ["general", "loaded"]))
def test_jacobians_are_those_of_casadi(name):
    """Derivatives by CasADi of the written derivative, against the written ones."""
    casadi = pytest.importorskip("casadi", reason="needs casadi: pip install .[test]")
    scene = scene_of(name)
    parameters = ["star.inertia.xx", "star.inertia.xy", "actuated_links.inertia.zz"]
    if name == "loaded":
        parameters += ["payload.mass", "friction.gamma.coulomb", "stroke.damping"]
        parameters += [
            "springs.stiffness",
            "actuators.time_constant",
            "gravity.acceleration",
        ]
    functions = equations(scene, "casadi", parameters=parameters)
    written = equations(scene, "numpy", parameters=parameters)
    values = np.array([*functions.parameters.values()])
    symbols = functions.derivative.sx_in()
    derivative = functions.derivative(*symbols)
    for state, drive in states(scene, 2):
        arguments = (state, *drive, values)
        for by, place in (("state", 0), ("torque", 1), ("parameters", -1)):
            truth = casadi.Function(
                "truth", symbols, [casadi.jacobian(derivative, symbols[place])]
            )
            found = getattr(written, f"derivative_by_{by}")(*arguments)
            given = np.array(truth(*arguments))
            assert np.abs(found - given).max() <= CLOSE * np.abs(given).max(), by


def test_parameters_are_the_numbers_of_another_scene():
    scene = loaded()
    values = {
        "star.inertia.zz": 0.31,
        "payload.mass": 0.9,
        "friction.beta.viscous": 0.07,
        "springs[0].rest": 0.5,
        "actuators.gear_ratio": 8.0,
        "stroke.stiffness": 1500.0,
    }
    functions = equations(scene, "numpy", parameters=[*values])
    assert [*functions.parameters] == [*values]
    other = Dynamics.of(scene.with_values(values))
    for state, drive in states(scene):
        found = functions.derivative(state, *drive, np.array([*values.values()]))
        truth = np.array(other.derivative(*state, *np.concatenate(drive)))
        assert np.abs(found - truth).max() <= CLOSE * np.abs(truth).max()
        own = functions.derivative(
            state, *drive, np.array([*functions.parameters.values()])
        )
        truth = np.array(Dynamics.of(scene).derivative(*state, *np.concatenate(drive)))
        assert np.abs(own - truth).max() <= CLOSE * np.abs(truth).max()


def test_a_vector_or_a_list_means_each_of_its_numbers():
    keys = equations(
        "gravity_payload", "c", parameters=["gravity.acceleration"]
    ).parameters
    assert [*keys] == [f"gravity.acceleration[{i}]" for i in range(3)]
    keys = equations(
        "example2", "c", parameters=["actuated_links.inertia.zz"]
    ).parameters
    assert [*keys] == [f"actuated_links[{k}].inertia.zz" for k in range(3)]


@pytest.mark.parametrize("library", slow_except(["numpy"], ["numpy", "jax"]))
def test_many_runs_are_further_axes(library):
    import_library(library)
    functions = equations("friction", library, parameters=["star.inertia.zz"])
    rows = [*states(load_scene("friction"), 4)]
    state = np.stack([state for state, _ in rows], axis=1)
    torque = np.stack([drive[0] for _, drive in rows], axis=1)
    inertia = np.linspace(0.2, 0.3, 4)[None]
    for output, shape in (("derivative", (7, 4)), ("derivative_by_state", (7, 7, 4))):
        whole = getattr(functions, output)(state, torque, inertia)
        assert whole.shape == shape
        for i in range(4):
            one = getattr(functions, output)(state[:, i], torque[:, i], inertia[:, i])
            assert np.abs(whole[..., i] - one).max() <= CLOSE * np.abs(one).max()


@pytest.mark.slow
def test_jax_maps_differentiates_and_keeps_single_precision():
    jax = with_double_precision()
    functions = equations("swing", "jax")
    ((state, (torque,)),) = states(load_scene("swing"), 1)
    mapped = jax.vmap(functions.derivative, (0, None))(np.stack([state, state]), torque)
    single = jax.jit(functions.derivative)(np.float32(state), np.float32(torque))
    assert single.dtype == np.float32 and mapped.dtype == np.float64
    assert np.abs(single - mapped[1]).max() < 1e-4 * np.abs(mapped[1]).max()

    def kinetic(state):
        return functions.energies(state)[0]

    slope = jax.grad(kinetic)(state)[4:]  # the momentum: W slope is twice the energy
    assert slope @ state[4:] == pytest.approx(2.0 * float(kinetic(state)), rel=1e-13)


def test_mpmath_has_more_digits():
    mpmath = pytest.importorskip("mpmath")
    functions = equations("example2", "mpmath")
    ((state, (torque,)),) = states(load_scene("example2"), 1)
    with mpmath.workdps(50):
        fine = functions.derivative(state, torque)
        slope = functions.joints(state)
        # Energy balance to all digits: the kinetic energy grows by the power of the
        # torques.
        power = sum(
            mpmath.mpf(t) * rate for t, rate in zip(torque, slope[9:12], strict=True)
        )
        h = mpmath.mpf(10) ** -20
        ends = [
            [x + sign * h * dx for x, dx in zip(state, fine, strict=True)]
            for sign in (-1, 1)
        ]
        before, after = (functions.energies(end)[0] for end in ends)
        rate = (after - before) / (2 * h)
        assert abs(rate - power) < mpmath.mpf(10) ** -14 * abs(power)
        assert mpmath.mp.dps == 50 and fine[4] != float(fine[4])


@pytest.mark.slow
def test_sympy_takes_symbols():
    """Of symbols the results are expressions: their values, and Euler's theorem."""
    sympy = pytest.importorskip("sympy", reason="needs sympy: pip install .[test]")
    functions = equations("example2", "sympy")
    ((state, (torque,)),) = states(load_scene("example2"), 1)
    numbers = [*state, *torque]
    y, t = sympy.symbols("y:7"), sympy.symbols("t:3")
    kinetic = functions.energies(y)[0]
    twice = sum(rate * kinetic.diff(rate) for rate in y[4:])
    found = sympy.lambdify((*y, *t), [kinetic, twice, *functions.derivative(y, t)])
    kinetic, twice, *derivative = found(*numbers)
    assert twice == pytest.approx(2.0 * kinetic, rel=1e-13)
    exact = Dynamics.of(load_scene("example2")).derivative(*numbers)
    assert derivative == pytest.approx(exact, rel=1e-11, abs=1e-12)


def test_a_casadi_function_names_what_it_takes():
    casadi = pytest.importorskip("casadi", reason="needs casadi: pip install .[test]")
    functions = equations("example2", "casadi", parameters=["star.inertia.zz"])
    function = functions.derivative
    assert isinstance(function, casadi.Function)
    assert function.name_in() == ["state", "torque", "parameters"]
    assert function.name_out() == ["derivative"]
    assert function.size_in(0) == (7, 1) and functions.joints.size_out(0) == (18, 1)


@pytest.mark.parametrize("target", TARGETS)
def test_every_target_names_scene_and_hash(target):
    written = equations("example2", target)
    content = next(iter(written.files.values()))
    if target == "mjcf":
        assert "scene example2" in content
    elif target != "fmu":
        from sst_ros.code_generation.named_programs import SceneEquations

        described = SceneEquations(load_scene("example2"), (), ())
        assert described.scene_hash in content and "body rate W_x" in content
        assert (
            described.scene_hash
            != SceneEquations(load_scene("friction"), (), ()).scene_hash
        )
    assert written.target == target and target in repr(written)


@pytest.mark.parametrize(
    ("target", "options", "words"),
    [
        ("java", {}, "target = 'java': must be one of c, numpy"),
        ("c", {"outputs": ["joint"]}, "did you mean 'joints'"),
        ("c", {"outputs": ["derivative_by_parameters"]}, "must be one of"),
        ("fmu", {"outputs": ["joints"]}, "fixed for fmu"),
        ("mjcf", {"parameters": ["star.mass"]}, "not for mjcf"),
        ("c", {"parameters": ["star.alpha_deg"]}, "geometry"),
        ("c", {"parameters": ["star.colour"]}, "must be the key of a number"),
        ("c", {"parameters": ["initial.gamma[0]"]}, "initial state"),
        ("c", {"parameters": ["star.mass", "star.mass"]}, "named once"),
        ("c", {"parameters": ["duration"]}, "no number of the equations"),
    ],
)
def test_what_is_refused(target, options, words):
    with pytest.raises(InputError, match=words):
        equations("example2", target, **options)


def test_numbers_that_no_equation_has_are_refused():
    limited = load_scene("example2").with_values({"actuators": {"velocity_limit": 2.0}})
    with pytest.raises(InputError, match="no number of the equations"):
        equations(limited, "c", parameters=["actuators.velocity_limit"])
    bouncing = load_scene("impacts")
    assert bouncing.stroke.restitution is not None
    with pytest.raises(InputError, match="through the damping of the stops"):
        equations(bouncing, "c", parameters=["stroke.restitution"])


def test_the_command_writes_and_does_not_overwrite(tmp_path, capsys):
    folder = tmp_path / "out"
    words = ["equations", "swing", "--target", "jax", "--out", str(folder)]
    assert main([*words, "--outputs", "joints"]) == 0
    (path,) = folder.iterdir()
    assert capsys.readouterr().out.strip() == str(path) == str(folder / "swing_jax.py")
    assert (
        "def joints(state):" in path.read_text()
        and "def energies" not in path.read_text()
    )
    before = path.read_bytes()
    assert main(words) == 1
    assert "exists already" in capsys.readouterr().err and path.read_bytes() == before
    assert main([*words, "--force"]) == 0
    assert "def energies(state):" in path.read_text()
    with pytest.raises(InputError, match="exists already"):
        equations("swing", "jax").write(folder)


def test_a_written_module_needs_its_library_alone(tmp_path):
    (_path,) = equations("swing", "numpy").write(tmp_path)
    program = (
        "import sys, swing_numpy as m; "
        "print(m.energies(m.INITIAL_STATE).sum(), 'sst_ros' in sys.modules)"
    )
    words = [sys.executable, "-c", program]
    done = subprocess.run(
        words, cwd=tmp_path, capture_output=True, text=True, check=True
    )
    total, imported = done.stdout.split()
    dynamics = Dynamics.of(load_scene("swing"))
    start = equations("swing", "c").initial_state
    assert float(total) == pytest.approx(dynamics.total_energy(start), rel=1e-14)
    assert imported == "False"


@pytest.mark.parametrize("library", ["casadi", "jax", "mpmath", "sympy"])
def test_a_library_that_is_missing_names_its_extra(library, monkeypatch):
    written = equations("swing", library)  # needs none
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(MissingDependency, match=rf"sst_ros\[{EXTRAS[library]}\]"):
        _ = written.derivative
    with pytest.raises(AttributeError, match="have no 'nothing'"):
        _ = written.nothing


def test_the_function_is_a_public_name():
    assert sst_ros.equations is equations and callable(sst_ros.equations)
