# SPDX-License-Identifier: Apache-2.0
# mypy: disable-error-code="no-untyped-def, no-untyped-call, name-defined"
"""Steps, and loops around them, as text that `compiled_method` puts behind a scene's functions.

They run on lists as plain Python and on arrays under numba. Names that are not defined here come
from the module that `compiled_module` writes.
"""
# ruff: noqa: F821

from __future__ import annotations

from collections.abc import Callable, Sequence

from sst_ros.integration.methods import Tableau

INFINITE = float("inf")

GROW, SHRINK, SAFETY = 5.0, 0.2, 0.9
"""Largest and least factor by which a step changes; share of the step that the error allows."""


def step_pair(parts, t, h, y, z, d, p, new_y, new_z, error):
    """Advance the solution y by a step of h, and a second one, z, by two of h / 2.

    The second one needs three parts; of one part there is only the first. Returns the size of the
    local error estimate of y, relative to a tolerance of 1.
    """
    middle = vector(SIZE)
    other = vector(SIZE)
    for part in range(parts):  # one call: the compiler puts the step here once
        begin, length = t, 0.5 * h
        if part == 0:
            length, old, near, new, local = h, y, y, new_y, error
        elif part == 1:
            old, near, new, local = z, y, middle, other
        else:
            begin, old, near, new, local = t + 0.5 * h, middle, middle, new_z, other
        attempt(begin, length, old, near, d, p, new, local)
    if DOUBLING and parts == 3:  # the method has no estimate of its own
        for i in range(SIZE):
            error[i] = (new_z[i] - z[i]) - (new_y[i] - y[i])
    size = size_of(error, y, new_y, h)
    normalise(new_y)
    if parts == 1:
        return size
    second = size_of(other, middle, new_z, h)
    normalise(new_z)
    return size if second < INFINITE else INFINITE


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


def step_many(
    first, end, lengths, drives, starts, p, tolerance, y, z, ranges, joints, run, reached
):
    """Go on from period `first` to `end`; leave off before one that asks for more, and return it.

    That is one in which a step is rejected, a limit may be met, or more is done than is allowed.
    One row of `lengths` and `drives` is for all periods. Where starts[k] has numbers and not NaN,
    period k begins there. y, z, joints (nine angles, nine rates) and `run` become those at the
    begin of the period that is returned, and reached[k] the solutions at the end of period k. `run`
    has the longest next step [s], attempts and steps until now, and the next period; then
    what is allowed: longest step [s], attempts until the method is looked at, and steps; then the
    time at which periods begin [s], the parts of a step, and the local error estimate of the last.
    """
    now_y, now_z, new_y, new_z = vector(SIZE), vector(SIZE), vector(SIZE), vector(SIZE)
    error, now_joints, new_joints = vector(SIZE), vector(18), vector(18)
    for k in range(first, end):
        h, d = lengths[k % len(lengths)], drives[k % len(drives)]
        longest, attempts, steps = run[0], run[1], run[2]
        if len(starts) > 0 and starts[k][0] == starts[k][0]:
            copy(starts[k], y)
            copy(starts[k], z)
            joints_of(y, p, joints)
        copy(y, now_y)
        copy(z, now_z)
        copy(joints, now_joints)
        t, last = 0.0, False
        while not last:
            length = min(longest, run[4], h - t)
            last = (h - t) - length < 1e-3 * length
            if last:
                length = h - t
            counted = 1.0 if IMPLICIT or not last else 0.0
            if attempts + counted > run[5] or steps >= run[6]:
                return k
            begin, parts = run[7] + t, int(run[8])
            size = step_pair(parts, begin, length, now_y, now_z, d, p, new_y, new_z, error)
            run[9] = size
            if not size <= tolerance:
                return k
            joints_of(new_y, p, new_joints)
            if not all_far(ranges, now_joints, new_joints, length):
                return k
            copy(new_y, now_y)
            copy(new_z, now_z)
            copy(new_joints, now_joints)
            longest = next_length(longest, length, size / tolerance, ERROR_ORDER, last)
            steps, attempts, t = steps + 1.0, attempts + counted, t + length
        copy(now_y, y)
        copy(now_z, z)
        copy(now_joints, joints)
        run[0], run[1], run[2], run[3] = longest, attempts, steps, k + 1.0
        if len(reached) > 0:
            copy(y, reached[k][0])
            copy(z, reached[k][1])
    return end


def next_length(longest: float, h: float, error: float, error_order: float, cut: bool) -> float:
    """Longest step after an accepted one of h with a local error, relative to the tolerance.

    A step that was cut does not say that the next must be shorter than the `longest` of before.
    """
    length = h * step_factor(error, error_order)
    return max(longest, length) if cut else length


def step_factor(error: float, error_order: float) -> float:
    """Factor for the next step after one with a local error, relative to the tolerance."""
    if error == 0.0:
        return GROW
    if not error < INFINITE:
        return SHRINK
    factor: float = SAFETY * error ** (-1.0 / (error_order + 1))
    return min(max(factor, SHRINK), GROW)


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
    at `near`: y itself, or for the second solution the first one, which is near. Beside a kink of a
    force the two may lie on different sides; the Jacobian is that of the first one.
    """
    matrix = rows(SIZE, SIZE)
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


def explicit_step(tableau: Tableau, size: int, drive: int, *more: str) -> str:
    """Source of `attempt` of an explicit Runge-Kutta method: a step of h from t and y.

    It calls `rhs(t, y0, .., d0, ..)` of the state y and of the drive d, which is constant over the
    step, and fills in the new state and the local error estimate of each number of the state, zero
    where the method has none.

    Args:
        tableau: coefficients of the method.
        size: numbers in the state.
        drive: numbers in the drive.
        more: further arguments, which `rhs` has as well.

    Of RK4, three of its lines a stage and the last ones:

        def attempt(t, h, y, near, d, p, new_y, error):
            y0 = y[0]
            d0 = d[0]
            k0_0, k0_1, ... = rhs(t, y0, y1, ..., d0, d1, d2, p)
            s0 = y0 + h * (0.5 * k0_0)
            s1 = y1 + h * (0.5 * k0_1)
            k1_0, k1_1, ... = rhs(t + 0.5 * h, s0, s1, ..., d0, d1, d2, p)
            n0 = y0 + h * (0.16666666666666666 * k0_0 + 0.3333333333333333 * k1_0 + ...)
            e0 = 0.0
            new_y[0] = n0
            error[0] = e0

    """
    y, d = [f"y{j}" for j in range(size)], [f"d{i}" for i in range(drive)]

    def weigh(weights: Sequence[float], j: int) -> str:
        return combination(weights, lambda stage: f"k{stage}_{j}")

    lines = [f"{name} = y[{j}]" for j, name in enumerate(y)]
    lines += [f"{name} = d[{i}]" for i, name in enumerate(d)]
    for stage, row in enumerate(tableau.a):
        lines += [f"s{j} = y{j} + h * ({weigh(row, j)})" for j in range(size) if stage]
        at = [f"s{j}" for j in range(size)] if stage else y
        time = f"t + {tableau.c[stage]!r} * h" if tableau.c[stage] else "t"
        slopes = ", ".join(f"k{stage}_{j}" for j in range(size))
        lines.append(f"{slopes} = rhs({', '.join([time, *at, *d, *more])})")
    for j in range(size):
        lines.append(f"n{j} = y{j} + h * ({weigh(tableau.b, j)})")
        if not tableau.error:
            lines.append(f"e{j} = 0.0")
        elif not tableau.damping:
            lines.append(f"e{j} = h * ({weigh(tableau.error, j)})")
        else:
            # Hairer's estimate for DOP853, each number of the state for itself.
            lines.append(f"fine = {weigh(tableau.error, j)}")
            lines.append(f"coarse = {weigh(tableau.damping, j)}")
            lines.append("both = fine * fine + 0.01 * (coarse * coarse)")
            lines.append(f"e{j} = h * fine * abs(fine) / sqrt(both) if both > 0.0 else 0.0")
    lines += [f"new_y[{j}] = n{j}" for j in range(size)]
    lines += [f"error[{j}] = e{j}" for j in range(size)]
    return "\n    ".join(["def attempt(t, h, y, near, d, p, new_y, error):", *lines]) + "\n"


def combination(weights: Sequence[float], word: Callable[[int], str]) -> str:
    """Sum of weights times words, without the zeros; "" where there is nothing else."""
    terms = [f"{w!r} * {word(i)}" for i, w in enumerate(weights) if w]
    return " + ".join(terms).replace("+ -", "- ")
