# SPDX-License-Identifier: Apache-2.0
"""300 random scenes: no true motion lies outside of what is proven.

The truth has some 30 digits and shares nothing with the package: see `quad_truth`. A
third of the scenes have documents that are converted when they are read, a third have
ranges, checked at corners and inside, a third have contacts or torques at their limit.
Run this file to check all of them and to print the table of docs/methods/proof.md.
"""

import re
import sys
import time
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
import yaml
from mpmath import mp, mpf

from sst_ros import AssemblyError, InputError, certify, load_scene

# Run as a program, this file finds no helper of the tests by itself.
sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parent))
import quad_truth as truth
from slow_cases import slow_except

TIMES = [0.03125, 0.0625]  # [s], exact as doubles
CORNERS, INSIDE = 20, 5
FEW = range(8)  # scenes of tests of their own
MORE = range(8, 48)  # scenes of the search, of 300
KINDS = ("converted", "ranges", "kinks")
FAMILY = 2511  # of the seeds that these tests take
QUICK = (6,)
"""The scene whose proof takes least time."""


def digits(rng, low, high, places=3):
    """A random number as a person would write it."""
    return f"{rng.uniform(low, high):.{places}f}"


def three(rng, low, high, places=3):
    return [digits(rng, low, high, places) for _ in range(3)]


def random_body(rng, size, mass, about_centre):
    """A body of five point masses: mass, centre and inertia as texts."""
    points = rng.uniform(-size, size, (5, 3)) + rng.uniform(-0.2, 0.2, 3) * size
    masses = rng.dirichlet(np.ones(5) * 4.0) * mass
    centre = masses @ points / mass
    seen = points - centre if about_centre else points
    squares = (seen**2).sum(axis=1)
    tensor = np.einsum("m,ij->ij", masses * squares, np.eye(3)) - np.einsum(
        "m,mi,mj->ij", masses, seen, seen
    )
    tensor = tensor + 1e-4 * mass * size**2 * np.eye(3)
    names = ("xx", "yy", "zz", "xy", "xz", "yz")
    places = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    body = {
        "mass": f"{mass:.6f}",
        "centre": [f"{x:.8f}" for x in centre],
        "inertia": {
            name: f"{tensor[place]:.9f}"
            for name, place in zip(names, places, strict=True)
        },
    }
    if about_centre:
        body["inertia_about"] = "centre_of_mass"
    return body


def draw_document(rng, kind):
    """A document as texts."""
    converted = kind == "converted"
    if converted and rng.random() < 0.7:
        base = {"arcs_deg": three(rng, 84.0, 96.0, 1)}
    else:
        rows = np.eye(3) + rng.uniform(-0.12, 0.12, (3, 3))
        base = {"v": [[f"{x:.2f}" for x in row] for row in rows]}
    first, second = (Decimal(digits(rng, 108.0, 132.0, 1)) for _ in range(2))
    alpha = [str(first), str(second), str(Decimal(360) - first - second)]
    about = [bool(converted and rng.random() < 0.6) for _ in range(7)]
    document = {
        "base": base | {"radius": "0.35"},
        "star": {"alpha_deg": alpha, "radius": "0.4"}
        | random_body(rng, 0.4, rng.uniform(1.5, 3.0), about[0]),
        "actuated_links": [
            random_body(rng, 0.25, rng.uniform(0.2, 0.5), centre)
            for centre in about[1:4]
        ],
        "intermediate_links": [
            random_body(rng, 0.12, rng.uniform(0.2, 0.5), centre)
            for centre in about[4:]
        ],
        "workspace": {"at_edge": "ignore"},
        "stroke": {"at_end": "ignore"},
        "initial": {
            "gamma": three(rng, 0.6, 0.95),
            "gamma_dot": three(rng, -1.0, 1.0),
        },
        "torque": {
            "amplitude": three(rng, -3.0, 3.0),
            "frequency": three(rng, 2.0, 30.0, 2),
            "phase": three(rng, 0.0, 6.0, 2),
        },
        "duration": "0.0625",
    }
    add_loads(rng, document)
    if kind == "kinks":
        add_kinks(rng, document)
    return document


def add_loads(rng, document):
    """Add some of the loads that a scene may have."""
    if rng.random() < 0.6:
        acceleration = [str(-x) for x in map(Decimal, three(rng, 3.0, 7.0))]
        document["gravity"] = {"acceleration": acceleration}
    if rng.random() < 0.4:
        document["payload"] = random_body(rng, 0.1, rng.uniform(0.2, 0.8), True)
        del document["payload"]["inertia_about"]
        document["payload"]["centre"] = three(rng, -0.1, 0.4)
    if rng.random() < 0.4:
        document["springs"] = [
            {
                "joint": f"{joint}_{leg}",
                "stiffness": digits(rng, 1.0, 40.0, 1),
                "rest": digits(rng, 0.5, 1.0),
            }
            for joint, leg in zip(
                rng.choice(["gamma", "mu", "beta"], 3), (1, 2, 3), strict=True
            )
        ]
    if rng.random() < 0.3:
        friction = {"viscous": digits(rng, 0.01, 0.5)}
        if rng.random() < 0.6:
            friction["coulomb"] = digits(rng, 0.01, 0.3)
            friction["smoothing"] = digits(rng, 0.3, 1.0, 2)
        if rng.random() < 0.3 and "coulomb" in friction:
            friction["static"] = str(Decimal(friction["coulomb"]) + Decimal("0.05"))
            friction["stribeck"] = digits(rng, 0.4, 0.9, 2)
        document["friction"] = {str(rng.choice(["gamma", "mu", "beta"])): friction}
    if rng.random() < 0.3:
        document["moment"] = {"value": three(rng, -1.0, 1.0)}
    actuators = {}
    if rng.random() < 0.3:
        actuators["rotor_inertia"] = digits(rng, 1e-5, 1e-4, 6)
        actuators["gear_ratio"] = digits(rng, 5.0, 30.0, 0)
    if rng.random() < 0.2:
        actuators["time_constant"] = digits(rng, 0.005, 0.05)
    if actuators:
        document["actuators"] = actuators


def add_kinks(rng, document):
    """Let actuators meet their stops, or torques their limit."""
    if rng.random() < 0.5:
        limit = {"torque_limit": digits(rng, 0.5, 2.0, 2)}
        document["actuators"] = document.get("actuators", {}) | limit
        return
    document["initial"]["gamma"] = [
        digits(rng, 0.01, 0.03),
        *three(rng, 0.06, 0.15)[:2],
    ]
    rates = [digits(rng, -1.5, -0.8), *three(rng, -0.5, 0.5)[:2]]
    document["initial"]["gamma_dot"] = rates
    stroke = {"at_end": "elastic", "stiffness": digits(rng, 500, 20000, 0)}
    if rng.random() < 0.5:
        stroke |= {"restitution": digits(rng, 0.4, 0.95, 2), "impact_rate": "1.0"}
    elif rng.random() < 0.5:
        stroke["damping"] = digits(rng, 0.1, 0.6, 2)
    document["stroke"] = stroke


def draw_ranges(rng, document):
    """Ranges of some numbers of a document, in all forms that they may have."""
    keys = {
        "star.inertia.zz": 1e-5,
        "star.alpha_deg[0]": 1e-4,
        "star.mass": 1e-5,
        "base.v[1][0]": 1e-6,
        "initial.gamma[2]": 1e-6,
        "initial.gamma_dot": 1e-5,
        "torque.amplitude[1]": 1e-4,
        "actuated_links[1].inertia.zz": 1e-6,
        "intermediate_links[0].centre[1]": 1e-6,
    }
    if "gravity" in document:
        keys["gravity.acceleration[0]"] = 1e-5
    if "payload" in document:
        keys["payload.centre[2]"] = 1e-6
    chosen = rng.choice(sorted(keys), int(rng.integers(2, 5)), replace=False)
    ranges = {}
    for key in map(str, chosen):
        width = float(f"{keys[key] * 10.0 ** rng.uniform(-1.5, 0.0):.3g}")
        forms = ["half", "half", "interval"]
        if key in ("star.inertia.zz", "star.mass", "actuated_links[1].inertia.zz"):
            forms.append("digits")
        form = str(rng.choice(forms))
        if key == "initial.gamma_dot":
            form = "half"
        ranges[key] = width
        if form == "digits":
            ranges[key] = "digits"
        if form == "interval":
            here = float(find(document, key)[0][-1])
            ranges[key] = (here - width, here + 0.5 * width)
    return ranges


def find(document, key):
    """Places of the numbers that a key names: a container, an index, and the text."""
    part, words = document, re.findall(r"\w+", key)
    for word in words[:-1]:
        part = part[int(word) if word.isdigit() else word]
    last = int(words[-1]) if words[-1].isdigit() else words[-1]
    if isinstance(part[last], list):
        return [(part[last], i, text) for i, text in enumerate(part[last])]
    return [(part, last, part[last])]


def change(document, ranges, draw):
    """A document with mpf numbers in which each range has a value.

    Draw gives -1 to 1.
    """
    texts = yaml.load(yaml.dump(document), yaml.BaseLoader)
    changed = truth.numbers(texts)
    for key, width in ranges.items():
        pairs = zip(find(texts, key), find(changed, key), strict=True)
        for (_, _, text), (part, index, number) in pairs:
            share = mpf(draw())
            if width == "digits":
                places = -Decimal(text).as_tuple().exponent
                part[index] = number + share * mpf(10) ** -places / 2
            elif isinstance(width, tuple):
                low, high = map(mpf, width)
                part[index] = (low + high) / 2 + share * (high - low) / 2
            else:
                part[index] = number + share * mpf(width)
    return changed


def draw_scene(number, folder, family=FAMILY):
    """A scene, its document as texts, and its ranges."""
    kind = KINDS[number % 3]
    for attempt in range(50):
        rng = np.random.default_rng([family, number, attempt])
        document = draw_document(rng, kind)
        ranges = draw_ranges(rng, document) if kind == "ranges" else {}
        path = folder / f"scene_{number}.yaml"
        text = yaml.dump(
            {"name": f"random_{number}", "description": "random"} | document
        )
        path.write_text(text.replace("'", ""))
        try:
            scene = load_scene(path)
            certify(scene, duration=1e-6)  # it can be assembled
        except AssemblyError:
            continue
        except InputError as error:
            # Where no assembly is near, or a centre of mass is outside of its sphere.
            if "initial" in str(error) or "centre" in str(error):
                continue
            raise
        return scene, document, ranges, rng
    raise AssertionError(f"scene {number} cannot be drawn")


def printed_bound(text, words):
    return Decimal(re.search(rf"{words} ([\d.e-]+) rad", text)[1])


def compare(number, folder, corners=CORNERS, inside=INSIDE, family=FAMILY):
    """Largest true error over its bound, and what else is told of a scene."""
    scene, document, ranges, rng = draw_scene(number, folder, family)
    began = time.process_time()
    proven = certify(scene, t_eval=TIMES, ranges=ranges, tolerance=1e-8)
    spent = time.process_time() - began
    rows = len(proven)
    known = proven.trajectory.quaternion[0]
    draws = [lambda: 0.0]
    if ranges:
        draws = [lambda: rng.choice([-1.0, 1.0])] * corners
        draws += [lambda: rng.uniform(-1.0, 1.0)] * inside
    worst, events, largest = {}, 0, [mpf(0), mpf(0)]
    for draw in draws if rows else ():
        with mp.workdps(truth.DIGITS):
            changed = change(document, ranges, draw)
        states, passed = truth.motion(changed, known, TIMES[:rows])
        events = max(events, len(passed))
        for row, state in enumerate(states):
            for name, ratio in truth.ratios(proven, row, state).items():
                worst[name] = max(worst.get(name, 0.0), ratio)
            table = [proven.columns[f"quaternion_{part}"][row] for part in "xyzw"]
            simulated = proven.trajectory.quaternion[row]
            with mp.workdps(truth.DIGITS):
                for i, q in enumerate((table, simulated)):
                    largest[i] = max(largest[i], truth.angle(state.quaternion, q))
    if rows:
        text = repr(proven)
        with mp.workdps(truth.DIGITS):
            for words, most in zip(("within", "not above"), largest, strict=True):
                assert mpf(str(printed_bound(text, words))) >= most
    return {
        "kind": KINDS[number % 3],
        "rows": rows,
        "reason": proven.reason,
        "worst": max(worst.values(), default=0.0),
        "distance": worst.get("distance", 0.0),
        "bound": proven.error,
        "events": events,
        "motions": len(draws) if rows else 0,
        "time": spent,
    }


@pytest.mark.parametrize("number", slow_except(QUICK, FEW))
def test_a_true_motion_lies_inside(number, tmp_path):
    pytest.importorskip("flint")
    found = compare(number, tmp_path, corners=4, inside=1)
    assert found["rows"] == len(TIMES) and not found["reason"]
    assert 0.0 < found["worst"] <= 1.0


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, pytest.param(5, marks=pytest.mark.slow)])
def test_the_truth_has_thirty_digits(number, tmp_path):
    _, document, _, _ = draw_scene(number, tmp_path)
    scene = load_scene(tmp_path / f"scene_{number}.yaml")
    near = certify(scene, duration=1e-6).trajectory.quaternion[0]
    with mp.workdps(truth.DIGITS):
        exact = change(document, {}, lambda: 0.0)
    first, _ = truth.motion(exact, near, TIMES[:1])
    other, _ = truth.motion(exact, near, TIMES[:1], local_error="1e-29")
    with mp.workdps(truth.DIGITS):
        for one, two in zip(first, other, strict=True):
            pairs = zip(
                [*one.body_rate, *one.joints],
                [*two.body_rate, *two.joints],
                strict=True,
            )
            assert max(abs(x - y) for x, y in pairs) < mpf("1e-27")


def summarize(rows):
    """A line of the table of the documentation for the scenes of each kind."""
    for kind in KINDS:
        some = [row for row in rows if row["kind"] == kind]
        if not some:
            continue
        whole = [row for row in some if row["rows"] == len(TIMES)]
        motions = sum(row["motions"] for row in some)
        outside = sum(row["worst"] > 1.0 for row in some)
        middle = np.median([row["distance"] for row in whole])
        events = sum(row["events"] for row in some)
        print(
            f"| {kind} | {len(some)} | {len(whole)} | {motions} | {events} |"
            f" {outside} |"
            f" {max(row['worst'] for row in some):.6f} | {middle:.6f} |"
            f" {np.median([row['bound'] for row in whole]):.2g} rad |",
            flush=True,
        )


@pytest.mark.slow
@pytest.mark.search
@pytest.mark.timeout(1800)
def test_true_motions_of_more_scenes_lie_inside(tmp_path):
    """All 300 scenes take most of an hour: run this file as a program."""
    rows = [compare(number, tmp_path) for number in MORE]
    assert all(row["worst"] <= 1.0 for row in rows)
    assert sum(row["rows"] == len(TIMES) for row in rows) > 0.9 * len(rows)


if __name__ == "__main__":
    import argparse
    import json
    import tempfile

    parser = argparse.ArgumentParser(description="Compare proofs with the truth.")
    parser.add_argument("first", type=int, nargs="?", default=0)
    parser.add_argument("last", type=int, nargs="?", default=300, help="excluded")
    parser.add_argument("--family", type=int, default=FAMILY, help="of the seeds")
    parser.add_argument("--log", type=Path, help="JSON lines, to go on from")
    arguments = parser.parse_args()
    done = {}
    if arguments.log is not None and arguments.log.exists():
        for line in arguments.log.read_text().splitlines():
            row = json.loads(line)
            done[row["number"]] = row
    with tempfile.TemporaryDirectory() as folder:
        for number in range(arguments.first, arguments.last):
            if number in done:
                continue
            row = compare(number, Path(folder), family=arguments.family)
            done[number] = row | {"number": number, "family": arguments.family}
            line = json.dumps(done[number])
            print(line, flush=True)
            if arguments.log is not None:
                with arguments.log.open("a") as log:
                    log.write(line + "\n")
    summarize(list(done.values()))
