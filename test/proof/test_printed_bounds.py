# SPDX-License-Identifier: Apache-2.0
"""Each bound that is printed, saved or drawn is not below that of its ball."""

import csv
import math
import platform
import re
import subprocess
import sys
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
from mpmath import mp, mpf
from slow_cases import slow_after

from sst_ros import (
    Controller,
    ControllerSettings,
    certify,
    certify_zone,
    load_scene,
    plot_zone,
    reference_motion,
)
from sst_ros.__main__ import main
from sst_ros.dynamics.motion_table import JOINT_QUANTITIES
from sst_ros.mechanism.geometry import Geometry
from sst_ros.mechanism.workspace import triangle_directions
from sst_ros.plot.workspace import ZONE_DIVISIONS
from sst_ros.proof import balls
from sst_ros.proof import certify as certify_module
from sst_ros.proof.balls import arb
from sst_ros.report.accuracy import proven_error

JOINTS = [f"{joint}_{leg}" for joint in JOINT_QUANTITIES for leg in (1, 2, 3)]
RATES = [f"body_rate_{part}" for part in "xyz"]
NUMBER = r"[-+]?\d+(?:\.\d*)?(?:e[-+]?\d+)?"
PERIOD = 5e-3


def exact(ball):
    """An exact number of Arb as a fraction."""
    mantissa, exponent = arb(ball).man_exp()
    return Fraction(int(mantissa)) * Fraction(2) ** int(exponent)


def most_from(number, ball, more=0):
    """How far a number of a ball, or what is more off, can be from another."""
    middle, radius = exact(ball.mid()), exact(ball.rad())
    return abs(middle - Fraction(number)) + radius + exact(arb(more).abs_upper())


@pytest.fixture
def rows(monkeypatch):
    """Rows of proofs, each with the step, the time and the equations it is from."""
    taken, make = [], certify_module.Follower._row

    def note(follower, step, time):
        row = make(follower, step, time)
        taken.append((row, step, time, follower._equations))
        return row

    monkeypatch.setattr(certify_module.Follower, "_row", note)
    return taken


def compare_row(row, step, time, equations, rng):
    """Numbers of a row whose bound is not below what its balls allow."""
    p, e = step.at(time)
    varied = len(equations.balls.inputs)
    known = [*range(7), *range(len(p) - varied, len(p))]
    for place in range(3):
        middle, bound = row.values[place]
        assert Fraction(bound) >= most_from(middle, p[4 + place], e[4 + place])
    widths = balls.entries(step.begin.a)
    span = arb(time) - arb(step.begin.time)
    # The joints of states in the set: along its generators, not in the box around it.
    for _ in range(8):
        signs = [arb(int(x)) for x in rng.choice([-1, 1], step.begin.a.nrows())]
        far = [a * sign for a, sign in zip(widths, signs, strict=True)]
        moved = step.flow(span) * (step.begin.c * balls.column(far))
        state = [x + off for x, off in zip(p, balls.entries(moved), strict=True)]
        joints = equations.joints(*(arb(state[i].mid()) for i in known))
        for number, (middle, bound) in zip(joints[:18], row.values[3:], strict=True):
            slack = exact(balls.arb(number).rad()) + Fraction(1, 10**30)
            off = abs(exact(arb(number).mid()) - Fraction(middle))
            assert Fraction(bound) + slack >= off
    with mp.workdps(60):
        for _ in range(8):
            signs = rng.choice([-1, 1], 4)
            q = [
                to_mpf(x.mid()) + int(s) * to_mpf(arb(r).upper())
                for x, r, s in zip(p[:4], e[:4], signs, strict=True)
            ]
            assert mpf(row.angle) >= angle(q, row.quaternion)


def to_mpf(number):
    value = exact(number)
    return mpf(value.numerator) / value.denominator


def angle(first, second):
    a, b = [list(map(mpf, q)) for q in (first, second)]
    product = sum(x * y for x, y in zip(a, b, strict=True))
    lengths = mp.sqrt(sum(x * x for x in a) * sum(x * x for x in b))
    sine = mp.sqrt(abs(1 - (product / lengths) ** 2))
    return 2 * mp.asin(min(sine, 1))


CASES = {
    "exact": ("example2", {"duration": 0.1, "t_eval": [0.0, 0.05, 0.1]}),
    "ranges": (
        "general",
        {
            "duration": 0.05,
            "t_eval": [0.0, 0.05],
            "ranges": {"star.inertia.zz": 1e-5, "initial.gamma[0]": 1e-6},
        },
    ),
    "contact": ("elastic_stops", {"duration": 0.1, "t_eval": [0.1]}),
}


@pytest.mark.parametrize("case", slow_after(2, CASES))
def test_columns_are_not_below_the_balls_they_are_from(case, rows):
    name, given = CASES[case]
    proven = certify(name, **given)
    rng = np.random.default_rng(51)
    assert len(rows) == len(given["t_eval"]) == len(proven)
    with balls.precision():
        for k, taken in enumerate(rows):
            row = taken[0]
            compare_row(*taken, rng)
            names = ["angle", "distance", *(f"{x}_bound" for x in (*RATES, *JOINTS))]
            numbers = [row.angle, row.distance, *(bound for _, bound in row.values)]
            for column, number in zip(names, numbers, strict=True):
                assert proven.columns[column][k] == number


def check_text(text, proven):
    """Each number that is printed of a proof is rounded outward."""
    lines = {
        name: next(line for line in text.splitlines() if line.strip().startswith(name))
        for name in ("proven", "orientation", "error of simulate", "limits")
    }

    def numbers(name):
        return [Decimal(x) for x in re.findall(rf"(?<![\w.]){NUMBER}", lines[name])]

    assert numbers("proven")[0] <= Decimal(proven.until)
    assert numbers("orientation")[0] >= Decimal(proven.largest)
    assert numbers("error of simulate")[0] >= Decimal(proven.error)
    for name, spans in proven.limits.items():
        said = re.findall(rf"{re.escape(name)}: ({NUMBER}) to ({NUMBER}) s", text)
        assert len(said) == len(spans)
        for (low, high), (begin, end) in zip(said, spans, strict=True):
            assert Decimal(low) <= Decimal(begin) and Decimal(high) >= Decimal(end)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["example2_stroke", "elastic_stops"])
def test_what_is_printed_of_a_motion_is_outward(name):
    proven = certify(name, duration=0.95, t_eval=[0.3, 0.7])
    check_text(repr(proven), proven)
    cell = proven_error(name, duration=0.95, t_eval=[0.3, 0.7])
    assert Decimal(re.match(NUMBER, cell)[0]) >= Decimal(proven.error)
    if proven.reason:
        assert Decimal(re.search(rf" to ({NUMBER}) s", cell)[1]) <= Decimal(
            proven.until
        )


def test_what_the_command_prints_and_saves_is_outward(tmp_path, capsys):
    path = tmp_path / "bounds.csv"
    given = {"duration": 0.02, "bound": 1e-12}
    assert main(["certify", "example2", "--duration", "0.02", "--bound", "1e-12",
                 "--out", str(path)]) == 0  # fmt: skip
    proven = certify("example2", **given)
    check_text(capsys.readouterr().out, proven)
    compare_table(path, proven.columns)


def compare_table(path, columns):
    """Saved numbers are the doubles of the columns, as decimal numbers too."""
    with path.open() as file:
        saved = list(csv.DictReader(file))
    for name, numbers in columns.items():
        assert [Fraction(row[name]) for row in saved] == [
            Fraction(float(x)) for x in numbers
        ]


@pytest.mark.slow
def test_the_tube_of_a_loop_is_printed_and_saved_outward(tmp_path, monkeypatch, capsys):
    noted, bounds = [], certify_module.SampledLoop._bounds

    def note(loop, here, response):
        values = bounds(loop, here, response)
        noted.append((response.values, values))
        return values

    monkeypatch.setattr(certify_module.SampledLoop, "_bounds", note)
    scene = load_scene("reach")
    loop = Controller(
        scene, reference_motion(scene), ControllerSettings(mode="pd"), PERIOD
    )
    proven = certify(
        scene, loop, 0.01, control_period=PERIOD, noise=(1e-6, 1e-4), bound=1e-4
    )
    assert len(noted) == len(proven.tracking["t"]) == 3
    for k, (values, bounds_of) in enumerate(noted):
        torques, errors = range(3), range(len(values) - 3, len(values))
        for name, places in (("torque", torques), ("error", errors)):
            for leg, place in enumerate(places, 1):
                middle = float(proven.tracking[f"{name}_{leg}"][k])
                bound = float(proven.tracking[f"{name}_{leg}_bound"][k])
                # The bound of the ball has the radius of the value in it.
                value = arb(values[place]).mid()
                assert Fraction(bound) >= most_from(middle, value, bounds_of[place])
    most = max(
        abs(Fraction(float(x))) + Fraction(float(r))
        for leg in (1, 2, 3)
        for x, r in zip(
            proven.tracking[f"error_{leg}"],
            proven.tracking[f"error_{leg}_bound"],
            strict=True,
        )
    )
    assert Fraction(proven.tracking_error) >= most
    line = next(x for x in repr(proven).splitlines() if "tracking error" in x)
    assert Fraction(re.search(rf"above ({NUMBER}) rad", line)[1]) >= most
    path = tmp_path / "tube.csv"
    given = ["certify", "reach", "--duration", "0.01", "--bound", "1e-4"]
    given += ["--control", "pd", "--control-period", "5e-3", "--noise", "1e-6", "1e-4"]
    assert main([*given, "--tracking", str(path)]) == 0
    assert capsys.readouterr().out
    compare_table(path, proven.tracking)


def test_what_is_printed_saved_and_drawn_of_a_zone_is_outward(tmp_path, capsys):
    zone = certify_zone("general", tilt=0.6, torsion=0.6, max_boxes=3000)
    text = repr(zone)
    kinds = {"proven": zone.proven, "refuted": zone.refuted, "open": zone.open}
    figure = plot_zone(zone)
    for words in (text, figure.get_suptitle()):
        for kind, share in kinds.items():
            said = Fraction(re.search(rf"({NUMBER}) % {kind}", words)[1]) / 100
            assert said >= share if kind == "open" else said <= share
    for name, share in zone.refuted_by.items():
        said = re.search(rf"({NUMBER}) % {re.escape(name)}", text)
        assert said is None or Fraction(said[1]) <= 100 * Fraction(share)
    least = re.search(rf"det J2\)\s+above ({NUMBER})", text)[1]
    assert Fraction(least) <= Fraction(zone.least_det_j2)
    sine = re.search(rf"sin\(mu\)\s+above ({NUMBER})", text)[1]
    assert Fraction(sine) <= Fraction(zone.least_sine_mu)
    with mp.workdps(40):
        away = re.search(rf", ({NUMBER}) deg from", text)[1]
        assert mpf(away) >= mpf(zone.nearest.distance) * 180 / mp.pi
    extent = re.findall(rf"({NUMBER}) to ({NUMBER}) rad", text)
    assert [float(x) for x in np.ravel(extent)] == [
        -math.pi, math.pi, 0.0, 0.6, -0.6, 0.6,
    ]  # fmt: skip
    path = tmp_path / "zone.csv"
    degrees = ["--tilt", "10", "--torsion", "10", "--out", str(path)]
    assert main(["zone", "general", *degrees]) == 0
    assert capsys.readouterr().out
    cap = math.radians(10.0)
    compare_table(path, certify_zone("general", tilt=cap, torsion=cap).columns)


def test_colours_of_a_zone_do_not_say_more_than_is_proven():
    zone = certify_zone("general", tilt=0.6, torsion=0.6, max_boxes=3000)
    figure = plot_zone(zone)
    proven, unknown = (axes.collections[0] for axes in figure.axes[:2])
    geometry = Geometry.of(zone.scene)
    directions, triangles = triangle_directions(geometry, ZONE_DIVISIONS)
    turns = np.degrees(zone.turns_at(directions))
    for mesh, index, outward in ((proven, 2, min), (unknown, 1, max)):
        shown = mesh.get_array()
        for value, triangle in zip(shown, triangles, strict=True):
            assert value == outward(turns[triangle, index])
    assert proven.get_array().max() > 0.0


def test_numbers_are_written_outward_whatever_they_are():
    rng = np.random.default_rng(52)
    for number in (10.0 ** rng.uniform(-300, 300, 500)).tolist():
        for digits in (2, 4, 12, 15):
            assert Fraction(balls.write_up(number, digits)) >= Fraction(number)
            assert Fraction(balls.write_down(number, digits)) <= Fraction(number)
    shares = [0.0, 1.0, 0.1, math.nextafter(0.1, 0.0), *rng.uniform(0.0, 1.0, 300)]
    for share in map(float, shares):
        up, down = (f(share, 6) for f in (balls.percent_up, balls.percent_down))
        assert Fraction(up.removesuffix(" %")) >= 100 * Fraction(share)
        assert Fraction(down.removesuffix(" %")) <= 100 * Fraction(share)
        with mp.workdps(60):
            said = balls.degrees_up(share, 4).removesuffix(" deg")
            assert mpf(said) >= mpf(share) * 180 / mp.pi
    assert balls.percent_down(1.0, 6) == "100 %"


UPWARD = {"x86_64": 0x800, "AMD64": 0x800, "aarch64": 0x400000}  # FE_UPWARD of fenv.h


@pytest.mark.skipif(
    sys.platform != "linux" or platform.machine() not in UPWARD,
    reason="fesetround of another platform",
)
@pytest.mark.parametrize("name", ["certify", "simulate"])
def test_another_rounding_mode_is_refused(name):
    program = f"""
import ctypes
from sst_ros import InputError, certify, simulate
from sst_ros.proof.balls import precision
ctypes.CDLL("libm.so.6").fesetround({UPWARD[platform.machine()]})
try:
    {name}("example2", duration=0.01)
except InputError as error:
    print(error)
try:
    with precision():
        pass
except InputError as error:
    print(error)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=100
    )
    lines = done.stdout.splitlines()
    assert len(lines) == 2, done.stderr
    assert all("rounding mode" in line and "to nearest" in line for line in lines)
