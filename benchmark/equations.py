# SPDX-License-Identifier: Apache-2.0
"""The equations of the shipped scenes in other programs: values, motions, times, sizes.

python -m benchmark.equations [--no-page]

Values are compared with those of the package at random states, motions under constant
torques with `simulate`. Sizes are those of the machine code in the object file; those
for a Cortex-M7 need `arm-none-eabi-gcc` (Debian: gcc-arm-none-eabi).
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from benchmark.measure import (
    DOCS,
    describe_machine,
    fill_page,
    join_line,
    read_options,
    time_in_turn,
)
from sst_ros import Scene, equations, load_scene, simulate
from sst_ros.code_generation.equations import Equations
from sst_ros.dynamics import kernel
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.report.results import data_frame, markdown
from sst_ros.scene.loads import JOINTS
from sst_ros.scene.scene import names

LIBRARIES = {
    "jax": "JAX",
    "casadi": "CasADi",
    "numpy": "NumPy",
    "mpmath": "mpmath",
    "sympy": "SymPy",
}
QUICK = ("jax", "casadi")
"""Those whose derivative is integrated."""

TIMED = ("example2", "friction", "general", "gravity_payload")
"""Scenes whose times and sizes are shown: no loads, friction, all inertias, weight."""

TORQUE = (0.4, -0.2, 0.3)  # [N m]
DURATION = 0.05
"""Of the motions that are compared [s]."""

STATES = 3
"""Random states a scene; of SymPy, which is slow, one."""

LANES = 4096
"""Runs at once of the function for JAX."""

HARD = ("-std=c99", "-O2", "-Wall", "-Wextra", "-pedantic", "-Werror")
CORTEX_M7 = ("-mcpu=cortex-m7", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv5-d16")
LOOP = """
#include "{name}.h"
double repeat(long count, double *state, double *torque, double *result) {{
    for (long i = 0; i < count; i++) {{
        {name}_{output}(state, torque, result);
        state[0] += 1e-18 * result[0];
    }}
    return result[0];
}}
"""
"""Calls one after the other, each of which waits for the one before."""


class Package:
    """What the package itself has for a scene.

    Attributes:
        state: at t = 0.
        drive: what acts from outside, by argument.

    """

    def __init__(self, scene: Scene) -> None:
        self.dynamics = Dynamics.of(scene)
        self.ode = ODE(self.dynamics)
        self.state = np.array(
            equations(scene, "numpy", outputs=["joints"]).initial_state
        )
        self.drive = [np.array(TORQUE)]
        if self.dynamics.has_moment_topic:
            self.drive.append(np.array([0.1, -0.1, 0.2]))

    def states(self) -> Iterator[np.ndarray]:
        """Yield random states near the start."""
        rng = np.random.default_rng(2)
        for _ in range(STATES):
            yield self.state + rng.uniform(-0.1, 0.1, len(self.state))

    def values(self, state: np.ndarray) -> dict[str, np.ndarray]:
        """Return the results of all functions at a state."""
        size = len(state)
        inputs = [*state.tolist(), *np.concatenate(self.drive).tolist()]
        by_state = np.array(self.ode.linearised(0.0, *inputs)[2 * size :])
        by_torque = np.array(self.ode.linearised_by_torque(0.0, *inputs)[-3 * size :])
        return {
            "derivative": np.array(self.dynamics.derivative(*inputs)),
            "joints": np.array(self.dynamics.joints(*inputs[:7])),
            "energies": np.array(self.dynamics.energies(*inputs[:size])),
            "derivative_by_state": by_state.reshape(size, size).T,
            "derivative_by_torque": by_torque.reshape(3, size).T,
        }


class Compiled:
    """The C of a scene as functions of arrays, by the C compiler cc."""

    def __init__(self, written: Equations, folder: Path, *more: str) -> None:
        written.write(folder, force=True)
        self.source = next(folder.glob("*.c"))
        self.name = self.source.stem
        library = folder / f"{self.name}.so"
        words = ["cc", *HARD, *more, "-shared", "-fPIC", "-o", str(library)]
        subprocess.run([*words, str(self.source), "-lm"], check=True)
        self.library = ctypes.CDLL(str(library))

    def __call__(
        self, output: str, shape: tuple[int, ...], *arguments: Any
    ) -> np.ndarray:
        result = np.empty(shape)
        arrays = [*(np.ascontiguousarray(x, dtype=float) for x in arguments), result]
        function = getattr(self.library, f"{self.name}_{output}")
        function.restype = None
        function(*(ctypes.c_void_p(array.ctypes.data) for array in arrays))
        return result


def find_difference(
    package: Package,
    call: Callable[[str, np.ndarray, list[np.ndarray]], Any],
    states: int,
) -> float:
    """Return the largest difference to the package, over a result's largest number."""
    worst = 0.0
    for state in [*package.states()][:states]:
        for output, expected in package.values(state).items():
            drive = package.drive if output.startswith("derivative") else []
            result = call(output, state, drive)
            result = result.tolist() if hasattr(result, "tolist") else result
            differences = np.array(result, dtype=float).reshape(expected.shape)
            worst = max(
                worst, np.abs(differences - expected).max() / np.abs(expected).max()
            )
    return worst


def find_motion_error(
    scene: Scene, package: Package, slope: Callable[[np.ndarray], Any]
) -> float:
    """Integrate a derivative; return the largest error of an actuator angle [rad]."""

    def derivative(t: float, state: np.ndarray) -> np.ndarray:
        return np.array(slope(state), dtype=float).ravel()

    span = (0.0, DURATION)
    run = solve_ivp(derivative, span, package.state, "DOP853", rtol=1e-13, atol=1e-14)
    gamma = package.dynamics.joints(*run.y[:7, -1])[:3]
    return float(np.abs(gamma - end_of(scene)).max())


def end_of(scene: Scene) -> np.ndarray:
    """Return the actuator angles at the end by `simulate` [rad]."""
    motion = simulate(scene, TORQUE, DURATION, tolerance=1e-13)
    assert motion.success, motion.message
    return np.asarray(motion.gamma[-1])


def compare_unit(scene: Scene, folder: Path) -> tuple[int, float]:
    """Return what fmpy finds wrong in a unit, and its largest angle error [rad]."""
    from fmpy import simulate_fmu
    from fmpy.validation import validate_fmu

    (path,) = equations(scene, "fmu").write(folder)
    start = {f"torque_{leg}": x for leg, x in zip((1, 2, 3), TORQUE, strict=True)}
    run = simulate_fmu(
        str(path),
        fmi_type="CoSimulation",
        stop_time=DURATION,
        output_interval=0.1 * DURATION,
        relative_tolerance=1e-14,
        start_values=start,
        output=[*JOINTS[:3]],
    )
    gamma = np.array([run[name][-1] for name in JOINTS[:3]])
    return len(validate_fmu(str(path))), float(np.abs(gamma - end_of(scene)).max())


def compare_mujoco(scene: Scene) -> float:
    """Return the largest difference of an actuator's acceleration in the MJCF.

    Relative to the largest one. MuJoCo's dry friction is of another kind and is viscous
    here. The mobility of the ties is set, see the page.
    """
    import mujoco

    for kind in ("gamma", "mu", "beta"):
        if getattr(scene.friction, kind, None) is not None:
            scene = scene.with_values({f"friction.{kind}": {"viscous": 0.3}})
    (text,) = equations(scene, "mjcf").files.values()
    model = mujoco.MjModel.from_xml_string(text)
    model.body_invweight0[:] = 1e-3
    data, dynamics = mujoco.MjData(model), Dynamics.of(scene)
    state = np.array(equations(scene, "numpy", outputs=["joints"]).initial_state)
    state[4:7] = (0.3, -0.5, 0.4)
    state[7:] = TORQUE[: len(state[7:])]
    joints = dynamics.joints(*state[:7])
    for name, angle, rate in zip(JOINTS, joints[:9], joints[9:], strict=True):
        data.qpos[model.joint(name).qposadr[0]] = angle
        data.qvel[model.joint(name).dofadr[0]] = rate
    data.ctrl[:] = TORQUE
    data.act[:] = TORQUE[: model.na]
    mujoco.mj_forward(model, data)
    found = [data.qacc[model.joint(name).dofadr[0]] for name in JOINTS[:3]]
    drive = [*TORQUE, *(0.0 for _ in dynamics.drive[3:])]
    slope = dynamics.derivative(*state, *drive)
    expected = kernel.actuator_acceleration(
        dynamics.model, state.tolist(), (slope[4], slope[5], slope[6])
    )
    return float(np.abs(np.subtract(found, expected)).max() / np.abs(expected).max())


def compare(name: str) -> dict[str, str]:
    """Return a row of the table of values."""
    scene = load_scene(name)
    package, row = Package(scene), {"scene": f"`{name}`"}

    def note(target: str, difference: float, motion: float | None = None) -> None:
        cell = "0" if difference == 0.0 else f"{difference:.0e}"
        row[target] = cell if motion is None else f"{cell}; {motion:.0e} rad"

    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        compiled = Compiled(equations(scene, "c"), folder)

        def call(output: str, state: np.ndarray, drive: list[np.ndarray]) -> np.ndarray:
            return compiled(output, package.values(state)[output].shape, state, *drive)

        def slope(state: np.ndarray) -> np.ndarray:
            return compiled("derivative", state.shape, state, *package.drive)

        difference = find_difference(package, call, STATES)
        note("C", difference, find_motion_error(scene, package, slope))
        for library, title in LIBRARIES.items():
            note(title, *compare_library(scene, package, library))
        problems, motion = compare_unit(scene, folder / "unit")
        row["FMU"] = f"{motion:.0e} rad" + (f", {problems} faults" if problems else "")
    row["MJCF"] = f"{compare_mujoco(scene):.0e}"
    return row


def compare_library(
    scene: Scene, package: Package, library: str
) -> tuple[float, float | None]:
    """Return the difference of values, and the error of the motion if it is quick."""
    written = equations(scene, library)

    def call(output: str, state: np.ndarray, drive: list[np.ndarray]) -> Any:
        return getattr(written, output)(state, *drive)

    difference = find_difference(package, call, 1 if library == "sympy" else STATES)
    if library not in QUICK:
        return difference, None
    derivative = written.derivative
    if library == "jax":
        import jax

        derivative = jax.jit(derivative)

    def slope(state: np.ndarray) -> Any:
        return derivative(state, *package.drive)

    return difference, find_motion_error(scene, package, slope)


def measure_times(name: str) -> dict[str, str]:
    """Return a row of the table of times."""
    import jax

    scene = load_scene(name)
    package, row = Package(scene), {"scene": f"`{name}`"}
    state, torque = package.state, np.array(TORQUE)
    written = {
        library: equations(scene, library) for library in ("jax", "casadi", "numpy")
    }
    calls: dict[str, Callable[[], Any]] = {}
    count = 20_000
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        begin = time.perf_counter()
        source = equations(scene, "c", outputs=["derivative", "derivative_by_state"])
        writing = time.perf_counter() - begin
        begin = time.perf_counter()
        compiled = Compiled(source, folder)
        compiling = time.perf_counter() - begin
        row["C: write; compile"] = f"{writing:.2g} s; {compiling:.2g} s"
        for output in source.outputs:
            calls[output] = repeat_in_c(compiled, folder, output, state, torque, count)
        function = jax.jit(written["jax"].derivative)
        begin = time.perf_counter()
        function(state, torque).block_until_ready()
        tracing = time.perf_counter() - begin
        many = [jax.numpy.tile(x[:, None], LANES) for x in (state, torque)]
        one = jax.numpy.array(state), jax.numpy.array(torque)
        casadi, columns = written["casadi"].derivative, written["numpy"].derivative
        calls["jax"] = lambda: function(*one).block_until_ready()
        calls["many"] = lambda: function(*many).block_until_ready()
        calls["casadi"] = lambda: casadi(state, torque)
        calls["numpy"] = lambda: columns(state, torque)
        taken = time_in_turn(calls, 9, clock=time.process_time)
    seconds = {call: median(rounds) for call, rounds in taken.items()}
    row["C, a call"] = f"{1e9 * seconds['derivative'] / count:.0f} ns"
    row["its Jacobian"] = f"{1e6 * seconds['derivative_by_state'] / count:.2g} us"
    row["JAX: compile; a call; of 4,096 runs, each"] = (
        f"{tracing:.2g} s; {1e6 * seconds['jax']:.0f} us;"
        f" {1e9 * seconds['many'] / LANES:.0f} ns"
    )
    row["CasADi, a call"] = f"{1e6 * seconds['casadi']:.0f} us"
    row["NumPy, a call"] = f"{1e6 * seconds['numpy']:.0f} us"
    return row


def repeat_in_c(
    compiled: Compiled,
    folder: Path,
    output: str,
    state: np.ndarray,
    torque: np.ndarray,
    count: int,
) -> Callable[[], Any]:
    """Return a call of a loop in C over a function."""
    loop, library = folder / f"loop_{output}.c", folder / f"loop_{output}.so"
    loop.write_text(LOOP.format(name=compiled.name, output=output))
    words = ["cc", *HARD, "-shared", "-fPIC", "-o", str(library)]
    subprocess.run([*words, str(compiled.source), str(loop), "-lm"], check=True)
    repeat = ctypes.CDLL(str(library)).repeat
    repeat.restype = ctypes.c_double
    arrays = [state.copy(), torque.copy(), np.empty(len(state) ** 2)]
    pointers = [ctypes.c_void_p(array.ctypes.data) for array in arrays]

    def call(_arrays: Any = arrays) -> Any:
        return repeat(ctypes.c_long(count), *pointers)

    return call


def measure_sizes(name: str) -> dict[str, str]:
    """Return a row of the table of sizes."""
    row = {"scene": f"`{name}`"}
    machines = {
        "x86-64": ("cc", "size", ()),
        "Cortex-M7": ("arm-none-eabi-gcc", "arm-none-eabi-size", CORTEX_M7),
    }
    choices = {"derivative alone": ["derivative"], "all functions": None}
    for said, outputs in choices.items():
        for machine, (compiler, size, flags) in machines.items():
            if shutil.which(compiler) is None:
                row[f"{said}, {machine}"] = "-"
                continue
            with tempfile.TemporaryDirectory() as place:
                paths = equations(load_scene(name), "c", outputs=outputs).write(place)
                source = next(path for path in paths if path.suffix == ".c")
                made = str(source.with_suffix(".o"))
                words = [compiler, "-std=c99", "-Os", *flags, "-c", "-o", made]
                subprocess.run([*words, str(source)], check=True)
                process = subprocess.run(
                    [size, made], check=True, capture_output=True, text=True
                )
            text, data = map(int, process.stdout.splitlines()[1].split()[:2])
            row[f"{said}, {machine}"] = f"{(text + data) / 1000:.1f} kB"
    return row


def main(arguments: list[str] | None = None) -> int:
    """Measure and print; fill the page."""
    import jax

    options = read_options("equations", __doc__, arguments, no_page=False)
    jax.config.update("jax_enable_x64", True)
    values = [compare(name) for name in names()]
    times = [measure_times(name) for name in TIMED]
    sizes = [measure_sizes(name) for name in TIMED]
    packages = ("numpy", "jax", "casadi", "fmpy", "mujoco", "mpmath", "sympy")
    parts = {
        "equation values": markdown(data_frame(values)),
        "equation times": markdown(data_frame(times)),
        "equation sizes": markdown(data_frame(sizes)),
        "equation run": f"{join_line(describe_machine(*packages))}. {compilers()}.",
    }
    print("\n\n".join(parts.values()))
    if not options.no_page:
        fill_page(DOCS / "howto" / "equations.md", parts)
    return 0


def compilers() -> str:
    """Return the first line of what each C compiler says of itself."""
    lines = []
    for compiler in ("cc", "arm-none-eabi-gcc"):
        if shutil.which(compiler):
            words = [compiler, "--version"]
            process = subprocess.run(words, check=True, capture_output=True, text=True)
            lines.append(process.stdout.splitlines()[0])
    return "; ".join(lines)


if __name__ == "__main__":
    sys.exit(main())
