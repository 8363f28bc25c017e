# SPDX-License-Identifier: Apache-2.0
# mypy: disable-error-code="no-untyped-def, no-untyped-call, name-defined"
"""Loops around a step, as text: `compiled_method` puts them behind the functions of a scene.

They run on lists as plain Python and on arrays under numba. Names that are not defined here come
from the module that `codegen` writes.
"""
# ruff: noqa: F821

from __future__ import annotations


def step_pair(t, h, y, z, d, p, new_y, new_z, error):
    """Advance y by two steps of h / 2 and the coarse solution z by one of h (Richardson).

    Returns the size of the local error estimate of y, relative to a tolerance of 1.
    """
    middle = vector(SIZE)
    other = vector(SIZE)
    attempt(t, 0.5 * h, y, y, d, p, middle, error)
    first = size_of(error, y, middle, h)
    attempt(t + 0.5 * h, 0.5 * h, middle, middle, d, p, new_y, error)
    second = size_of(error, middle, new_y, h)
    attempt(t, h, z, y, d, p, new_z, other)
    # In proportion, so that it counts only where the longer step is unstable.
    coarse = size_of(other, z, new_z, h) * SHARE
    normalise(new_y)
    normalise(new_z)
    return max(first + second, coarse)


def size_of(error, old, new, h):
    """Largest error relative to what it is an error of; infinite where it has no value.

    Quaternion: absolute. Rate: relative to its length, but not below 1e-3 rad a step, so that rest
    can be reached. Lagging torques: relative to the largest of them. Work is not looked at.
    """
    largest = 0.0
    for i in range(4):
        largest = max(largest, abs(error[i]))
    length, floor, worst = 0.0, 1e-3 / abs(h), 0.0
    for i in range(4, 7):
        length = max(length, abs(old[i]), abs(new[i]))
        worst = max(worst, abs(error[i]))
    largest = max(largest, worst / max(length, floor))
    torque, worst = 1e-300, 0.0
    for i in range(7, 7 + LAG):
        torque = max(torque, abs(old[i]), abs(new[i]))
        worst = max(worst, abs(error[i]))
    largest = max(largest, worst / torque)
    total = 0.0
    for i in range(SIZE):
        total += new[i] + error[i]
    return largest if total - total == 0.0 else INFINITE


def normalise(y):
    """Give the quaternion length 1."""
    factor = 1.0 / sqrt(y[0] * y[0] + y[1] * y[1] + y[2] * y[2] + y[3] * y[3])
    for i in range(4):
        y[i] = y[i] * factor


def step_fixed(t, h, count, y, d, p, new_y):
    """Advance y by `count` steps of h; the error estimates are not looked at."""
    error = vector(SIZE)
    for i in range(SIZE):
        new_y[i] = y[i]
    for k in range(count):
        attempt(t + k * h, h, new_y, new_y, d, p, new_y, error)
        normalise(new_y)


def step_many(count, h, tolerance, y, z, d, p, ranges, joints, sizes):
    """Go on by up to `count` periods of h, a pair of steps each; return how many were done.

    Stops before a period that asks for more than that: one whose error is beyond the tolerance, or
    in which a limit may be met. y, z and joints (nine angles, nine rates) become those at the end
    of the last period that was done; sizes[k] is the local error estimate of period k.
    """
    new_y = vector(SIZE)
    new_z = vector(SIZE)
    error = vector(SIZE)
    found = vector(18)
    for k in range(count):
        size = step_pair(0.0, h, y, z, d, p, new_y, new_z, error)
        if not size <= tolerance:
            return k
        joints_of(new_y, p, found)
        if not all_far(ranges, joints, found, h):
            return k
        for i in range(SIZE):
            y[i] = new_y[i]
            z[i] = new_z[i]
        for i in range(18):
            joints[i] = found[i]
        sizes[k] = size
    return count


def step_sequence(first, lengths, drives, p, tolerance, starts, y, z, ranges, joints, reached):
    """Do what `step_many` does for periods of their own lengths and drives, from the first on.

    Where starts[k] has numbers and not NaN, period k begins there. reached[k] becomes the solution
    and the coarse solution at its end. Returns the period that asks for more than a pair of steps.
    """
    size = vector(1)
    for k in range(first, len(lengths)):
        if starts[k][0] == starts[k][0]:
            for i in range(SIZE):
                y[i] = starts[k][i]
                z[i] = starts[k][i]
            joints_of(y, p, joints)
        if step_many(1, lengths[k], tolerance, y, z, drives[k], p, ranges, joints, size) == 0:
            return k
        for i in range(SIZE):
            reached[k][0][i] = y[i]
            reached[k][1][i] = z[i]
    return len(lengths)


def all_far(ranges, begin, end, h):
    """Test quickly that no limit may have been crossed in h.

    That is so where a joint is inside before and after, and its rate has not turned, or the joint
    is farther from the limits than it would come in ten times h.
    """
    for row in ranges:
        joint = int(row[0])
        if not (row[1] < begin[joint] < row[2] and row[1] <= end[joint] <= row[2]):
            return False
        if begin[joint + 9] * end[joint + 9] < 0.0:
            reach = 10.0 * h * max(abs(begin[joint + 9]), abs(end[joint + 9]))
            least, most = min(begin[joint], end[joint]), max(begin[joint], end[joint])
            if not (row[1] + reach < least and most < row[2] - reach):
                return False
    return True


def attempt_linearly_implicit(t, h, y, near, d, p, new_y, error):
    """One step of a Rosenbrock method (Hairer & Wanner, Solving ODEs II, section IV.7).

    The last stage is what the solution adds to the embedded one. The Jacobian is exact, and that
    at `near`: y itself, or for the coarse solution the fine one, which is near. Beside a kink of a
    force the two may lie on different sides; the Jacobian is that of the fine one.
    """
    matrix = square(SIZE)
    slope = vector(SIZE)
    by_time = vector(SIZE)
    pivot = vector(SIZE)
    linearise(t, near, d, p, slope, by_time, matrix)
    for i in range(SIZE):
        for j in range(SIZE):
            matrix[i][j] = -matrix[i][j]
        matrix[i][i] += 1.0 / (GAMMA * h)
    factorise(matrix, pivot)
    u = rows(STAGES, SIZE)
    at = vector(SIZE)
    right = vector(SIZE)
    for stage in range(STAGES):
        for i in range(SIZE):
            at[i] = y[i]
        for j in range(stage):
            for i in range(SIZE):
                at[i] += STAGE_A[stage][j] * u[j][i]
        evaluate(t + STAGE_ALPHA[stage] * h, at, d, p, slope)
        for i in range(SIZE):
            right[i] = slope[i] + h * STAGE_D[stage] * by_time[i]
            for j in range(stage):
                right[i] += STAGE_C[stage][j] / h * u[j][i]
        substitute(matrix, pivot, right)
        for i in range(SIZE):
            u[stage][i] = right[i]
    for i in range(SIZE):
        new_y[i] = at[i] + u[STAGES - 1][i]
        error[i] = u[STAGES - 1][i]


def linearise(t, y, d, p, slope, by_time, matrix):
    """Fill in the derivative and its own by time and state, each column of it in a row."""
    found = jacobian(t, *y, *d)
    for i in range(SIZE):
        slope[i] = found[i]
        by_time[i] = found[SIZE + i]
        for j in range(SIZE):
            matrix[i][j] = found[(j + 2) * SIZE + i]


def factorise(a, pivot):
    """LU decomposition with partial pivoting, in place."""
    for k in range(SIZE):
        best = k
        for i in range(k + 1, SIZE):
            if abs(a[i][k]) > abs(a[best][k]):
                best = i
        pivot[k] = best
        if best != k:
            for j in range(k, SIZE):
                a[k][j], a[best][j] = a[best][j], a[k][j]
        for i in range(k + 1, SIZE):
            factor = a[i][k] / a[k][k]
            a[i][k] = factor
            for j in range(k + 1, SIZE):
                a[i][j] -= factor * a[k][j]


def substitute(a, pivot, b):
    """Solve with the decomposition of `factorise`, in place."""
    for k in range(SIZE):
        best = int(pivot[k])
        b[k], b[best] = b[best], b[k]
        for i in range(k + 1, SIZE):
            b[i] -= a[i][k] * b[k]
    for k in range(SIZE - 1, -1, -1):
        for j in range(k + 1, SIZE):
            b[k] -= a[k][j] * b[j]
        b[k] /= a[k][k]
