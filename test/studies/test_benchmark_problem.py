# SPDX-License-Identifier: Apache-2.0
"""The benchmark problem: its statement is enough to check its data, and both methods
agree.
"""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from sst_ros.report.reference_solution import InitialValueProblem
from sst_ros.scene.scene import load
from studies import DOCS
from studies.benchmark_problem import COLUMNS, DIGITS, NAME, page, solve_apart

DATA = DOCS / "benchmark_problem.csv"
AXES = np.eye(3)
W = np.roll(AXES, 1, axis=0)  # z, x, y
STAR, ACTUATED, INTERMEDIATE = (
    np.diag([0.39, 0.39, 0.26]),
    np.array(
        [[0.018375, 0, -0.011697888], [0, 0.03675, 0], [-0.011697888, 0, 0.018375]]
    ),
    np.diag([9e-6, 0.009609, 0.009609]),
)


@pytest.fixture(scope="module")
def rows():
    head, *lines = DATA.read_text(encoding="utf-8").splitlines()
    assert head.split(",") == list(COLUMNS)
    assert {
        len(x.partition(".")[2]) for line in lines for x in line.split(",")[1:]
    } == {DIGITS}
    return np.array([list(map(float, line.split(","))) for line in lines])


def test_the_page_has_the_statement_of_its_generator():
    text = (DOCS / "benchmark_problem.md").read_text(encoding="utf-8")
    statement = page(load(NAME)).partition("## Reference and results")[0]
    assert len(statement) > 2000 and text.startswith(statement)
    for number in (
        "0.39",
        "0.26",
        "0.018375",
        "0.03675",
        "-0.011697888",
        "9e-06",
        "0.009609",
    ):
        assert f" {number} " in statement
    assert "5 \\sin(12\\, t + \\pi/2)" in statement


def test_the_start_is_that_of_the_statement(rows):
    r, s = np.array([1, 1, 0]) / np.sqrt(2), np.full(3, 1 / np.sqrt(3))
    t = np.cross(s, r) / np.linalg.norm(np.cross(s, r))
    start = Rotation.from_quat(rows[0, 4:8]).as_matrix()
    np.testing.assert_allclose(
        start, np.stack([np.cross(t, s), t, s], axis=1), atol=1e-12
    )
    np.testing.assert_allclose(rows[0, 1:4], np.pi / 4, atol=1e-13)


def test_loops_are_closed_and_the_torques_do_the_work(rows):
    """By the statement alone: frames from the rows, rates by splines of them."""
    t, gamma, rotation = (
        rows[:, 0],
        rows[:, 1:4],
        Rotation.from_quat(rows[:, 4:8]).as_matrix(),
    )
    turned = np.radians([0.0, 120.0, 240.0])
    e = np.stack([-np.sin(turned), np.cos(turned), 0 * turned], axis=1)
    normals = np.einsum("nij,kj->nki", rotation, e)
    across = np.cross(W, AXES)
    r = np.cos(gamma)[..., None] * AXES + np.sin(gamma)[..., None] * across
    assert np.abs((r * normals).sum(axis=2)).max() < 1e-12
    bodies = [(rotation, STAR)]
    for k in range(3):
        w = np.broadcast_to(W[k], r[:, k].shape)
        for axis, inertia in ((w, ACTUATED), (normals[:, k], INTERMEDIATE)):
            second = np.cross(axis, r[:, k])
            bodies.append((np.stack([r[:, k], second, axis], axis=2), inertia))
    energy = np.zeros(len(t))
    for frames, inertia in bodies:
        spin = np.einsum("nji,njk->nik", frames, CubicSpline(t, frames).derivative()(t))
        rate = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
        energy += 0.5 * np.einsum("ni,ij,nj->n", rate, inertia, rate)
    phase = np.array([0.0, np.pi / 2, np.pi / 2])
    torque = np.array([4.0, 5.0, 3.0]) * np.sin(t[:, None] * [18.0, 12.0, 24.0] + phase)
    power = (torque * CubicSpline(t, gamma).derivative()(t)).sum(axis=1)
    work = CubicSpline(t, power).antiderivative()(t)
    assert energy[5:-5].max() > 0.5
    np.testing.assert_allclose(energy[5:-5], work[5:-5], atol=2e-4 * energy.max())


@pytest.mark.slow
def test_the_papers_equations_by_scipy_give_the_rows(rows):
    problem = InitialValueProblem(load(NAME), 10_000_000)
    found, quaternions = solve_apart(problem.scene, problem.times[:21], 1e-11)
    np.testing.assert_allclose(found[:, :3], rows[:21, 1:4], atol=1e-10)
    sign = np.sign((quaternions * rows[:21, 4:8]).sum(axis=1))[:, None]
    np.testing.assert_allclose(sign * quaternions, rows[:21, 4:8], atol=1e-10)
