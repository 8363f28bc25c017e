# SPDX-License-Identifier: Apache-2.0
"""Vector environment: gymnasium's own checker, truncation at limits, equal seeds."""

import runpy

import numpy as np
import pytest
from docs.blocks import ROOT

gymnasium = pytest.importorskip("gymnasium", reason="needs gymnasium")


@pytest.fixture(scope="module")
def robots_of():
    """The class of the example."""
    return runpy.run_path(str(ROOT / "examples" / "vector_env.py"))["StarTriangles"]


@pytest.mark.filterwarnings("ignore:.*A Box observation space m(in|ax)imum value")
def test_one_robot_passes_gymnasiums_checker(robots_of):
    """The checker knows single environments: one of one robot, begun again by its
    caller.
    """

    class Single(gymnasium.Env):
        def __init__(self):
            self.robots = robots_of(1)
            self.observation_space = self.robots.single_observation_space
            self.action_space = self.robots.single_action_space

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            observed, info = self.robots.reset(seed=seed, options=options)
            return observed[0], info

        def step(self, action):
            observed, reward, ended, truncated, info = self.robots.step(
                np.array([action])
            )
            return (
                observed[0],
                float(reward[0]),
                bool(ended[0]),
                bool(truncated[0]),
                info,
            )

    from gymnasium.utils.env_checker import check_env

    check_env(Single(), skip_render_check=True)


def test_robots_beyond_limits_are_truncated_and_begin_again(robots_of):
    robots = robots_of(8)
    observed, _ = robots.reset(seed=3)
    assert observed in robots.observation_space
    push = np.zeros((8, 3))
    push[5] = (1.0, -1.0, 1.0)
    for _ in range(400):
        _, reward, ended, truncated, _ = robots.step(push)
        assert not ended.any() and np.isfinite(reward).all()
        if truncated.any():
            break
    assert np.flatnonzero(truncated).tolist() == [5]
    observed, reward, _, truncated, _ = robots.step(push)
    assert not truncated.any() and reward[5] == 0.0
    assert np.abs(observed[5, :3] - np.pi / 4).max() < 0.2
    assert observed in robots.observation_space
