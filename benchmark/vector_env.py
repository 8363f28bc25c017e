# SPDX-License-Identifier: Apache-2.0
"""Vector steps a second of many robots, beside MuJoCo's of the same mechanism.

python -m benchmark.vector_env [--rounds 5] [--no-page]

A vector step advances all robots by a period of 2 ms under torques of their own. MuJoCo
has the MJCF of `equations`, in gymnasium's vector environment and by its own `rollout`.
The error is the largest of actuator angles after 0.2 s, against `simulate`. Times are
of the processor, those of all threads together, so that other load counts less.
"""

from __future__ import annotations

import os
import runpy
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import gymnasium
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.vector import SyncVectorEnv
from mujoco import rollout

from benchmark.measure import (
    DOCS,
    describe_machine,
    fill_page,
    join_line,
    read_options,
    time_in_turn,
)
from sst_ros import Batch, Scene, equations, load_scene, simulate
from sst_ros.report.results import data_frame, markdown

EXAMPLE = runpy.run_path(str(DOCS.parent / "examples" / "vector_env.py"))
HOME, SPREAD, PERIOD, LONGEST = (
    EXAMPLE[name] for name in ("HOME", "SPREAD", "PERIOD", "LONGEST")
)
"""Start and its spread [rad], length of a step [s], steps of an episode."""

SIZES = (1, 64, 4096)

PERIODS = 100
"""Of the motion whose end is compared with `simulate`."""

COMPARED = 4
"""Robots whose end is compared."""

TORQUES = 2.0
"""Torques are random and constant, up to this one [N m]."""

SCENES: dict[str, dict[str, Any]] = {
    "reach, without dry friction": {"torque": None, "friction.gamma": {"viscous": 0.2}},
    "reach": {"torque": None},
}
"""MuJoCo's dry friction is of another kind: its error counts without it alone."""

JOINTS = ("gamma_1", "gamma_2", "gamma_3")


class Robots(NamedTuple):
    """Robots at the start of the scene.

    Attributes:
        step: advance all by a period; takes torques [N m], shape (N, 3).
        angles: return the actuator angles [rad], shape (N, 3); None where they started
            at random.
        close: end what was started.

    """

    step: Callable[[np.ndarray], Any]
    angles: Callable[[], np.ndarray] | None = None
    close: Callable[[], None] = lambda: None


def start_session(scene: Scene, number: int) -> Robots:
    """Start a session of a batch."""
    session = Batch(scene).start(np.tile(HOME, (number, 1)), step=PERIOD)
    return Robots(session.step, lambda: session.state.gamma)


def start_environment(scene: Scene, number: int) -> Robots:
    """Start the environment of `examples/vector_env.py`."""
    robots = EXAMPLE["StarTriangles"](number, scene)
    robots.reset(seed=1)
    return Robots(lambda torques: robots.step(torques / EXAMPLE["LARGEST_TORQUE"]))


class MujocoRobot(MujocoEnv):
    """One robot by MuJoCo, with the task of `StarTriangles`."""

    metadata = {  # noqa: RUF012  # gymnasium wants it so
        "render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"],
        "render_fps": round(1.0 / PERIOD),
    }

    def __init__(self, path: str, model: mujoco.MjModel) -> None:
        self._shared = model
        space = gymnasium.spaces.Box(-np.inf, np.inf, (9,), np.float64)
        super().__init__(path, frame_skip=1, observation_space=space)
        self._places = [model.joint(name).qposadr[0] for name in JOINTS]
        self._desired, self._count = HOME, 0

    def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        return self._shared, mujoco.MjData(self._shared)

    def reset_model(self) -> np.ndarray:
        """Start at the key `initial`, with new desired angles."""
        mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        self._desired = HOME + self.np_random.uniform(-SPREAD, SPREAD, 3)
        self._count = 0
        return self._observe()

    def step(self, action: np.ndarray) -> tuple[Any, ...]:
        """Apply torques for a period."""
        self.do_simulation(action, self.frame_skip)
        self._count += 1
        observed = self._observe()
        reward = -float(np.square(observed[:3] - observed[6:]).sum())
        return observed, reward, False, self._count >= LONGEST, {}

    def _observe(self) -> np.ndarray:
        places = self._places
        return np.concatenate(
            [self.data.qpos[places], self.data.qvel[places], self._desired]
        )


def write_model(
    scene: Scene, folder: Path, integrator: str
) -> tuple[str, mujoco.MjModel]:
    """Write the MJCF of a scene; return its path and the model at our period."""
    (path,) = equations(scene, "mjcf").write(folder / integrator)
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.timestep = PERIOD
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
    return str(path), model


def start_gymnasium(integrator: str) -> Callable[[Scene, int], Robots]:
    """Return what starts MuJoCo's robots in a vector environment of gymnasium."""

    def start(scene: Scene, number: int) -> Robots:
        folder = tempfile.TemporaryDirectory()
        path, model = write_model(scene, Path(folder.name), integrator)
        robots = SyncVectorEnv([lambda: MujocoRobot(path, model)] * number)
        observed, _ = robots.reset(seed=1)
        last = [observed]

        def step(torques: np.ndarray) -> None:
            last[0] = robots.step(torques.astype(np.float32))[0]

        def close() -> None:
            robots.close()
            folder.cleanup()

        return Robots(step, lambda: last[0][:, :3], close)

    return start


def start_rollout(integrator: str) -> Callable[[Scene, int], Robots]:
    """Return what starts MuJoCo's own robots in threads."""

    def start(scene: Scene, number: int) -> Robots:
        with tempfile.TemporaryDirectory() as folder:
            _, model = write_model(scene, Path(folder), integrator)
        cores = len(os.sched_getaffinity(0))
        threads = [mujoco.MjData(model) for _ in range(cores)]
        mujoco.mj_resetDataKeyframe(model, threads[0], 0)
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        first = np.zeros(mujoco.mj_stateSize(model, kind))
        mujoco.mj_getState(model, threads[0], first, kind)
        states = np.tile(first, (number, 1))
        after, sensors = np.empty((number, 1, len(first))), np.empty((number, 1, 0))
        pool = rollout.Rollout(nthread=cores if number > 1 else 0)
        own = threads if number > 1 else threads[:1]
        places = [
            1 + model.joint(name).qposadr[0] for name in JOINTS
        ]  # behind the time

        def step(torques: np.ndarray) -> None:
            pool.rollout(
                model,
                own,
                states,
                torques[:, None],
                nstep=1,
                state=after,
                sensordata=sensors,
            )
            states[:] = after[:, 0]

        return Robots(step, lambda: states[:, places], pool.close)

    return start


CONTENDERS: dict[str, Callable[[Scene, int], Robots]] = {
    "sst_ros, `Batch.start`": start_session,
    "sst_ros, `examples/vector_env.py`": start_environment,
    "MuJoCo RK4, `rollout` in threads": start_rollout("RK4"),
    "MuJoCo implicitfast, `rollout` in threads": start_rollout("IMPLICITFAST"),
    "MuJoCo RK4, `SyncVectorEnv`": start_gymnasium("RK4"),
    "MuJoCo implicitfast, `SyncVectorEnv`": start_gymnasium("IMPLICITFAST"),
}


def find_error(
    robots: Robots, torques: np.ndarray, expected: np.ndarray
) -> float | None:
    """Return the largest error of an actuator angle after PERIODS [rad]."""
    if robots.angles is None:
        return None
    for _ in range(PERIODS):
        robots.step(torques)
    compared = robots.angles()[:COMPARED]
    return float(np.abs(compared - expected[: len(compared)]).max())


def measure(scene: Scene, rounds: int) -> list[dict[str, str]]:
    """Return the rows of the table of a scene."""
    rng = np.random.default_rng(1)
    whole = rng.uniform(-TORQUES, TORQUES, (max(SIZES), 3))
    ends = [
        simulate(scene, tuple(row), PERIODS * PERIOD).gamma[-1]
        for row in whole[:COMPARED]
    ]
    rows = {name: {"": name} for name in CONTENDERS}
    errors: dict[str, float] = {}
    for number in SIZES:
        torques = whole[:number]
        started = {}
        for name, start in CONTENDERS.items():
            started[name] = start(scene, number)
            error = find_error(started[name], torques, np.array(ends))
            if error is not None:
                errors[name] = max(errors.get(name, 0.0), error)
        calls: dict[str, Callable[[], Any]] = {
            name: partial(robots.step, torques) for name, robots in started.items()
        }
        taken = time_in_turn(calls, rounds, shortest=0.05, clock=time.process_time)
        for name, row in rows.items():
            row[f"{number:,} {'robot' if number == 1 else 'robots'}"] = (
                f"{1.0 / median(taken[name]):,.0f}"
            )
        for robots in started.values():
            robots.close()
    for name, row in rows.items():
        row["error [rad]"] = f"{errors[name]:.0e}" if name in errors else "as above"
    return list(rows.values())


def main(arguments: list[str] | None = None) -> int:
    """Measure and print; fill the page."""
    options = read_options("vector_env", __doc__, arguments, rounds=5, no_page=False)
    reach = load_scene("reach")
    parts = []
    for title, changes in SCENES.items():
        table = measure(reach.with_values(changes), options.rounds)
        parts.append(f"Scene {title}:\n\n{markdown(data_frame(table))}")
    machine = describe_machine("numpy", "llvmlite", "mujoco", "gymnasium")
    parts.append(f"{join_line(machine)}.")
    text = "\n\n".join(parts)
    print(text)
    if not options.no_page:
        fill_page(DOCS / "howto" / "batch.md", {"vector steps": text})
    return 0


if __name__ == "__main__":
    sys.exit(main())
