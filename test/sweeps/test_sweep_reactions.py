# SPDX-License-Identifier: Apache-2.0
"""Reactions of many runs against those of each run alone."""

import numpy as np
import pytest

from sst_ros import load_scene, simulate, sweep
from sst_ros.dynamics.reactions import LINK_JOINTS, SIZES
from sst_ros.sweeps.sweep import EXTREME_PARTS


def test_peaks_and_rms_of_runs_are_those_of_each_alone():
    scene = load_scene("gravity_payload")
    turned = [np.array(scene.base.v) + shift for shift in (0.0, 0.03)]
    vary = {
        "payload.mass": [0.5, 1.2],
        "actuated_links.mass": [0.2, 0.25],
        "friction.gamma.viscous": [0.1, 0.3],
        "base.v": turned,
    }
    given = {
        "duration": 0.3,
        "steps": EXTREME_PARTS,
        "outputs": ("reactions",),
        "progress": False,
    }
    table = sweep(scene.with_values({"friction.gamma.viscous": 0.1}), vary, **given)
    assert len(table) == 16
    for row in (0, 6, 15):
        chosen = table.iloc[row]
        v = [[chosen[f"base.v[{k}][{axis}]"] for axis in range(3)] for k in range(3)]
        own = scene.with_values(
            {name: chosen[name] for name in vary if name != "base.v"} | {"base.v": v}
        )
        figures = simulate(own, duration=0.3, samples=EXTREME_PARTS).reactions.figures
        for name in LINK_JOINTS:
            for size, unit in SIZES.items():
                expected = figures[name][size]
                for part in ("peak", "rms"):
                    columns = [f"{size}_{name}_{part}_{leg}" for leg in (1, 2, 3)]
                    found = chosen[columns].to_numpy(dtype=float)
                    assert found == pytest.approx(
                        getattr(expected, part), rel=1e-6, abs=1e-9
                    )
                    assert table.attrs["units"][columns[0]] == unit


@pytest.mark.slow
def test_motors_of_controlled_runs_give_the_commanded_torques():
    """Without friction and springs the torque about an actuator's axis is that of its
    motor.
    """
    scene = load_scene("reach").with_values({"friction": None})
    control = {"mode": "computed_torque", "bandwidth": 20.0, "period": 0.01}
    table = sweep(
        scene, {"payload.mass": [0.6, 1.0]}, control=control,
        outputs=("gamma", "reactions"), progress=False,
    )  # fmt: skip
    for leg in (1, 2, 3):
        found = table[f"axis_torque_actuated_peak_{leg}"].to_numpy()
        assert found == pytest.approx(table[f"torque_max_{leg}"].to_numpy(), rel=0.02)
