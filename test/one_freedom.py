# SPDX-License-Identifier: Apache-2.0
"""Example 1 reduced by its symmetry to one coordinate, x = gamma_k - pi/4 of every leg."""

import numpy as np


def inertia(scene, x):
    """M1(x) of 2 T / 3 = M1 x_dot^2 [kg m^2]; x may be complex."""
    star = scene.star.inertia
    drive, link = scene.actuated_links[0].inertia, scene.intermediate_links[0].inertia
    d, c = 2.0 - np.cos(2 * x), np.cos(x)
    return star.zz / d**2 + drive.zz + link.yy + 2.0 * link.xx * c**2 / d**2


def slope(scene, x):
    """d M1 / dx, to rounding."""
    return inertia(scene, x + 1e-20j).imag / 1e-20
