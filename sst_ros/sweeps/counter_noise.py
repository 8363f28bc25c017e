# SPDX-License-Identifier: Apache-2.0
"""Normal noise from a counter: number c of row i depends on the seed, i and c alone.

The bits are those of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014), started anew for each number;
a pair of them becomes a normal number by the method of Box and Muller (1958).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

SOURCE = """\
def mixed(x):
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
"""
GAUSSIAN = """\
def gaussian(seed, row, counter):
    step = np.uint64(0x9E3779B97F4A7C15)
    stream = mixed(mixed(np.uint64(seed) + step) + np.uint64(row) * step)
    first = mixed(stream + np.uint64(2 * counter + 1) * step)
    second = mixed(stream + np.uint64(2 * counter + 2) * step)
    u = (np.float64(first >> np.uint64(11)) + 0.5) * 1.1102230246251565e-16
    v = (np.float64(second >> np.uint64(11)) + 0.5) * 1.1102230246251565e-16
    return sqrt(-2.0 * np.log(u)) * cos(6.283185307179586 * v)
"""


def gaussian(seed: int, rows: NDArray[np.int64], counter: int) -> NDArray[np.float64]:
    """Return standard normal numbers `counter` of rows, shape (n,), as the kernel computes them."""
    names: dict[str, Any] = {"np": np, "sqrt": np.sqrt, "cos": np.cos}
    text = GAUSSIAN.replace("np.float64(", "np.asarray(").replace("np.uint64(row)", "row")
    exec(SOURCE + text, names)
    with np.errstate(over="ignore"):
        return np.asarray(names["gaussian"](seed, np.asarray(rows).astype(np.uint64), counter))
