# SPDX-License-Identifier: Apache-2.0
"""Bits of motions, before and after a change of the code that should change none.

`python -m benchmark.motions FILE` writes a line a motion: what it is, and a hash of its
numbers: shipped scenes by all methods, steps, a batch, a sweep, a lockstep run through
the nodes and the evaluation of its recording. `diff` shows what changed.
"""

import hashlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sst_ros import Batch, Simulation, load_scene, read_bag, simulate, sweep
from sst_ros.errors import SstError

SCENES = sorted(path.stem for path in Path("config/scenes").glob("*.yaml"))
METHODS = ("auto", "dopri5", "dop853", "rk4", "rodas5p")
DURATION = 0.25
STEPS = 50
MEASURED = (
    *("_us", "_age_", "bag", "commands_followed", "commands_recorded", "idle_states"),
    *("command_stamp", "report.", "wall_time", "factor", "missed"),
)
"""Parts of names in a report whose values differ from run to run."""


def digest(*arrays: Any) -> str:
    """Hash the bytes of arrays of numbers."""
    found = hashlib.sha256()
    for array in arrays:
        found.update(np.ascontiguousarray(array, dtype=float).tobytes())
    return found.hexdigest()[:16]


def simulated(name: str, method: str) -> str:
    """Simulate a shipped scene, with and without times of the samples."""
    even = np.linspace(0.0, DURATION, 26)
    motions: list[Any] = []
    for times in (None, even):
        motion = simulate(
            name, duration=DURATION, t_eval=times, method=method, tolerance=1e-8
        )
        motions += [motion.t, motion.quaternion, motion.gamma, motion.gamma_dot]
        motions.append([motion.error_estimate, motion.status])
    return digest(*motions)


def whole(name: str) -> str:
    """Simulate a shipped scene over its own duration, up to its limits."""
    duration = load_scene(name).duration or 1.0
    times = np.linspace(0.0, duration, 11)
    motion = simulate(
        name, duration=duration, t_eval=times, method="dop853", tolerance=1e-8
    )
    found = digest(motion.t, motion.quaternion, motion.body_rate, motion.torque)
    return f"{found} {motion.message}"


def stepped(name: str) -> str:
    """Go step by step with held torques."""
    run = Simulation(load_scene(name))
    torque, hashes = np.array([0.3, -0.2, 0.1]), list[float]()
    for number in range(STEPS):
        run.step(tuple(torque * np.cos(0.3 * number)), 2_000_000)
        hashes += [*run.state.quaternion, *run.state.body_rate]
    return digest(hashes)


def batched() -> str:
    """Run a batch of 64 starts."""
    scene = load_scene("example2_heavy")
    gamma = np.random.default_rng(5).uniform(0.7, 0.85, (64, 3))
    result = Batch(scene).run(
        gamma, np.zeros((64, 3)), (0.1, 0.2, -0.1), step=1e-3, count=100
    )
    return digest(result.quaternion, result.body_rate, result.gamma)


def swept() -> str:
    """Run a sweep of 500 rows."""
    vary = {
        "star.inertia": ("uniform", 0.8, 1.2, "relative"),
        "initial.gamma": ("uniform", 0.7, 0.85),
    }
    table = sweep("example2_heavy", vary, n=500)
    return digest(table.select_dtypes("number").to_numpy())


def recorded(folder: Path) -> Iterator[tuple[str, str]]:
    """Run the demo in lockstep; hash the recorded states, and list the evaluation."""
    command = [sys.executable, "-m", "sst_ros", "demo", "--out", str(folder), "--force"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, timeout=300)
    # Stamps are times of the wall: the states and torques between them are what must
    # not change.
    run = read_bag(folder / "bag")
    columns = (run.time_ns, run.quaternion, run.gamma, run.gamma_dot, run.effort)
    yield "lockstep states", digest(*columns)
    for path in sorted(folder.glob("*.json")):
        for key, value in sorted(flat(json.loads(path.read_text(encoding="utf-8")))):
            if not any(word in key for word in MEASURED):
                yield f"report {path.name} {key}", repr(value)


def flat(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Walk through the leaves of a document."""
    if isinstance(value, dict):
        for name, part in value.items():
            yield from flat(part, f"{key}.{name}")
    else:
        yield key, value


def lines() -> Iterator[str]:
    """All motions, a line each; a refusal is its text."""
    jobs: dict[str, Callable[[], str]] = {}
    for name in SCENES:
        jobs |= {f"simulate {name} {m}": partial(simulated, name, m) for m in METHODS}
        jobs[f"steps {name}"] = partial(stepped, name)
        jobs[f"whole {name}"] = partial(whole, name)
    for what, job in {**jobs, "batch": batched, "sweep": swept}.items():
        try:
            yield f"{what}: {job()}"
        except SstError as error:
            yield f"{what}: {type(error).__name__} {error}"
    with tempfile.TemporaryDirectory() as folder:
        yield from (f"{what}: {found}" for what, found in recorded(Path(folder)))


if __name__ == "__main__":
    with Path(sys.argv[1]).open("w", encoding="utf-8") as out:
        for line in lines():
            print(line, file=out, flush=True)
