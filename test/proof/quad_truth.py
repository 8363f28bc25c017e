# SPDX-License-Identifier: Apache-2.0
"""An independent truth of proofs: Lagrange's equations in 33 digits, by
truth/lagrange.cpp.

What a document says is converted here, in mpmath, from its text: arcs to directions,
inertias about other points, payload, rotors, a restitution to a damping. Nothing of it
is taken from the package but a quaternion near the assembly that is meant.
"""

import shutil
import subprocess
from functools import cache
from itertools import chain
from pathlib import Path
from tempfile import mkdtemp
from typing import NamedTuple

import pytest
import yaml
from mpmath import mp, mpf

DIGITS = 40
SOURCE = Path(__file__).parent / "truth" / "lagrange.cpp"
KINDS = ("gamma", "mu", "beta")
RATES = ("gamma_dot", "mu_dot", "beta_dot")
INERTIA = ("xx", "yy", "zz", "xy", "xz", "yz")
PLACES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


@cache
def program():
    """The compiled integrator.

    The test is skipped where there is no compiler for it.
    """
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no C compiler")
    out = Path(mkdtemp()) / "lagrange"
    build = [compiler, "-O2", "-o", str(out), str(SOURCE), "-lquadmath"]
    done = subprocess.run(build, capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"no C compiler with libquadmath: {done.stderr.splitlines()[0]}")
    return out


def read(text):
    """A document with its numbers as they are written."""
    return yaml.load(text, yaml.BaseLoader)


def read_values(part):
    """A part of a document with floats in place of texts that are numbers."""
    if isinstance(part, dict):
        return {key: read_values(x) for key, x in part.items()}
    if isinstance(part, list):
        return [read_values(x) for x in part]
    try:
        return float(part)
    except ValueError:
        return part


def numbers(part):
    """A part of a document with mpf in place of texts that are numbers."""
    if isinstance(part, dict):
        return {key: numbers(x) for key, x in part.items()}
    if isinstance(part, list):
        return [numbers(x) for x in part]
    try:
        return mpf(part)
    except (ValueError, TypeError):
        return part


def unit(a):
    length = mp.sqrt(sum(x * x for x in a))
    return [x / length for x in a]


def flat(rows):
    return list(chain.from_iterable(rows))


def cross(a, b):
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]


def dot(a, b):
    return sum(x * y for x, y in zip(a, b, strict=True))


def corners(base):
    """Unit vectors of the base triangle, from directions or arcs."""
    if "v" in base:
        return [unit(row) for row in base["v"]]
    a12, a23, a31 = (x * mp.pi / 180 for x in base["arcs_deg"])
    # The angle at P1, by the cosine rule of spherical triangles.
    cosine = (mp.cos(a23) - mp.cos(a12) * mp.cos(a31)) / (mp.sin(a12) * mp.sin(a31))
    sine = mp.sqrt(1 - cosine**2)
    third = [mp.cos(a31), mp.sin(a31) * cosine, mp.sin(a31) * sine]
    return [[mpf(1), mpf(0), mpf(0)], [mp.cos(a12), mp.sin(a12), mpf(0)], third]


def tensor(body, own=False):
    """Six numbers of the inertia about O, and mass times centre."""
    inertia = [body.get("inertia", {}).get(name, mpf(0)) for name in INERTIA]
    mass = body.get("mass", mpf(0))
    centre = body.get("centre", [mpf(0)] * 3)
    if own or body.get("inertia_about") == "centre_of_mass":
        square = dot(centre, centre)
        for index, (i, j) in enumerate(PLACES):
            inertia[index] += mass * ((square if i == j else 0) - centre[i] * centre[j])
    return inertia, [mass * x for x in centre]


def each_leg(links):
    return links * 3 if len(links) == 1 else links


def damping_of(stroke):
    """Damping of stops: d (1 + e) = ln((1 + d) / (1 - d e)) for d = damping rate."""
    if "restitution" not in stroke:
        return stroke.get("damping", mpf(0))
    e, rate = stroke["restitution"], stroke["impact_rate"]
    if e == 1:
        return mpf(0)

    def gap(d):
        return mp.log((1 + d) / (1 - d * e)) - d * (1 + e)

    # gap is negative for small d and grows to infinity toward 1 / e
    low, high = mpf("1e-6"), (1 - mpf(10) ** -25) / e
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if gap(middle) < 0 else (low, middle)
    return low / rate


def inputs(document, near, times):
    """Lines for the program, of a document with mpf numbers."""
    v = corners(document["base"])
    following = [v[1], v[2], v[0]]
    w = [unit(cross(a, b)) for a, b in zip(v, following, strict=True)]
    arcs = [mp.acos(dot(a, b)) for a, b in zip(v, following, strict=True)]
    first, second = (x * mp.pi / 180 for x in document["star"]["alpha_deg"][:2])
    turns = (mpf(0), first, first + second)
    e = [[-mp.sin(x), mp.cos(x), mpf(0)] for x in turns]
    bodies = [tensor(document["star"])]
    if "payload" in document:
        inertia, weight = tensor(document["payload"], own=True)
        star = bodies[0]
        bodies[0] = (
            [a + b for a, b in zip(star[0], inertia, strict=True)],
            [a + b for a, b in zip(star[1], weight, strict=True)],
        )
    drive = document.get("actuators", {})
    for link in each_leg(document["actuated_links"]):
        inertia, weight = tensor(link)
        gear = drive.get("gear_ratio", mpf(1))
        inertia[2] += gear**2 * drive.get("rotor_inertia", mpf(0))
        bodies.append((inertia, weight))
    bodies += [tensor(link) for link in each_leg(document["intermediate_links"])]
    rows = {
        "v": flat(v),
        "w": flat(w),
        "e": flat(e),
        "arc": arcs,
        "inertias": flat(inertia for inertia, _ in bodies),
        "weights": flat(weight for _, weight in bodies),
        "gamma": document["initial"]["gamma"],
        "gamma_dot": document["initial"].get("gamma_dot", [mpf(0)] * 3),
        "near": [mpf(x) for x in near],
        "constant": [mpf(0)] * 3,
        "times": [mpf(x) for x in times],
    }
    if "gravity" in document:
        rows["gravity"] = document["gravity"]["acceleration"]
    if "moment" in document:
        rows["moment"] = document["moment"]["value"]
    for kind, name in enumerate(KINDS):
        if name in document.get("friction", {}):
            given = document["friction"][name]
            defaults = (("viscous", 0), ("coulomb", 0), ("smoothing", mpf("0.01")))
            defaults += (("static", 0), ("stribeck", mpf("0.1")))
            rows[f"friction{kind}"] = [mpf(given.get(key, x)) for key, x in defaults]
    if "springs" in document:
        stiffness, rest = [mpf(0)] * 9, [mpf(0)] * 9
        for spring in document["springs"]:
            kind, leg = spring["joint"].split("_")
            place = 3 * KINDS.index(kind) + int(leg) - 1
            stiffness[place], rest[place] = spring["stiffness"], spring["rest"]
        rows |= {"stiffness": stiffness, "rest": rest}
    for name in ("torque_limit", "time_constant"):
        if name in drive:
            rows[name] = [drive[name]]
    stroke = document.get("stroke", {})
    if "stiffness" in stroke:
        rows["stop_stiffness"] = [stroke["stiffness"]]
        rows["stop_damping"] = [damping_of(stroke)]
    if "stiffness" in stroke or "torque_limit" in drive:
        rows["longest"] = [mpf("0.004")]  # so that no step passes two events
    if "torque" in document:
        rows |= document["torque"]
    return "".join(
        f"{name} {' '.join(mp.nstr(mpf(x), DIGITS) for x in row)}\n"
        for name, row in rows.items()
    )


class TrueState(NamedTuple):
    """The state at a time: mpf numbers."""

    quaternion: list
    body_rate: list
    joints: list  # gamma, mu, beta by leg, then their rates


def motion(document, near, times, local_error="1e-31"):
    """States at times of a document with mpf numbers, and the events before the last.

    30 digits.
    """
    with mp.workdps(DIGITS):
        text = inputs(document, near, times)
    done = subprocess.run(
        [program(), local_error],
        input=text,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, (done.returncode, done.stderr)
    states = []
    with mp.workdps(DIGITS):
        for line in done.stdout.splitlines():
            row = [mpf(x) for x in line.split()]
            states.append(TrueState(row[:4], row[4:7], row[7:]))
        events = []
        for line in done.stderr.splitlines():
            index, time = line.split()
            events.append(TrueEvent(event_name(document, int(index)), mpf(time)))
    return states, events


class TrueEvent(NamedTuple):
    """When a mode of the motion ends, and the name that `certify` has for it."""

    name: str
    time: mpf


def event_name(document, index):
    """Return the limit that is met: an end of a stroke, of a pull, or of a torque."""
    if "stiffness" in document.get("stroke", {}):
        if index < 9:
            leg, place = divmod(index, 3)
            if place == 2:
                return f"push of stop {leg + 1} ends"
            end = ("0", "arc")[place]
            return f"contact of gamma_{leg + 1} at {end}"
        index -= 9
    return f"torque_{index // 2 + 1} at its limit"


def angle(first, second):
    """Angle between the orientations of quaternions [rad]."""
    a, b = unit(first), unit([mpf(float(x)) for x in second])
    chords = (
        mp.sqrt(sum((x - sign * y) ** 2 for x, y in zip(a, b, strict=True)))
        for sign in (1, -1)
    )
    return 4 * mp.asin(min(chords) / 2)


def ratios(proven, row, state):
    """True errors over their bounds at a row of a proof: by name."""
    columns = proven.columns
    names = [f"body_rate_{part}" for part in "xyz"]
    names += [f"{joint}_{leg}" for joint in (*KINDS, *RATES) for leg in (1, 2, 3)]
    table = [columns[f"quaternion_{part}"][row] for part in "xyzw"]
    simulated = proven.trajectory.quaternion[row]
    found = {}
    with mp.workdps(DIGITS):
        for name, q in (("angle", table), ("distance", simulated)):
            found[name] = angle(state.quaternion, q) / mpf(float(columns[name][row]))
        for name, x in zip(names, [*state.body_rate, *state.joints], strict=True):
            off = abs(x - mpf(float(columns[name][row])))
            bound = mpf(float(columns[f"{name}_bound"][row]))
            found[name] = off / bound if off else mpf(0)
    return {name: float(x) for name, x in found.items()}
