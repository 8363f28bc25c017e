# SPDX-License-Identifier: Apache-2.0
"""Many robots for reinforcement learning
======================================

A vector environment of gymnasium: reach desired angles by three torques, 500 steps a
second.
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from sst_ros import Batch, load_scene

SCENE = load_scene("reach")
HOME, SPREAD = np.array(SCENE.initial.gamma), 0.1
STEP, SUBSTEPS, LONGEST = 2e-3, 1, 500
MOST = 5.0  # torque [N m]


class StarTriangles(VectorEnv):
    """Robots at random starts; a robot that leaves its limits is truncated."""

    def __init__(self, num_envs: int = 64) -> None:
        self.num_envs = num_envs
        self.metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}
        self.single_observation_space = gymnasium.spaces.Box(
            -np.inf, np.inf, (9,), np.float64
        )
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float64)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        start = np.tile(HOME, (num_envs, 1))
        self._session = Batch(SCENE.with_values({"torque": None})).start(
            start, step=STEP, substeps=SUBSTEPS
        )
        self._desired = start.copy()
        self._count = np.zeros(num_envs, dtype=int)
        self._ended = np.zeros(num_envs, dtype=bool)

    def reset(
        self, *, seed: Any = None, options: Any = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start all robots again."""
        super().reset(seed=seed)
        self._begin(np.ones(self.num_envs, dtype=bool))
        return self._observe(), {}

    def step(self, actions: np.ndarray) -> tuple[Any, ...]:
        """Apply torques for a step; robots that ended in the last one begin again."""
        again = self._ended.copy()
        self._session.step(MOST * np.asarray(actions, dtype=float))
        if again.any():
            self._begin(again)
        self._count += 1
        self._count[again] = 0
        observed = self._observe()
        reward = np.where(
            again, 0.0, -np.square(observed[:, :3] - observed[:, 6:]).sum(axis=1)
        )
        truncated = (self._session.state.code != 0) | (self._count >= LONGEST)
        self._ended = truncated & ~again
        return (
            observed,
            reward,
            np.zeros(self.num_envs, dtype=bool),
            self._ended.copy(),
            {},
        )

    def _begin(self, chosen: np.ndarray) -> None:
        shape = (np.count_nonzero(chosen), 3)
        self._desired[chosen] = HOME + self.np_random.uniform(-SPREAD, SPREAD, shape)
        self._session.reset(
            chosen, HOME + self.np_random.uniform(-SPREAD, SPREAD, shape)
        )
        self._count[chosen], self._ended[chosen] = 0, False

    def _observe(self) -> np.ndarray:
        state = self._session.state
        return np.hstack([state.gamma, state.gamma_dot, self._desired])


if __name__ == "__main__":
    robots = StarTriangles()
    seen, _ = robots.reset(seed=1)
    for _ in range(LONGEST - 1):
        wanted = 20.0 * (seen[:, 6:] - seen[:, :3]) - 4.0 * seen[:, 3:6]
        seen, rewards, *_ = robots.step(np.clip(wanted / MOST, -1.0, 1.0))
    print(
        "largest error after a second:"
        f" {np.abs(seen[:, :3] - seen[:, 6:]).max():.3f} rad"
    )
