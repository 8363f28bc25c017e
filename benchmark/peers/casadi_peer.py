# SPDX-License-Identifier: Apache-2.0
"""CasADi: the same equations in minimal coordinates, compiled, by two integrators.

The function is `equations(scene, "casadi")` with the torques of the task. CVODES of
SUNDIALS (Adams methods, functional iteration, so no Jacobian) has it as CasADi's C, and
a Runge-Kutta loop in C calls the same C. Nothing of Python runs in either.
"""

from __future__ import annotations

import ctypes
import os
import tempfile
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmark import c_floor
from benchmark.peers.study import Engine, Failed, Series, Setting, list_steps
from benchmark.peers.task import DURATION, Moving, Pose, Task
from sst_ros import equations
from sst_ros.dynamics import kernel
from sst_ros.integration.methods import DOP853

ENGINE, PACKAGE = "CasADi", "casadi"
FLAGS = ("-O3", "-march=native", "-ffp-contract=off")
LOOP = """
static const double a[{stages}][{stages}] = {{{a}}};
static const double b[{stages}] = {{{b}}};
static const double c[{stages}] = {{{c}}};

void march(long count, double h, double *y) {{
    double slopes[{stages}][7], at[7], t, w[slope_SZ_W + 1];
    const double *arg[slope_SZ_ARG + 2] = {{&t, at}};
    double *res[slope_SZ_RES + 1];
    casadi_int iw[slope_SZ_IW + 1];
    for (long step = 0; step < count; step++) {{
        for (int i = 0; i < {stages}; i++) {{
            for (int j = 0; j < 7; j++) {{
                at[j] = y[j];
                for (int k = 0; k < i; k++) at[j] += h * a[i][k] * slopes[k][j];
            }}
            t = step * h + h * c[i];
            res[0] = slopes[i];
            slope(arg, res, iw, w, 0);
        }}
        for (int j = 0; j < 7; j++)
            for (int i = 0; i < {stages}; i++) y[j] += h * b[i] * slopes[i][j];
    }}
}}
"""


def series(task: Task, quick: bool) -> list[Series]:
    """CVODES by tolerance, DOP853 by steps."""
    model = Model(task)
    powers = np.arange(3.0, 13.1, 1.0 if quick else 0.5)
    tolerances = [
        Setting(
            f"reltol = abstol = {tolerance:.1e}", 0, partial(_Cvodes, model, tolerance)
        )
        for tolerance in (10.0**-powers).tolist()
    ]
    found = [
        Series(
            ENGINE, "CVODES, Adams", "nowhere", 1e-12, model.acceleration, tolerances
        )
    ]
    if c_floor.has_gcc():
        steps = list_steps(5, 80, 1.6 if quick else 1.15, partial(_Steps, model))
        found.append(
            Series(ENGINE, "DOP853 in C", "nowhere", 1e-12, model.acceleration, steps)
        )
    return found


class Model:
    """The slope of the state at a time, as a function of CasADi and as C.

    Attributes:
        folder: where the C lies while the object lives.

    """

    def __init__(self, task: Task) -> None:
        import casadi

        self.casadi: Any = casadi
        self.task = task
        self.derivative = equations(
            task.scene, "casadi", outputs=["derivative"]
        ).derivative
        self.t, self.y = casadi.SX.sym("t"), casadi.SX.sym("y", 7)
        waves = [a * casadi.sin(f * self.t + p) for a, f, p in task.sines()]
        self.slope = self.derivative(self.y, casadi.vertcat(*waves))
        self.folder = tempfile.TemporaryDirectory()

    def acceleration(self, at: Moving) -> np.ndarray:
        slope = self.derivative(at.y, at.torque).full().ravel()
        rate = (slope[4], slope[5], slope[6])
        return np.array(
            kernel.actuator_acceleration(self.task.dynamics.model, at.y, rate)
        )

    def pose(self, y: np.ndarray) -> Pose:
        if not np.all(np.isfinite(y)):
            raise Failed("not finite")
        y = y.copy()
        y[:4] /= np.linalg.norm(y[:4])
        return self.task.pose_of(y.tolist())

    @cached_property
    def library(self) -> Any:
        """The loop in C with CasADi's C of the slope, compiled."""
        casadi, folder = self.casadi, Path(self.folder.name)
        function = casadi.Function("slope", [self.t, self.y], [self.slope])
        options = {"with_header": False, "casadi_int": "long long int"}
        generator = casadi.CodeGenerator("slope.c", options)
        generator.add(function)
        text = generator.dump()
        for name in ("ARG", "RES", "IW", "W"):
            size = getattr(function, f"sz_{name.lower()}")()
            text += f"\n#define slope_SZ_{name} {size}"
        stages = len(DOP853.c)
        rows = [[*row, *(0.0,) * (stages - len(row))] for row in DOP853.a]
        text += LOOP.format(
            stages=stages,
            a=", ".join(f"{{{_numbers(row)}}}" for row in rows),
            b=_numbers(DOP853.b),
            c=_numbers(DOP853.c),
        )
        library, _ = c_floor.compile_c(text, folder, "march", *FLAGS)
        library.march.argtypes = [ctypes.c_long, ctypes.c_double, ctypes.c_void_p]
        library.march.restype = None
        return library


def _numbers(values: Any) -> str:
    return ", ".join(repr(float(value)) for value in values)


class _Cvodes(Engine):
    """CasADi's interface to CVODES, whose functions are compiled."""

    def __init__(self, model: Model, tolerance: float) -> None:
        self._model = model
        problem = {"x": model.y, "t": model.t, "ode": model.slope}
        options = {
            "abstol": tolerance,
            "reltol": tolerance,
            "linear_multistep_method": "adams",
            "nonlinear_solver_iteration": "functional",
            "max_num_steps": 1_000_000,
        }
        if c_floor.has_gcc():
            options |= {
                "jit": True,
                "compiler": "shell",
                "jit_options": {"flags": [*FLAGS]},
            }
        place = Path.cwd()
        os.chdir(model.folder.name)  # CasADi leaves its C where it is
        try:
            self._integrator = model.casadi.integrator(
                "motion", "cvodes", problem, 0.0, DURATION, options
            )
        finally:
            os.chdir(place)

    def run(self) -> Any:
        return self._integrator(x0=self._model.task.start)

    def pose(self, end: Any) -> Pose:
        return self._model.pose(end["xf"].full().ravel())


class _Steps(Engine):
    """Fixed steps of DOP853 in C."""

    def __init__(self, model: Model, steps: int) -> None:
        self._model, self._steps = model, steps
        self._march = model.library.march
        self._y = np.zeros(7)

    def run(self) -> np.ndarray:
        self._y[:] = self._model.task.start
        self._march(self._steps, DURATION / self._steps, self._y.ctypes.data)
        return self._y

    def pose(self, end: np.ndarray) -> Pose:
        return self._model.pose(end)
