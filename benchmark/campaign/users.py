# SPDX-License-Identifier: Apache-2.0
"""What users bring: cold processes, own functions, foreign files, conflicting data."""

from __future__ import annotations

import math
import os
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmark.campaign.ledger import Ledger
from benchmark.campaign.processor import communicate
from sst_ros import Simulation, TorqueTable, Trajectory, identify, load_scene, simulate
from sst_ros.identification.identify import TorqueFit
from sst_ros.scene.scene import load, text_of
from sst_ros.state import Array
from sst_ros.sweeps.sweep import read_sweep, run_study
from sst_ros.sweeps.sweep_study import SweepStudy

COLD = """
import sys
from concurrent.futures import ThreadPoolExecutor
from sst_ros import simulate

def run(_):
    return simulate(sys.argv[1], duration=0.05).quaternion[-1].tobytes().hex()

with ThreadPoolExecutor(4) as pool:
    print(*set(pool.map(run, range(4))))
"""
COLD_SCENES = ("example2", "friction", "stiff", "elastic_stops")
COLD_S = 60.0
"""A cold process imports and compiles before it simulates."""


def cold_threads(ledger: Ledger) -> None:
    """Simulate first in four threads of a new process: the bits are those alone."""
    for number in ledger.numbers(24):
        name = COLD_SCENES[number % len(COLD_SCENES)]
        ledger.tried += 1
        began = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, "-c", COLD, name],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            output, error_text = communicate(process, COLD_S * ledger.patience)
        except subprocess.TimeoutExpired:
            ledger.add_finding("hangs", f"cold process of {name}")
            continue
        ledger.time(time.monotonic() - began, math.inf, name)
        alone = simulate(name, duration=0.05).quaternion[-1].tobytes().hex()
        if process.returncode:
            error = error_text.strip().splitlines()[-1:]
            ledger.add_finding("tracebacks", f"cold process of {name}: {error}")
        elif output.split() != [alone]:
            ledger.add_finding(
                "silent", f"threads of a cold process of {name}: other bits"
            )


class OwnError(Exception):
    """An exception of a user's own."""


EXCEPTIONS = (
    ValueError,
    ZeroDivisionError,
    OverflowError,
    StopIteration,
    KeyError,
    IndexError,
    AttributeError,
    TypeError,
    AssertionError,
    RecursionError,
    np.linalg.LinAlgError,
    KeyboardInterrupt,
    OwnError,
)
METHODS = ("auto", "rk4", "dopri5", "dop853", "rodas5p")


def user_functions(ledger: Ledger) -> None:
    """Raise in a torque of the user, early and late: that exception comes out."""
    rng = ledger.rng
    for _ in ledger.cases(400, least=20):
        error_type = rng.choice(EXCEPTIONS)
        late = rng.choice((0.0, rng.uniform(0.0, 0.05)))
        method = rng.choice(METHODS)
        call = rng.choice(("function of time", "feedback", "held", "step"))
        name = f"{error_type.__name__} in a {call} with {method} from {late:.3f} s on"
        began = time.process_time()
        try:
            _call_user_function(call, error_type, late, method)
        except error_type as error:
            if error.args != ("of the user",):
                ledger.add_finding("silent", f"{name}: other arguments {error.args}")
        except BaseException as error:
            ledger.add_finding("tracebacks", f"{name}: {type(error).__name__}: {error}")
        else:
            ledger.add_finding("silent", f"{name}: nothing came out")
        ledger.time(time.process_time() - began, 10.0, name)


def _call_user_function(
    call: str, error_type: type[BaseException], late: float, method: str
) -> None:
    """Simulate 0.1 s with a torque that raises from a time [s] on."""

    def torque(t: float, _: object = None) -> tuple[float, float, float]:
        if t >= late:
            raise error_type("of the user")
        return 0.1, -0.1, 0.05

    if call == "step":
        run = Simulation("swing", method)
        for _ in range(100):
            run.step(lambda t: torque(t), 1_000_000)
    elif call == "feedback":
        simulate("swing", lambda t, state: torque(t, state), 0.1, method=method)
    elif call == "held":
        simulate(
            "swing",
            lambda t, state: torque(t, state),
            0.1,
            method=method,
            control_period=0.002,
        )
    else:
        simulate("swing", lambda t: torque(t), 0.1, method=method)


FILE_S = 5.0
"""A foreign file is read or refused within this time of the processor."""


def foreign_files(ledger: Ledger) -> None:
    """Read scenes, studies, tables and motions that others wrote, or nobody would."""
    rng = ledger.rng
    with TemporaryDirectory() as name:
        folder = Path(name)
        motion = folder / "motion.csv"
        simulate("example2", duration=0.05).save(motion)
        table = "time,tau_1,tau_2,tau_3\n" + "".join(
            f"{0.01 * k:g},{0.1 * k:g},0,-{k:g}\n" for k in range(30)
        )
        study = "scene: swing\nn: 4\nvary:\n  star.mass: {uniform: [1.5, 2.5]}\n"
        readers: tuple[tuple[str, str, Callable[[Path], Any]], ...] = (
            ("scene.yaml", text_of("swing")[0], load_scene),
            ("study.yaml", study, SweepStudy.read),
            ("torques.csv", table, TorqueTable.read),
            ("motion.csv", motion.read_text(encoding="utf-8"), Trajectory.load),
        )
        for number in ledger.numbers(1200, least=40):
            file, text, read = rng.choice(readers)
            path = folder / f"{number}_{file}"
            how = _write_foreign(rng, path, text)
            with ledger.case(f"{file}, {how}", bound=FILE_S):
                _check_finite(ledger, f"{file}, {how}", read(path))
            path.unlink()


NASTY = (
    "&a [1, 2]",
    "*a",
    "[" * 500,
    "{" * 60 + "}" * 60,
    "a: &x [*x]",
    "010",
    "1:30",
    "1_0",
    "٣",
    ".nan",
    "-.inf",
    "1e400",
    "null",
    "true",
    "!!python/object/apply:os.getcwd []",
    "\x00",
    "\ufeff",
    "\r\n\r\n",
    "9" * 400,
    "'",
    '"',
    "<<: {mass: 1}",
)


def _write_foreign(rng: random.Random, path: Path, text: str) -> str:
    """Write a document that is changed at random; return how."""
    how = rng.choice(
        ("insert", "replace", "repeat", "cut", "encode", "bytes", "fifo", "zero")
    )
    lines = text.splitlines(keepends=True)
    place = rng.randrange(len(lines))
    if how == "fifo":
        os.mkfifo(path)
        return how
    if how == "zero":
        path.symlink_to("/dev/zero")
        return how
    if how == "bytes":
        content = bytearray(text.encode())
        for _ in range(rng.randint(1, 8)):
            content[rng.randrange(len(content))] = rng.randrange(256)
        path.write_bytes(content)
        return how
    if how == "encode":
        encoding = rng.choice(("utf-16", "utf-32", "latin-1", "utf-8-sig"))
        path.write_bytes(text.encode(encoding, errors="replace"))
        return encoding
    if how == "cut":
        path.write_text(text[: rng.randrange(len(text))], encoding="utf-8")
        return how
    if how == "repeat":
        lines[place] *= rng.choice((2, 3, 30_000))
    elif how == "insert":
        lines.insert(place, rng.choice(NASTY) + "\n")
    else:
        fields = lines[place].split(" ")
        fields[rng.randrange(len(fields))] = rng.choice(NASTY)
        lines[place] = " ".join(fields).rstrip("\n") + "\n"
    path.write_text("".join(lines), encoding="utf-8", errors="surrogatepass")
    return f"{how} at line {place + 1}"


def _check_finite(ledger: Ledger, name: str, result: Any) -> None:
    """Count what was read with a number that is not finite."""
    numbers: list[Array] = []
    if isinstance(result, TorqueTable):
        numbers = [result.times, result.torques]
    elif isinstance(result, Trajectory):
        numbers = [result.t, result.quaternion, result.body_rate]
    if not all(bool(np.isfinite(array).all()) for array in numbers):
        ledger.add_finding("silent", f"{name}: numbers that are not finite were read")


def sweep_parts(ledger: Ledger) -> None:
    """Flip, cut, copy, swap and add parts of results: refused, or the same numbers."""
    rng = ledger.rng
    vary = {"star.mass": ("uniform", 1.5, 2.5)}
    study = SweepStudy(load("example2_heavy"), vary, n=96, seed=7, steps=20, chunk=32)
    with TemporaryDirectory() as name:
        original = Path(name) / "whole"
        expected = run_study(study, original)
        file_names = sorted(path.name for path in original.glob("part-*.parquet"))
        for number in ledger.numbers(300, least=10):
            copy = Path(name) / "copy"
            shutil.copytree(original, copy)
            how = rng.choice(("flip", "cut", "copy", "swap", "stray"))
            file_name, other_name = rng.sample(file_names, 2)
            _damage_part(rng, how, copy / file_name, copy / other_name)
            with ledger.case(f"{how} of {file_name} ({number})", bound=20.0):
                table = read_sweep(copy)
                if not table.equals(expected):
                    ledger.add_finding(
                        "silent", f"{how} of {file_name} is not seen ({number})"
                    )
            shutil.rmtree(copy)


def _damage_part(rng: random.Random, how: str, path: Path, other_path: Path) -> None:
    content = bytearray(path.read_bytes())
    if how == "flip":
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        path.write_bytes(content)
    elif how == "cut":
        path.write_bytes(content[: rng.randrange(len(content))])
    elif how == "copy":
        shutil.copy(other_path, path)
    elif how == "swap":
        path.write_bytes(other_path.read_bytes())
        other_path.write_bytes(content)
    else:
        shutil.copy(path, path.with_name("part-0000009.parquet"))


MEASURED_SCENE = "example2_heavy"
FAR = 0.2
"""Relative error of an inertia that a sound measurement does not have."""


@cache
def exact_measurement() -> dict[str, Array]:
    """Return an exact motion of a second, as arrays."""

    def torque(t: float) -> tuple[float, float, float]:
        return 0.3 * math.sin(3 * t), 0.3 * math.sin(5 * t + 1), 0.2 * math.cos(4 * t)

    motion = simulate(MEASURED_SCENE, torque, 1.0, samples=500)
    return {
        "t": motion.t,
        "gamma": motion.gamma,
        "gamma_dot": motion.gamma_dot,
        "torque": motion.torque,
    }


def measurements(ledger: Ledger) -> None:
    """Identify from data with wrong signs, units, legs and faults: said, or right."""
    rng = ledger.rng
    scene = load(MEASURED_SCENE)
    true = scene.star.inertia
    assert true is not None
    for number in ledger.numbers(60, least=3):
        data = dict(exact_measurement())
        if rng.random() < 0.6:
            del data["gamma_dot"]
        how = _spoil(rng, data)
        name = f"measurement {number}: {how}"
        with ledger.case(name, bound=120.0):
            fit = identify(data, scene)
            assert isinstance(fit, TorqueFit)
            is_warned = bool(fit.warnings) or not fit.consistent
            value = float(fit.values[fit.names.index("star.inertia.xx")])
            if not is_warned and abs(value / true.xx - 1.0) > FAR:
                ledger.add_finding("silent", f"{name}: star.inertia.xx = {value:.3g}")


def _spoil(rng: random.Random, data: dict[str, Array]) -> str:
    """Spoil measured arrays in one of the ways in which users do; return which."""
    name = rng.choice([*data])
    if name == "t":
        factor = rng.choice((1e3, 1e6, 1e9, 1.0 / 60.0))
        data["t"] = data["t"] * factor
        return f"t times {factor:g}"
    leg = rng.randrange(3)
    values = data[name] = data[name].copy()
    how = rng.choice(("negate", "negate a leg", "swap", "degrees", "constant", "jump"))
    if how == "negate":
        data[name] = -values
    elif how == "negate a leg":
        values[:, leg] *= -1.0
    elif how == "swap":
        data[name] = values[:, rng.choice(([1, 0, 2], [0, 2, 1], [2, 1, 0], [1, 2, 0]))]
    elif how == "degrees":
        data[name] = np.degrees(values)
    elif how == "constant":
        values[:, leg] = values[0, leg]
    else:
        values[rng.randrange(20, len(values) - 20) :, leg] += rng.choice((0.3, -1.0))
    return f"{name}, {how} {leg + 1}"
