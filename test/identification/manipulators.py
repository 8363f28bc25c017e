# SPDX-License-Identifier: Apache-2.0
"""Scenes with exciting motions, and runs under a digital controller, as a node records
them.
"""

import dataclasses

import numpy as np

from sst_ros import (
    Controller,
    ControllerSettings,
    InverseDynamics,
    load_scene,
    reference_motion,
    simulate,
)
from sst_ros.scene.loads import DesiredMotion, Sweep

PERIOD = 5e-4
FRICTION = {
    "friction.gamma.viscous": 0.2,
    "friction.gamma.coulomb": 0.2,
    "friction.gamma.smoothing": 0.1,
    "friction.mu.viscous": 0.01,
    "friction.beta.viscous": 0.05,
}


def sweeping(scene, seconds=2.5, speed=0.5):
    """The scene with three chirps as its motion."""
    first, last = (3.0, 4.3, 5.1), (5.0, 3.1, 7.0)
    motion = Sweep(
        amplitude=(0.2, 0.25, 0.22),
        frequency=tuple(speed * x for x in first),
        last_frequency=tuple(speed * x for x in last),
        fade=0.5,
        duration=seconds,
    )
    motion = DesiredMotion(sweep=motion)
    return dataclasses.replace(scene, motion=motion, torque=None, duration=seconds)


def thin_arcs():
    return sweeping(load_scene("example2"))


def general():
    """General geometry, three different links of each kind, gravity and friction."""
    masses = {"star.mass": 2.0, "star.centre": [0.02, 0.01, 0.2]}
    for k in range(3):
        masses |= {
            f"actuated_links[{k}].mass": 0.3,
            f"actuated_links[{k}].centre": [0.1, 0.02, 0],
        }
    field = {"gravity.acceleration": [3.0, 4.0, 8.0]}
    return sweeping(load_scene("general").with_values(masses | field | FRICTION))


def payload():
    return sweeping(load_scene("gravity_payload"))


def run(plant, model=None, period=PERIOD, mode="feedforward_pd"):
    """The trajectory of a plant that follows its motion by a controller with a model of
    it.
    """
    settings = ControllerSettings(mode=mode, feedforward_at="middle", bandwidth=60.0)
    controller = Controller(model or plant, reference_motion(plant), settings, period)
    count = round(plant.duration / period)
    return simulate(
        plant, controller, t_eval=np.arange(count + 1) * period, control_period=period,
        tolerance=1e-12,
    )  # fmt: skip


def states(motion, times):
    """Quaternion, W and W_dot of a motion, each shape (n, ...)."""
    references = [motion.at(t) for t in np.asarray(times).tolist()]
    names = ("quaternion", "body_rate", "body_acceleration")
    return tuple(np.array([getattr(one, name) for one in references]) for name in names)


def torques(scene, quaternion, rate, acceleration):
    """Torques of the inverse dynamics, shape (n, 3)."""
    inverse = InverseDynamics(scene)
    rows = zip(quaternion, rate, acceleration, strict=True)
    return np.array([inverse.torque(*row) for row in rows])


def wrong(scene, seed=0, share=0.2):
    """The scene with every link's inertia wrong by up to `share`, masses alike."""
    rng = np.random.default_rng(seed)
    factors = iter(
        1.0 + share * rng.choice([-1.0, 1.0], 20) * rng.uniform(0.5, 1.0, 20)
    )

    def scaled(body, factor):
        parts = body.inertia and dataclasses.asdict(body.inertia)
        inertia = parts and type(body.inertia)(
            **{k: factor * v for k, v in parts.items()}
        )
        return dataclasses.replace(body, inertia=inertia, mass=factor * body.mass)

    links = {}
    for kind in ("actuated_links", "intermediate_links"):
        given = getattr(scene, kind)
        alike = given[0] == given[1] == given[2]
        factor = next(factors)
        links[kind] = tuple(
            scaled(link, factor if alike else next(factors)) for link in given
        )
    return dataclasses.replace(scene, star=scaled(scene.star, next(factors)), **links)
