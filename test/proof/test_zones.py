# SPDX-License-Identifier: Apache-2.0
"""Proven zones against the paper's kinematics in plain NumPy, at random geometries.

`Manipulator` has the arcs as arcs and joint angles as angles between them; the loops
are closed by Newton's method on r_k . R e_k = 0. Nothing of it is taken from the
package.
"""

import math
import re
from decimal import Decimal
from functools import cache

import numpy as np
import pytest
from slow_cases import slow_except

from sst_ros import (
    AssemblyError,
    InputError,
    certify_zone,
    load_scene,
    plot_zone,
)
from sst_ros.__main__ import main
from sst_ros.proof import zones

pytest.importorskip("flint")
ARCS = (84.94, 80.84, 81.33)  # of general's triangle, nearly [deg]
FOLDED = (
    70.0,
    85.0,
    205.0,
)  # arcs of a star whose workspace has parallel singularities
GAMMA_OF_FOLDED = (0.89225757, 0.50032271, 0.46337763)
FOLDED_POSE = (0.04457781, 0.52252451, 0.51388802, 0.67889621)


class Manipulator:
    """A manipulator by its corners and the arcs of its star [deg]."""

    def __init__(self, v, alpha_deg, beta_max_deg=90.0):
        self.v = [np.array(row) / math.sqrt(sum(x * x for x in row)) for row in v]
        self.beta_max = math.radians(beta_max_deg)
        turns = np.radians([0.0, alpha_deg[0], alpha_deg[0] + alpha_deg[1]])
        self.e = [np.array([-math.sin(x), math.cos(x), 0.0]) for x in turns]

    def side(self, k):
        return self.v[k], self.v[(k + 1) % 3]

    def carriage(self, k, gamma):
        """The point of the arc P_k P_k+1 at the angle gamma from P_k."""
        begin, end = self.side(k)
        across = end - begin * (begin @ end)
        across = across / np.linalg.norm(across)
        return math.cos(gamma) * begin + math.sin(gamma) * across

    def describe(self, rotation):
        """Least distance to a limit [rad], det J2, sines of mu, least singular value of
        J2.

        The carriage is where the plane of the star's arc meets that of the base arc, on
        the side of the arc where E is: r.s = cos(beta) and r is no farther than
        beta_max.
        """
        s, margins, rows, sines = rotation[:, 2], [], [], []
        for k in range(3):
            begin, end = self.side(k)
            normal = np.cross(begin, end)
            normal = normal / np.linalg.norm(normal)
            t = rotation @ self.e[k]
            r = np.cross(t, normal)
            sines.append(np.linalg.norm(r))
            r = r / sines[-1]
            across = end - begin * (begin @ end)
            gamma = math.atan2(r @ across / np.linalg.norm(across), r @ begin)
            arc = math.acos(begin @ end)
            # From r to s about t: beta is positive where E is on the triangle's side.
            beta = math.atan2(np.cross(r, s) @ -t, r @ s)
            if s @ normal < 0.0:
                beta = -abs(beta)
            margins += [gamma, arc - gamma, beta, self.beta_max - beta]
            rows.append(-np.cross(r, t))
        j2 = np.array(rows)
        sigma = np.linalg.svd(j2, compute_uv=False)[2]
        return min(margins), np.linalg.det(j2), min(sines), sigma

    def assemblies(self, gamma, rng, tries=60):
        """Rotations closing the loops at gamma, from many starts of Newton."""
        r = np.array([self.carriage(k, gamma[k]) for k in range(3)])
        found = []
        for _ in range(tries):
            rotation = random_rotation(rng)
            for _ in range(30):
                t = np.array([rotation @ e for e in self.e])
                gaps = np.sum(r * t, axis=1)
                if abs(gaps).max() < 1e-13:
                    break
                turn = np.linalg.lstsq(np.cross(t, r), -gaps, rcond=None)[0]
                length = np.linalg.norm(turn)
                rotation = turned(turn * min(1.0, 0.5 / max(length, 1e-9))) @ rotation
            else:
                continue
            if all(abs(rotation - other).max() > 1e-6 for other in found):
                found.append(rotation)
        return found


def turned(vector):
    """Rotation by a rotation vector."""
    angle = np.linalg.norm(vector)
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * k + (1.0 - math.cos(angle)) * (k @ k)


def random_rotation(rng):
    q, upper = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(upper))
    return q if np.linalg.det(q) > 0.0 else -q


def tilted(reference, azimuth, tilt, torsion):
    """The pose whose E is tilted and which is turned about it, by rotation vectors."""
    axis = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    return reference @ turned(tilt * axis) @ turned(np.array([0.0, 0.0, torsion]))


def pose_in(zone, row, rng):
    """A random pose of a box of a cap."""
    low, high = (
        [zone.columns[f"{name}_{end}"][row] for name in zone.names]
        for end in ("low", "high")
    )
    return tilted(zone.reference, *rng.uniform(low, high))


def rows_of(zone, status, count, rng):
    """Random boxes of a status, the larger the likelier."""
    rows = np.flatnonzero(zone.columns["status"] == status)
    share = zone.columns["share"][rows]
    return rng.choice(rows, count, p=share / share.sum())


def draw_alpha(rng, alpha, width):
    first, second = (x + width * rng.uniform(-1.0, 1.0) for x in alpha[:2])
    return first, second, 360.0 - first - second


def corners_of_arcs(arcs_deg):
    """Corners of the spherical triangle with arcs 1-2, 2-3, 3-1, by the cosine rule."""
    a12, a23, a31 = np.radians(arcs_deg)
    cosine = (math.cos(a23) - math.cos(a12) * math.cos(a31)) / (
        math.sin(a12) * math.sin(a31)
    )
    angle = math.acos(cosine)  # at P1
    third = [
        math.cos(a31), math.sin(a31) * math.cos(angle), math.sin(a31) * math.sin(angle),
    ]  # fmt: skip
    return [[1.0, 0.0, 0.0], [math.cos(a12), math.sin(a12), 0.0], third]


def cases():
    """Scenes, ranges, and how a geometry of the ranges is drawn."""
    general = load_scene("general")
    v, alpha = general.base.v, general.star.alpha_deg

    def of_star(rng):
        return Manipulator(v, draw_alpha(rng, alpha, 0.1))

    yield "star", general, {"star.alpha_deg": 0.1}, of_star

    def of_directions(rng):
        moved = [[x + 2e-3 * rng.uniform(-1.0, 1.0) for x in row] for row in v]
        return Manipulator(moved, draw_alpha(rng, alpha, 0.1))

    yield "v", general, {"star.alpha_deg": 0.1, "base.v": 2e-3}, of_directions
    by_arcs = general.with_values({"base": {"arcs_deg": list(ARCS), "radius": 0.35}})

    def of_arcs(rng):
        arcs = [x + 0.1 * rng.uniform(-1.0, 1.0) for x in ARCS]
        return Manipulator(
            corners_of_arcs(arcs), draw_alpha(rng, alpha, 0.1), 90 + rng.uniform(-1, 1)
        )

    ranges = {"base.arcs_deg": 0.1, "star.alpha_deg": 0.1, "workspace.beta_max_deg": 1}
    yield "arcs", by_arcs, ranges, of_arcs
    start = {"initial.gamma": GAMMA_OF_FOLDED, "initial.orientation": FOLDED_POSE}
    folded = general.with_values({"star.alpha_deg": FOLDED, **start})

    def of_folded(rng):
        return Manipulator(v, draw_alpha(rng, FOLDED, 0.05))

    yield "folded", folded, {"star.alpha_deg": 0.05}, of_folded


CASES = {name: rest for name, *rest in cases()}
CAP = {"tilt": 0.7, "torsion": 0.9, "max_boxes": 40_000}


@cache
def zone_of(name):
    scene, ranges, _ = CASES[name]
    return certify_zone(scene, ranges=ranges, **CAP)


@pytest.mark.parametrize("name", slow_except(["folded"], CASES))
def test_random_poses_and_geometries_are_regular_where_proven(name):
    scene, ranges, draw = CASES[name]
    zone = certify_zone(scene, ranges=ranges, **CAP)
    assert zone.proven > 0.02 and zone.proven + zone.refuted > 0.8
    rng = np.random.default_rng(51)
    least = np.full(3, np.inf)
    signs = set()
    for row in rows_of(zone, 1, 1500, rng):
        margin, det_j2, sine_mu, sigma = draw(rng).describe(pose_in(zone, row, rng))
        assert margin > 0.0 and sigma > 1e-4
        signs.add(np.sign(det_j2))
        least = np.minimum(least, [margin, abs(det_j2), sine_mu])
    assert len(signs) == 1
    assert least[1] >= zone.least_det_j2 and least[2] >= zone.least_sine_mu
    assert least[0] < 0.02  # the zone goes on nearly to the limits


@pytest.mark.parametrize("name", slow_except(["folded"], CASES))
def test_no_refuted_pose_is_regular_at_the_given_geometry(name):
    scene, zone = CASES[name][0], zone_of(name)
    exact = Manipulator(scene.base.v, scene.star.alpha_deg)
    _, side, _, _ = exact.describe(zone.reference)
    rng = np.random.default_rng(52)
    for row in rows_of(zone, -1, 1000, rng):
        margin, det_j2, _, _ = exact.describe(pose_in(zone, row, rng))
        assert margin < 1e-9 or det_j2 * side < 1e-9
    by_j2 = zone.refuted_by["parallel singularity"]
    assert (by_j2 > 0.01) == (name == "folded")


@pytest.mark.slow
def test_a_cap_is_proven_up_to_the_nearest_limit():
    # The least tilt that meets a limit, by bisection on many azimuths.
    scene = load_scene("general")
    exact = Manipulator(scene.base.v, scene.star.alpha_deg)
    reference = certify_zone(scene, tilt=0.01, torsion=0.01).reference
    low, high = 0.0, 1.0
    while high - low > 1e-6:
        tilt = 0.5 * (low + high)
        poses = (
            tilted(reference, azimuth, tilt, torsion)
            for azimuth in np.linspace(0.0, 2.0 * math.pi, 721)
            for torsion in (-0.05, 0.0, 0.05)
        )
        inside = all(exact.describe(pose)[0] > 0.0 for pose in poses)
        low, high = (tilt, high) if inside else (low, tilt)
    assert certify_zone(scene, tilt=low - 0.01, torsion=0.05).success
    beyond = certify_zone(scene, tilt=low + 0.01, torsion=0.05, max_boxes=30_000)
    assert not beyond.success and beyond.refuted > 0.0
    assert beyond.nearest.distance < low + 0.02


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [pytest.param(0.0, marks=pytest.mark.slow), 0.1])
def test_random_angles_of_a_box_have_a_regular_assembly(tolerance):
    scene = load_scene("general")
    box = np.array([[0.25, 1.2], [0.3, 1.1], [0.3, 1.15]])
    zone = certify_zone(scene, box, ranges={"star.alpha_deg": tolerance})
    assert zone.proven > 0.6
    rng = np.random.default_rng(53)
    low = np.column_stack([zone.columns[f"gamma_{k}_low"] for k in (1, 2, 3)])
    high = np.column_stack([zone.columns[f"gamma_{k}_high"] for k in (1, 2, 3)])
    for row in rows_of(zone, 1, 60, rng):
        gamma = rng.uniform(low[row], high[row])
        alpha = draw_alpha(rng, scene.star.alpha_deg, tolerance)
        manipulator = Manipulator(scene.base.v, alpha)
        described = [
            manipulator.describe(rotation)
            for rotation in manipulator.assemblies(gamma, rng)
        ]
        (only,) = (found for found in described if found[0] > 0.0)
        _, det_j2, sine_mu, sigma = only
        assert sigma > 1e-4 and abs(det_j2) >= zone.least_det_j2
        assert sine_mu >= zone.least_sine_mu


def test_angles_beyond_a_stroke_are_refuted():
    zone = certify_zone("general", [[-0.1, 1.0], [0.5, 0.9], [0.5, 0.9]])
    share = zone.refuted_by["gamma_1 < 0"]
    assert 0.05 < share < 0.1 / 1.1 < zone.refuted
    gamma = np.array([[-0.05, 0.7, 0.7], [0.6, 0.7, 0.7], [3.0, 0.7, 0.7]])
    assert zone.status_of(gamma).tolist() == [-1, 1, 0]


@pytest.mark.slow
def test_without_the_slope_of_det_j2_singular_poses_seem_regular(monkeypatch):
    # What the proof rests on: without its terms the random poses find singular ones.
    scene, ranges, draw = CASES["folded"]
    rng = np.random.default_rng(54)

    def worst():
        zone = certify_zone(scene, ranges=ranges, max_boxes=60_000)
        exact = Manipulator(scene.base.v, scene.star.alpha_deg)
        _, side, _, _ = exact.describe(zone.reference)
        ratios = []
        for row in rows_of(zone, 1, 3000, rng):
            _, det_j2, _, _ = draw(rng).describe(pose_in(zone, row, rng))
            ratios.append(det_j2 * math.copysign(1.0, side))
        return min(ratios)

    assert worst() > 0.0
    find = zones.determinant_and_slope

    def without_slope(vectors, rotation):
        determinant, slope = find(vectors, rotation)
        return determinant, 0.0 * slope

    monkeypatch.setattr(zones, "determinant_and_slope", without_slope)
    monkeypatch.setattr(zones, "CURVATURE", 0.0)
    assert worst() < 0.0


def test_vectors_of_a_geometry_lie_within_their_tolerance():
    scene, ranges, draw = CASES["arcs"]
    with zones.precision():
        balls = zones.range_balls(
            zones.WrittenDocument.of(scene), ranges, own_torque=True, origin="test"
        )
        tolerant = zones.enclose_geometry(scene, balls)
    rng, most = np.random.default_rng(55), 0.0
    for _ in range(300):
        manipulator = draw(rng)
        for rows, middle, tolerance in (
            (manipulator.v, tolerant.vectors.v, tolerant.tolerance.v),
            (manipulator.e, tolerant.vectors.e, tolerant.tolerance.e),
        ):
            chord = np.linalg.norm(np.array(rows) - middle, axis=1)
            angle = 2.0 * np.arcsin(0.5 * chord)
            assert np.all(angle <= tolerance)
            most = max(most, float(np.max(angle / tolerance)))
    assert most > 0.7


def test_more_boxes_prove_more_and_shares_are_one():
    small, large = (
        certify_zone("general", tilt=0.6, torsion=0.6, max_boxes=n)
        for n in (2_000, 20_000)
    )
    assert small.proven < large.proven and small.open > large.open
    for zone in (small, large):
        assert zone.proven + zone.refuted + zone.open == 1.0
        assert zone.columns["share"].sum() == 1.0 and zone.examined <= 20_000
        assert sum(zone.refuted_by.values()) == zone.refuted


def test_tolerances_narrow_what_is_proven():
    exact, wide = (
        certify_zone("general", tilt=0.6, torsion=0.6, max_boxes=20_000, ranges=ranges)
        for ranges in ({}, {"star.alpha_deg": 1.0})
    )
    assert wide.proven < exact.proven and wide.least_sine_mu < 1.0
    assert wide.refuted <= exact.refuted + 0.01


def test_printed_shares_are_rounded_outward():
    zone = certify_zone("general", tilt=0.6, torsion=0.6, max_boxes=5_000)
    text = repr(zone)
    shares = {
        name: Decimal(number)
        for number, name in re.findall(r"([\d.]+) % (proven|refuted|open)", text)
    }
    assert shares["proven"] <= 100 * Decimal(zone.proven)
    assert shares["refuted"] <= 100 * Decimal(zone.refuted)
    assert shares["open"] >= 100 * Decimal(zone.open)
    least = re.search(r"det J2\)\s+above ([\d.e-]+)", text)[1]
    assert Decimal(least) <= Decimal(zone.least_det_j2)
    away = re.search(r"< \S+, ([\d.]+) deg|arc, ([\d.]+) deg", text)
    number = next(filter(None, away.groups()))
    assert Decimal(number) >= Decimal(math.degrees(zone.nearest.distance))


@pytest.mark.slow
def test_directions_are_shown_on_the_triangle():
    scene = load_scene("general")
    zone = certify_zone(scene, tilt=0.5, torsion=1.0, max_boxes=20_000)
    s = np.array([zone.reference[:, 2], -zone.reference[:, 2]])
    turns = zone.turns_at(s)
    assert turns[0].sum() == pytest.approx(2.0) and turns[1].sum() == 0.0
    exact = Manipulator(scene.base.v, scene.star.alpha_deg)
    inside = [
        exact.describe(tilted(zone.reference, 0.0, 0.0, x))[0] > 0.0
        for x in np.linspace(-1.0, 1.0, 2001)
    ]
    assert turns[0, 2] <= 2.0 * np.mean(inside) <= turns[0, 2] + turns[0, 1] + 2e-3
    pytest.importorskip("matplotlib")
    for drawn in (zone, certify_zone(scene, [[0.5, 1.0], [0.5, 0.9], [0.5, 1.0]])):
        figure = plot_zone(drawn)
        assert drawn.shares in figure.get_suptitle()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"tilt": 0.0}, "tilt = 0.0: must be > 0"),
        ({"tilt": 3.2}, "tilt = 3.2: must be > 0 and at most 3 rad"),
        ({"torsion": math.inf}, "torsion = inf: must be > 0 and at most pi"),
        ({"max_boxes": 0}, "max_boxes = 0: must be from 1"),
        ({"orientation": [0, 0, 0, 0]}, "orientation = .*must be a quaternion"),
        ({"orientation": [0, 0, 0, 1]}, "orientation = .*must be inside all limits"),
        (
            {"gamma_box": [[1, 0], [0, 1], [0, 1]]},
            "gamma_box = .*least and the largest",
        ),
        ({"gamma_box": np.eye(3)}, "gamma_box = .*least and the largest"),
        ({"gamma_box": [[0.5, 1]] * 3, "tilt": 0.1}, "leave them out with gamma_box"),
        (
            {"ranges": {"star.mass": 0.1}},
            "ranges = 'star.mass': is no part of the geom",
        ),
        ({"ranges": {"star.alpha": 0.1}}, "ranges = 'star.alpha'"),
        ({"ranges": {"base.v": 0.9}}, "must move no axis by more than 0.3 rad"),
    ],
)
def test_what_is_no_zone_is_refused(arguments, words):
    with pytest.raises(InputError, match=words):
        certify_zone("general", **arguments)


def test_a_reference_pose_must_be_one():
    with pytest.raises(AssemblyError):
        certify_zone("general", [[0.01, 0.02], [1.3, 1.31], [0.01, 0.02]])


def test_the_command_proves_draws_and_writes(tmp_path, capsys):
    picture, table = tmp_path / "zone.png", tmp_path / "zone.csv"
    cap = ["general", "--tilt", "10", "--torsion", "10"]
    ranges = ["--ranges", "star.alpha_deg=0.1", "base.v=digits"]
    out = ["--picture", str(picture), "--out", str(table)]
    assert main(["zone", *cap, *ranges]) == 1  # a digit of v is half of one
    assert "star.alpha_deg" not in capsys.readouterr().out
    assert main(["zone", *cap, *ranges[:2], *out]) == 0
    assert "100 % proven" in capsys.readouterr().out
    assert picture.stat().st_size > 0 and "azimuth_low" in table.read_text()
    assert main(["zone", *cap, *out]) == 1  # they exist
    box = ["general", "--gamma-box", "30", "50", "30", "50", "30", "50"]
    assert main(["zone", *box]) == 0
    assert main(["zone", *box, "--tilt", "3"]) == 1
    assert "leave them out" in capsys.readouterr().err
