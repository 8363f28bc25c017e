# SPDX-License-Identifier: Apache-2.0
"""Source of the search for the limit that a step passes first, and when.

The distance over a step is a cubic in its values and rates at both ends (Hermite). Its error is at
most h^4 max|d^(4)| / 384. A step that ends outside is found, and one that leaves and comes back.
"""

from __future__ import annotations

import numpy as np

from sst_ros.integration.events import GRAZING
from sst_ros.integration.simd_source import Layout, indented, loop
from sst_ros.mechanism.geometry import Array

EARLIEST = 1e-8
"""Least share of a step at which a crossing is reported, so that its time lies in this step."""


def whole_steps(time: Array, step: float) -> Array:
    """Return how many steps ended before a time at which a limit was passed [s]."""
    return np.asarray(np.ceil(time / step - 0.1 * EARLIEST) - 1.0)


def crossings(count: int, at: Layout) -> list[str]:
    """Lines that find which limit a step passes first, in `found`, and at which share of it.

    `was` and `far` hold distances and rates at both ends. Few steps pass one, so lanes only test
    the tangents there, which lie below a curve that turns; what is found is examined lane by lane.

    Args:
        count: number of limits.
        at: of the block, with rows was, far (2 count each), code, hit, found, share.

    Ten lines, the last three of the search:

        for i in range(32):
            before = block[2016 + i]
            falling = h * block[2592 + i]
            after = block[3168 + i]
            rising = h * block[3744 + i]
            tangents = before * rising - falling * after + falling * rising
            hit = 1.0 if tangents < 0.0 else hit
        for k in range(32):
            if block[4416 + k] > 0.0:
                for j in range(18):

    """
    test = ["hit = 0.0"]
    for j in range(count):
        test += [
            f"before = {at.lane('was', j)}",
            f"falling = h * {at.lane('was', count + j)}",
            f"after = {at.lane('far', j)}",
            f"rising = h * {at.lane('far', count + j)}",
            "tangents = before * rising - falling * after + falling * rising",
            "tangents = tangents if falling < 0.0 else 1.0",
            "tangents = tangents if rising > 0.0 else 1.0",
            "hit = 1.0 if tangents < 0.0 else hit",
            f"hit = 1.0 if after < {-GRAZING} else hit",
        ]
    code, lanes = at.lane("code"), at.lanes
    test += [
        f"{at.lane('hit')} = hit if {code} == 0.0 else 0.0",
        f"{at.lane('found')} = 0.0",
        f"{at.lane('share')} = 1.0",
    ]
    was, far = at.first("was"), at.first("far")
    search = [
        f"for j in range({count}):",
        f"    before = block[{was} + j * {lanes} + k]",
        f"    falling = h * block[{was + count * lanes} + j * {lanes} + k]",
        f"    after = block[{far} + j * {lanes} + k]",
        f"    rising = h * block[{far + count * lanes} + j * {lanes} + k]",
        "    square = 3.0 * (after - before) - 2.0 * falling - rising",
        "    cube = falling + rising - 2.0 * (after - before)",
        "    root = square * square - 3.0 * cube * falling",
        "    root = sqrt(root) if root > 0.0 else 0.0",
        "    turns = 1.0 if falling < 0.0 else 0.0",
        "    turns = turns if rising > 0.0 else 0.0",
        "    high = -falling / (square + root) if turns > 0.0 else 1.0",
        f"    high = 1.0 if after < {-GRAZING} else high",
        "    least = before + high * (falling + high * (square + high * cube))",
        "    least = after if after < 0.0 else least",
        f"    if least < {-GRAZING}:",
        "        low = 0.0",
        "        for trial in range(52):",
        "            middle = 0.5 * (low + high)",
        "            value = before + middle * (falling + middle * (square + middle * cube))",
        "            low = middle if value >= 0.0 else low",
        "            high = high if value >= 0.0 else middle",
        f"        earlier = 1.0 if {at.lane('found', 0, 'k')} == 0.0 else 0.0",
        f"        earlier = 1.0 if high < {at.lane('share', 0, 'k')} else earlier",
        "        if earlier > 0.0:",
        f"            {at.lane('found', 0, 'k')} = j + 1.0",
        f"            {at.lane('share', 0, 'k')} = high if high > {EARLIEST} else {EARLIEST}",
    ]
    return [
        *loop(at, test),
        "hits = 0.0",
        f"for k in range({lanes}):",
        f"    hits = hits + {at.lane('hit', 0, 'k')}",
        "if hits > 0.0:",
        f"    for k in range({lanes}):",
        f"        if {at.lane('hit', 0, 'k')} > 0.0:",
        *indented(12, search),
    ]
