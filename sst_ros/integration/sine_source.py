# SPDX-License-Identifier: Apache-2.0
"""The sine by arithmetic alone: compilers leave SIMD where they meet a call of a library."""

from __future__ import annotations


def flat_sin(x: float) -> float:
    """Return sin(x) to about one unit in the last place of x or of the result, for |x| < 1e15.

    As many times pi as there are in x are taken off in three parts, of which the first two have so
    few digits that their products are exact (W. J. Cody and W. Waite, Software Manual for the
    Elementary Functions, 1980); then comes Taylor's series, whose next term is below 1e-18.
    """
    # To add and subtract 1.5 * 2**52 rounds to an integer.
    turns = (x * 0.3183098861837907 + 6755399441055744.0) - 6755399441055744.0
    half = (0.5 * turns + 6755399441055744.0) - 6755399441055744.0
    odd = turns - 2.0 * half
    r = x - turns * 3.1415926534682512
    r = r - turns * 1.2154201012607932e-10
    r = r - turns * 4.044532497591901e-21
    z = r * r
    tail = 1.0 / 355687428096000.0 - z * (1.0 / 121645100408832000.0 - z / 51090942171709440000.0)
    tail = 1.0 / 6227020800.0 - z * (1.0 / 1307674368000.0 - z * tail)
    tail = 1.0 / 362880.0 - z * (1.0 / 39916800.0 - z * tail)
    tail = 1.0 / 6.0 - z * (1.0 / 120.0 - z * (1.0 / 5040.0 - z * tail))
    return (1.0 - 2.0 * odd * odd) * (r - r * z * tail)
