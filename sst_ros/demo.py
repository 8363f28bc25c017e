# SPDX-License-Identifier: Apache-2.0
"""The runs of the demos, through real nodes; the command evaluates their recordings."""

from __future__ import annotations

import math
import select
import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sst_ros.control.reference_motions import reference_motion
from sst_ros.errors import SstError
from sst_ros.runtime import child_process
from sst_ros.scene.scene import load

EXAMPLES = ("example1", "example2")
FOLLOWED = "reach"
DEMO_MODES = ("feedforward", "feedforward_pd")
"""The first is the paper's double check: only the torques of the inverse dynamics."""

_HOLD_S = 0.3
_DEMO_RATE = 500
_READY_S = 60.0  # a first start compiles, on a busy machine for half a minute
_DEMO_END_S = 100.0
"""Time beside the run that a node may take: a busy machine starts one in 40 s."""


def record(name: str, folder: Path) -> Path:
    """Play a scene's torques to its simulator, and record the run.

    The nodes are processes of their own. The run goes by the clock, and in lockstep: to
    the same bits however busy the machine is. The bag in `folder` takes the place of an
    earlier one. An SstError names a node that failed or did not end in time.
    """
    seconds = load(name).duration or 1.0
    run = {"scene": name, "duration": seconds}
    return _record(folder, run, "torque_player", {"scene": name}, seconds + _DEMO_END_S)


def follow(name: str, folder: Path, mode: str, *, model: str | None = None) -> Path:
    """Have the controller node follow a scene's motion in lockstep, and record the run.

    The controller's model and motion are those of the scene `model`, by default the
    plant's own. Bag and errors are as with `record`; a scene without a motion is
    refused before the folder is touched.
    """
    motion = reference_motion(load(model or name))
    seconds = math.ceil((motion.duration + _HOLD_S) * _DEMO_RATE) / _DEMO_RATE
    run = {
        "scene": name,
        "duration": seconds,
        "publish_rate": _DEMO_RATE,
        "real_time_factor": 0.0,
    }
    followed = {
        "scene": model or name,
        "mode": mode,
        "hold": _HOLD_S,
        "rate": _DEMO_RATE,
    }
    followed |= {"feedforward_at": "middle", "wait_for_recorder": True}
    return _record(
        folder, run, "inverse_dynamics", followed, 20.0 * seconds + _DEMO_END_S
    )


def _record(
    folder: Path,
    run: dict[str, object],
    command: str,
    process_options: dict[str, object],
    most_s: float,
) -> Path:
    """Record a run of the simulator under the commands of a node.

    All end by themselves.
    """
    bag = folder / "bag"
    if bag.exists():
        shutil.rmtree(bag)
    folder.mkdir(parents=True, exist_ok=True)
    with _node("recorder", _DEMO_END_S, output=str(bag), timeout=_READY_S) as recorder:
        with _node("simulator", _DEMO_END_S, sync="lockstep", **run):
            # One line when it receives all topics, none where it gives up, or is stuck.
            output = recorder.stdout
            assert output is not None  # a pipe
            readable, _, _ = select.select([output], [], [], 2.0 * _READY_S)
            if not readable or not output.readline():
                text = (
                    "the recorder received nothing from a simulator within"
                    f" {_READY_S:g} s"
                )
                raise SstError(text)
            with _node(
                command, most_s, stamped=True, min_subscribers=2, **process_options
            ):
                pass
        recorder.send_signal(signal.SIGINT)
    return bag


@contextmanager
def _node(
    command: str, end_s: float, **process_options: object
) -> Iterator[subprocess.Popen[str]]:
    """Run a node beside a block.

    After the block the node ends within a time [s], or an SstError is raised.
    """
    with child_process.run_beside(
        command, process_options, stdout=subprocess.PIPE
    ) as process:
        yield process
        try:
            status = process.wait(end_s)
        except subprocess.TimeoutExpired:
            raise SstError(f"{command} did not end within {end_s:g} s") from None
        if status != 0:
            raise SstError(f"{command} failed with status {status}")
