# SPDX-License-Identifier: Apache-2.0
"""
Many robots for reinforcement learning
======================================

A vector environment of gymnasium: reach desired angles by three torques, 500 steps a
second.
"""

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from sst_ros import Batch, load_scene

SCENE = load_scene("reach").with_values({"torque": None})
HOME, SPREAD = np.array(SCENE.initial.gamma), 0.1  # [rad]
PERIOD, LONGEST = 2e-3, 500  # of a step [s], of an episode [steps]
LARGEST_TORQUE = 5.0  # [N m]


class StarTriangles(VectorEnv):
    """Robots at random starts; a robot that leaves its limits is truncated."""

    def __init__(self, num_envs=64, scene=SCENE):
        self.num_envs = num_envs
        self.metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}
        observed = gymnasium.spaces.Box(-np.inf, np.inf, (9,), np.float64)
        action = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float64)
        self.single_observation_space, self.single_action_space = observed, action
        self.observation_space = batch_space(observed, num_envs)
        self.action_space = batch_space(action, num_envs)
        start = np.tile(HOME, (num_envs, 1))
        self._session = Batch(scene).start(start, step=PERIOD)
        self._desired = start.copy()
        self._count = np.zeros(num_envs, dtype=int)
        self._ended = np.zeros(num_envs, dtype=bool)

    def reset(self, *, seed=None, options=None):
        """Start all robots again."""
        super().reset(seed=seed)
        self._begin(np.ones(self.num_envs, dtype=bool))
        return self._observe(), {}

    def step(self, actions):
        """Apply torques for a period; robots that ended in the last one begin again."""
        begin = self._ended
        state = self._session.step(LARGEST_TORQUE * np.asarray(actions, dtype=float))
        self._count += 1
        if begin.any():
            self._begin(begin)
        error = state.gamma - self._desired
        reward = np.where(begin, 0.0, -np.einsum("ij,ij->i", error, error))
        self._ended = ~begin & ((state.code != 0) | (self._count >= LONGEST))
        terminated = np.zeros(self.num_envs, dtype=bool)
        return self._observe(), reward, terminated, self._ended.copy(), {}

    def _begin(self, chosen):
        shape = (np.count_nonzero(chosen), 3)
        self._desired[chosen] = HOME + self.np_random.uniform(-SPREAD, SPREAD, shape)
        start = HOME + self.np_random.uniform(-SPREAD, SPREAD, shape)
        self._session.reset(chosen, start)
        self._count[chosen] = 0

    def _observe(self):
        state = self._session.state
        return np.hstack([state.gamma, state.gamma_dot, self._desired])


if __name__ == "__main__":
    robots = StarTriangles()
    observed, _ = robots.reset(seed=1)
    for _ in range(LONGEST - 1):
        error = observed[:, :3] - observed[:, 6:]
        torques = -20.0 * error - 4.0 * observed[:, 3:6]
        observed, *_ = robots.step(np.clip(torques / LARGEST_TORQUE, -1.0, 1.0))
    print(f"largest error after a second: {np.abs(error).max():.3f} rad")
