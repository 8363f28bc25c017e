# SPDX-License-Identifier: Apache-2.0
"""Parameters of a hundred scenarios of a scene, for what varying them costs."""

from __future__ import annotations

import numpy as np

from sst_ros.scene.scene import Link, Scene, Star

COUNT = 100
TENSOR = ("xx", "yy", "zz", "xy", "xz", "yz")
STAR, BODIES = "numba, 1 thread, star.inertia varied", "numba, 1 thread, all bodies varied"


def parameters(scene: Scene) -> dict[str, dict[str, np.ndarray]]:
    """Numbers that differ between scenarios: rotations and stretches of all bodies, by a little."""
    rng = np.random.default_rng(2)
    bodies: dict[str, Star | Link] = {"star": scene.star}
    bodies |= {f"actuated_links[{k}]": link for k, link in enumerate(scene.actuated_links)}
    bodies |= {f"intermediate_links[{k}]": link for k, link in enumerate(scene.intermediate_links)}
    turn = rng.uniform(-1.0, 1.0, (COUNT, 1)) * (1.0, -1.0, 0.0)
    everything = {
        "base.v": scene.base.v + rng.uniform(-1e-3, 1e-3, (COUNT, 3, 3)),
        "star.alpha_deg": scene.star.alpha_deg + turn,
    }
    for name, body in bodies.items():
        if body.inertia is not None:
            size = 0.1 * (body.inertia.xx + body.inertia.yy + body.inertia.zz)
            for i, key in enumerate(TENSOR):
                rows = size * ((i < 3) + rng.uniform(-0.1, 0.1, COUNT))
                everything[f"{name}.inertia.{key}"] = getattr(body.inertia, key) + rows
    star = {f"star.inertia.{key}": everything[f"star.inertia.{key}"] for key in TENSOR[:3]}
    return {STAR: star, BODIES: everything}
