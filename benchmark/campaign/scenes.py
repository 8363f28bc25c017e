# SPDX-License-Identifier: Apache-2.0
"""Scenes: hostile documents, extreme numbers, and random scenes held to their invariants."""

from __future__ import annotations

import copy
import math
import random
import time
import warnings
from collections.abc import Iterator
from typing import Any

import yaml

from benchmark.campaign.ledger import Ledger
from sst_ros import Simulation
from sst_ros.errors import InputError
from sst_ros.mechanism.frames import angle_between
from sst_ros.scene.scene import Scene, names, text_of
from sst_ros.scene.yaml_document import read

NUMBERS = (0, -1, 5e-324, 1e-320, 1e-12, 1e-9, 1e9, 1e18, 1e308, -1e308, 10**400, math.nan,
           math.inf, -math.inf, 1.5707963267948966)  # fmt: skip
OTHERS: tuple[Any, ...] = (
    *(None, True, "", "gamma_1", "\ud800", "\x1b[31m", "3_5", "yes", "0o17"),
    *([], {}, [[]], [{}], {"xx": 1}, [1] * 50),
)
Changes = dict[tuple[Any, ...], object]
"""Values by their paths in a scene."""
PERIOD_NS = 1_000_000
STEP_BOUND_S = 0.4
"""A step may take 0.2 s on an idle core of this machine; twice that beside other work."""
FIRST_STEP_BOUND_S = 2.0
"""The first step also traces the equations, and the Jacobian where the motion is stiff."""


def trees() -> dict[str, Any]:
    """Return the documents of all shipped scenes."""
    return {name: yaml.safe_load(text_of(name)[0]) for name in names()}


def places(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Every place of a document."""
    if isinstance(tree, (dict, list)):
        for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
            yield (*path, key)
            yield from places(value, (*path, key))


def put(tree: Any, path: tuple[Any, ...], value: object) -> None:
    """Write a value into a place of a document."""
    for key in path[:-1]:
        tree = tree[key]
    tree[path[-1]] = value


def _text(tree: Any) -> str:
    return yaml.dump(tree, allow_unicode=False)


def documents(ledger: Ledger) -> None:
    """Read documents with wrong values, wrong structure and hostile sizes."""
    rng, known = ledger.rng, trees()
    large = {
        "200,000 base directions": _text({"base": {"v": [[1, 0, 0]] * 200_000}}),
        "20,000 unknown keys": _text({f"key_{n}": n for n in range(20_000)}),
        "deep nesting": "a: " + "[" * 5000,
        "aliases": "a: &a [x, x]\n" + "".join(f"b{n}: [*a, *a]\n" for n in range(2000)),
        "escapes": _text({"\x1b[31mred": 1}),
        "empty": "",
        "a list": "[1, 2]",
        "bytes": "\x00\x01",
    }
    for name, source in large.items():
        # PyYAML alone takes a second for the 300 kB of 20,000 keys.
        with ledger.case(name, bound=2.0):
            _read(ledger, name, source)
    for number in ledger.numbers(256):
        name = rng.choice(sorted(known))
        tree = copy.deepcopy(known[name])
        for _ in range(rng.choice((1, 1, 2, 4))):
            path = rng.choice(list(places(tree)))
            put(tree, path, rng.choice(NUMBERS + OTHERS))
        label = f"document {number} (seed {ledger.seed})"
        with ledger.case(label, bound=2.0):
            _read(ledger, label, _text(tree))


def _read(ledger: Ledger, name: str, source: str) -> None:
    try:
        Simulation(read(Scene, source, "scene"))
    except InputError as error:
        text = str(error)
        if "\x1b" in text or len(text) > 20_000:
            ledger.found("silent", f"{name}: message of {len(text)} characters, or raw escapes")
        raise


def _extremes() -> dict[str, Changes]:
    """Changes of scene `swing` that make it as stiff, light or sharp as possible."""
    star = ("star", "inertia")
    alone: Changes = {("actuated_links",): [{}], ("intermediate_links",): [{}]}
    found: dict[str, Changes] = {}
    for c in (0.1, 5.0, 1e9):
        for s in (1e-2, 1e-6, 1e-9, 1e-12):
            sharp = {"gamma": {"coulomb": c, "smoothing": s}}
            found[f"Coulomb {c:g} N m, smoothing {s:g} rad/s"] = {("friction",): sharp}
    for z in (1e-3, 1e-6, 1e-9, 1e-12):
        found[f"star diag(1, 1, {z:g})"] = {star: {"xx": 1.0, "yy": 1.0, "zz": z}, **alone}
    for a, z in ((1e-6, 1e-12), (1e-12, 1e-12), (1e6, 1e6), (1e-6, 1e-6)):
        found[f"star diag({a:g}, {a:g}, {z:g})"] = {star: {"xx": a, "yy": a, "zz": z}}
    for v in (1e2, 1e5, 1e9):
        found[f"viscous {v:g} N m s/rad"] = {("friction",): {"beta": {"viscous": v}}}
    for k in (1e3, 1e6, 1e9):
        spring = {"joint": "gamma_1", "stiffness": k, "rest": 0.8}
        found[f"spring {k:g} N m/rad"] = {("springs",): [spring]}
    for w in (1e2, 1e5, 1e8):
        found[f"gamma_dot {w:g} rad/s"] = {("initial", "gamma_dot"): [w, -w, w]}
    for lag in (1e-2, 1e-6, 1e-9):
        found[f"actuator lag {lag:g} s"] = {("actuators",): {"time_constant": lag}}
    return found


def needle() -> str:
    """Return scene `swing` with a star whose first step of 1 ms would take a minute."""
    tree = copy.deepcopy(trees()["swing"])
    for path, value in _extremes()["star diag(1, 1, 1e-12)"].items():
        put(tree, path, value)
    return _text({**tree, "stroke": {"at_end": "ignore"}, "workspace": {"at_edge": "ignore"}})


def extremes(ledger: Ledger) -> None:
    """Step extreme scenes: each step bounded, each state finite, each error one of ours."""
    cases, whole = list(_extremes().items()), ledger.share >= 1
    for number in ledger.numbers(2 * len(cases), least=6):
        name, changes = cases[number % len(cases)] if whole else ledger.rng.choice(cases)
        ignored = number >= len(cases)
        tree = copy.deepcopy(trees()["swing"])
        for path, value in changes.items():
            put(tree, path, value)
        if ignored:
            tree["stroke"] = {"at_end": "ignore"}
            tree["workspace"] = {"at_edge": "ignore"}
        with ledger.case(name, bound=60.0):
            simulation = Simulation(read(Scene, _text(tree), "scene"))
            torque = (1.0, 2.0, -1.0) if number % 2 else (0.01, 0.0, 0.0)
            for step in range(20):
                bound = STEP_BOUND_S if step else FIRST_STEP_BOUND_S
                began = time.process_time()
                try:
                    state = simulation.step(torque, PERIOD_NS)
                finally:
                    took = time.process_time() - began
                    ledger.time(took, bound, f"{name}: processor time of a step")
                _finite(ledger, name, state)


def _finite(ledger: Ledger, name: str, state: Any) -> None:
    numbers = (*state.quaternion, *state.body_rate, *state.joints.gamma, *state.joints.gamma_dot)
    if not all(map(math.isfinite, numbers)):
        ledger.found("silent", f"{name}: a number is not finite")


def random_scene(rng: random.Random) -> Scene:
    """Return a physical scene: random geometry, inertias, loads and start."""
    tree = copy.deepcopy(trees()["general" if rng.random() < 0.3 else "swing"])
    tree["description"] = "campaign"
    tree["duration"] = 0.2
    for key in ("motion", "torque", "friction", "springs", "gravity", "payload", "actuators"):
        tree.pop(key, None)
    scale = 10 ** rng.uniform(-1, 1)
    x, y = (rng.uniform(0.5, 1.5) * scale for _ in range(2))
    z = rng.uniform(abs(x - y) + 0.01 * scale, x + y)
    tree["star"]["inertia"] = {"xx": x, "yy": y, "zz": z}
    if rng.random() < 0.5:
        tree["gravity"] = {"acceleration": [rng.uniform(-9.81, 9.81) for _ in range(3)]}
        tree["payload"] = {"mass": rng.uniform(0.1, 3), "centre": [0, 0, rng.uniform(0, 0.3)]}
    if rng.random() < 0.5:
        kind = rng.choice(("gamma", "mu", "beta"))
        tree["friction"] = {kind: {"viscous": rng.uniform(0, 1), "coulomb": rng.uniform(0, 0.5)}}
    if rng.random() < 0.4:
        joint = f"{rng.choice(('gamma', 'mu', 'beta'))}_{rng.randint(1, 3)}"
        tree["springs"] = [{"joint": joint, "stiffness": 10 ** rng.uniform(-1, 2), "rest": 0.8}]
    if rng.random() < 0.3:
        tree["actuators"] = {"torque_limit": rng.uniform(0.5, 5), "rotor_inertia": 1e-4}
    tree["initial"]["gamma_dot"] = [rng.uniform(-1, 1) for _ in range(3)]
    return read(Scene, _text(tree), "scene")


def invariants(ledger: Ledger) -> None:
    """Simulate random scenes: finite, closed, energy balanced, error estimated."""
    rng = ledger.rng
    for number in ledger.numbers(434, least=8):
        name = f"scene {number} (seed {ledger.seed})"
        with ledger.case(name, bound=20.0):
            scene = random_scene(rng)
            fine = Simulation(scene, tolerance=1e-13)
            plain = Simulation(scene, tolerance=1e-9)
            torque = _draw_torque(rng)
            for _ in range(100):
                _finite(ledger, name, plain.step(torque, PERIOD_NS))
                fine.step(torque, PERIOD_NS)
            if not plain.closure_residual < 1e-14:
                ledger.found("silent", f"{name}: closure {plain.closure_residual:.1e}")
            energy = sum(abs(x) for x in fine.state.body_rate) ** 2
            if not abs(plain.energy_residual) < 1e-7 * (1 + energy):
                ledger.found("silent", f"{name}: energy residual {plain.energy_residual:.1e} J")
            error = float(angle_between(plain.state.quaternion, fine.state.quaternion))
            if error > 1e-12 and error > 30 * plain.error_estimate + 30 * fine.error_estimate:
                note = f"{name}: error {error:.1e}, estimate {plain.error_estimate:.1e}"
                ledger.found("silent", note)


def _draw_torque(rng: random.Random) -> tuple[float, float, float]:
    return rng.uniform(-2, 2), rng.uniform(-2, 2), rng.uniform(-2, 2)


def bits(ledger: Ledger) -> None:
    """Simulate random scenes interpreted and compiled: not one bit may differ."""
    rng = random.Random(ledger.seed + 1)
    for number in ledger.numbers(200):
        name = f"scene {number} (seed {ledger.seed + 1})"
        # Compiling takes seconds, for `auto` that of three methods.
        method = rng.choice(("rk4", "dopri5", "dop853", "rodas4")) if number % 10 else "auto"
        with ledger.case(f"{name} {method}", bound=120.0), warnings.catch_warnings():
            warnings.simplefilter("error")
            scene = random_scene(rng)
            runs = [Simulation(scene, method, compiled=compiled) for compiled in (False, True)]
            torque = _draw_torque(rng)
            for _ in range(40):
                plain, fast = (run.step(torque, PERIOD_NS) for run in runs)
                if plain != fast:
                    ledger.found("silent", f"{name} {method}: bits differ at {plain.time_ns} ns")
                    break
