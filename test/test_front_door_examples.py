# SPDX-License-Identifier: Apache-2.0
"""What a first user wants, in few lines."""

import numpy as np
import pytest

OWN = """
from sst_ros import load_scene, simulate
scene = load_scene("general").with_values({"star.alpha_deg": [110, 120, 130],
    "base.v": [[1, 0, 0], [0.1, 1, 0], [0, 0.1, 1]], "gravity.acceleration": [0, 0, -9.81],
    "payload.mass": 0.2, "payload.centre": [0, 0, 0.2], "friction.gamma.viscous": 0.05})
motion = simulate(scene, lambda t: (0.3 * t, -0.2, 0.1), 0.1, initial=([0.7, 0.8, 0.75], [0] * 3))
print(motion.gamma.shape, motion.message)
motion.plot().savefig("motion.png")
"""

MONTE_CARLO = """
import numpy as np
import matplotlib.pyplot as plt
from sst_ros import Batch, load_scene
scene, random = load_scene("example2_heavy"), np.random.default_rng(1)
batch = Batch(scene, profile=True, parameters={"star.inertia.zz": random.normal(0.26, 0.01, 2000)})
runs = batch.run(random.normal(0.785, 0.05, (2000, 3)), (0.0, 0.0, 0.0), step=0.02, count=50)
left = np.char.startswith(runs.message, "gamma")
print("fraction that leaves the stroke:", left.mean())
plt.hist([runs.gamma[~left, 0], runs.gamma[left, 0]], bins=40, stacked=True)
plt.savefig("ends.png")
"""


@pytest.mark.parametrize(
    ("text", "most", "picture"),
    [
        (OWN, 8, "motion.png"),
        pytest.param(MONTE_CARLO, 10, "ends.png", marks=pytest.mark.slow),
    ],
)
def test_it_takes_few_lines_and_draws(text, most, picture, tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    if "Batch" in text:
        pytest.importorskip("numba", reason="a batch needs numba")
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(text, names)
    assert len(text.strip().splitlines()) <= most
    assert (tmp_path / picture).stat().st_size > 1000
    print(capsys.readouterr().out)
    if "motion" in names:
        assert names["motion"].success
        assert np.all(np.isfinite(names["motion"].gamma))
    else:
        runs = names["runs"]
        left = names["left"]
        assert 0 < left.sum() < len(runs)
        assert np.all(runs.status[left] == 1)
