# SPDX-License-Identifier: Apache-2.0
"""The motion of a recorded run, to be done again."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sst_ros.control.actuator_motions import MotionSamples
from sst_ros.errors import InputError, Problem


def samples(bag: str | Path) -> MotionSamples:
    """Read what the actuators did in a run, from the first sample that has an orientation.

    Raises:
        InputError: it is no recording of a run, or it has fewer than two such samples.

    """
    from sst_ros.recording.recording import read  # needs rosbags, which other motions do not

    run = read(bag)
    whole = np.flatnonzero(np.isfinite(run.quaternion).all(axis=1))
    if len(whole) < 2:
        problem = Problem("orientation", len(whole), "two samples or more must have one")
        raise InputError(str(bag), [problem])
    first = whole[0]
    x, y, z, w = run.quaternion[first].tolist()
    return MotionSamples(
        run.seconds[first:], run.gamma[first:], run.gamma_dot[first:], (x, y, z, w)
    )
