# SPDX-License-Identifier: Apache-2.0
"""The runs of the demos, through real nodes; the command evaluates their recordings."""

from __future__ import annotations

import math
import select
import shutil
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from sst_ros.control.reference_motions import reference_motion
from sst_ros.errors import SstError
from sst_ros.host import child_process
from sst_ros.scene import scene

EXAMPLES = ("example1", "example2")
FOLLOWED = "reach"
MODES = ("feedforward", "feedforward_pd")
HOLD_S = 0.3
CONTROL_RATE = 500
_READY_S = 60.0  # a first start compiles, on a busy machine for half a minute
_END_S = 30.0


def record_examples(out: Path) -> Iterator[tuple[Path, Path]]:
    """Record both examples into `out`; yield each bag and the folder of its results.

    Example 2 is the main job and lies in `out` itself, Example 1 in `out`/example1.
    """
    for name in EXAMPLES:
        folder = out if name == "example2" else out / name
        bag = empty_bag(folder)
        print(f"{name}: {scene.load(name).description}", flush=True)
        record(name, bag)
        yield bag, folder


def record_feedforward(
    out: Path, name: str = FOLLOWED, modes: Sequence[str] = MODES
) -> Iterator[tuple[Path, Path]]:
    """Follow a scene's motion in lockstep, a run for each mode; yield bags and folders of results.

    The first of the default modes is the paper's double check: nothing but the torques of the
    inverse dynamics. Each run lies in `out`/mode. An SstError says what was refused or has failed.
    """
    seconds = reference_motion(scene.load(name)).duration + HOLD_S
    for mode in modes:
        bag = empty_bag(out / mode)
        print(f"{name}, {mode}: {scene.load(name).description}", flush=True)
        follow(name, bag, mode, math.ceil(seconds * CONTROL_RATE) / CONTROL_RATE)
        yield bag, out / mode


def follow(name: str, bag: Path, mode: str, seconds: float, *, model: str | None = None) -> None:
    """Have the controller node follow a scene's motion for some time [s], and record the run.

    The controller's model and motion are those of the scene `model`, by default the plant's own. An
    SstError names a node that failed or did not end in time.
    """
    run = {"scene": name, "sync": "lockstep", "duration": seconds, "real_time_factor": 0.0}
    with _record(bag, publish_rate=CONTROL_RATE, **run):
        followed = {"scene": model or name, "mode": mode, "hold": HOLD_S, "rate": CONTROL_RATE}
        followed |= {"stamped": True, "feedforward_at": "middle"}
        waits = {"min_subscribers": 2, "wait_for_recorder": True}
        with _node("inverse_dynamics", **followed, **waits) as controller:
            _wait_for_end("inverse_dynamics", controller, 20.0 * seconds + _END_S)


def record(name: str, bag: Path, *, rate: int = 0, hold: str = "middle") -> None:
    """Play a scene's torques to its simulator, in processes of their own, and record the run.

    It goes by the clock, and in lockstep: to the same bits however busy the machine is. Steps,
    samples and commands have this rate a second, 0 for the defaults of the nodes; `hold` is the
    instant of a hold whose torque is commanded. An SstError names a node that failed or did not end
    in time.
    """
    duration = scene.load(name).duration or 1.0
    run = {"rate": rate, "publish_rate": rate} if rate else {}
    played = {"hold": hold, **({"rate": rate} if rate else {})}
    with (
        _record(bag, scene=name, sync="lockstep", duration=duration, **run),
        _node("torque_player", scene=name, stamped=True, min_subscribers=2, **played) as player,
    ):
        _wait_for_end("torque_player", player, duration + _END_S)


@contextmanager
def _record(bag: Path, **run: object) -> Iterator[None]:
    """Record a run of the simulator, which ends by itself after what the block does."""
    with _node("recorder", output=str(bag), timeout=_READY_S) as recorder:
        with _node("simulator", **run) as simulator:
            # One line when it receives all topics, none where it gives up, or is stuck.
            said, most_s = recorder.stdout, 2.0 * _READY_S
            if not (said and select.select([said], [], [], most_s)[0] and said.readline()):
                text = f"the recorder received nothing from a simulator within {_READY_S:g} s"
                raise SstError(text)
            yield
            _wait_for_end("simulator", simulator, _END_S)
        recorder.send_signal(signal.SIGINT)
        _wait_for_end("recorder", recorder, _END_S)


def empty_bag(folder: Path, name: str = "bag") -> Path:
    """Return the folder of a bag, without that of an earlier demo."""
    bag = folder / name
    if bag.exists():
        shutil.rmtree(bag)
    folder.mkdir(parents=True, exist_ok=True)
    return bag


def _node(command: str, **given: object) -> AbstractContextManager[subprocess.Popen[str]]:
    return child_process.run_beside(command, given, stdout=subprocess.PIPE)


def _wait_for_end(command: str, process: subprocess.Popen[str], timeout: float) -> None:
    try:
        status = process.wait(timeout)
    except subprocess.TimeoutExpired:
        raise SstError(f"{command} did not end within {timeout:g} s") from None
    if status != 0:
        raise SstError(f"{command} failed with status {status}")
