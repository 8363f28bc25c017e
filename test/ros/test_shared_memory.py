# SPDX-License-Identifier: Apache-2.0
"""What a killed node leaves in shared memory: the next start removes it, and nothing else."""

import contextlib
import fcntl
import os
import re
import signal
import time
from pathlib import Path

import pytest
from sensor_msgs.msg import JointState

from sst_ros.nodes import shared_memory

pytestmark = pytest.mark.ros
NAME = "fastdds_0123456789abcdef"
OLDER = "fastrtps_0123456789abcdef"
PORT = "fastdds_port7413"


def locks(pid):
    """Segments and ports whose lock files a process has open."""
    targets = set()
    for path in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # the listing itself had one
            targets.add(str(path.readlink()))
    found = (re.fullmatch(r"/dev/shm/(fast\w+)_el", target) for target in targets)
    return {match[1] for match in found if match}


def files(names):
    present = {path.name for path in shared_memory.FOLDER.iterdir()}
    wanted = {form.format(name) for name in names for form in ("{}", "{}_el", "sem.{}_mutex")}
    return present & wanted


def aged(*paths):
    """Make lock files a minute old."""
    for path in paths:
        os.utime(path, (time.time() - 60.0,) * 2)


def test_the_next_start_removes_what_a_killed_node_left(nodes, observer):
    states = observer.listen(JointState, "/joint_states")
    killed = nodes.run("simulator")
    observer.until(lambda: states, "states")
    left = locks(killed.pid)
    assert len(left) >= 2  # a segment and a port
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    assert len(files(left)) >= 5
    aged(*(shared_memory.FOLDER / f"{name}_el" for name in left))
    mine = locks("self")
    nodes.run("simulator")

    def segments():
        """Not ports: they stay, and the new simulator may have taken one."""
        return {name for name in files(left) if "port" not in name}

    # Not until its states arrive: what the killed one had sent may still come.
    observer.until(lambda: not segments(), "removal")
    assert locks("self") == mine
    assert {f"{name}_el" for name in mine} <= files(mine)


def test_ports_and_what_is_locked_or_is_no_file_of_fast_dds_stay(tmp_path):
    dead = {NAME, f"{NAME}_el", OLDER, f"{OLDER}_sl"}
    stays = {PORT, f"{PORT}_el", f"sem.{PORT}_mutex", "fastdds_fedcba9876543210_el",
             "fastdds_fedcba9876543210", "other_el", f"{NAME}_elx", "lttng-ust-wait-8"}  # fmt: skip
    for name in dead | stays:
        (tmp_path / name).touch()
        aged(tmp_path / name)
    with (tmp_path / "fastdds_fedcba9876543210_el").open() as alive:
        fcntl.flock(alive, fcntl.LOCK_EX)
        assert set(shared_memory.remove_dead(tmp_path)) == {NAME, OLDER}
        assert {path.name for path in tmp_path.iterdir()} == stays
    assert shared_memory.remove_dead(tmp_path / "none") == []


def test_a_lock_file_that_is_not_yet_locked_stays(tmp_path):
    """Its process may be about to lock it."""
    lock = tmp_path / f"{NAME}_el"
    lock.touch()
    assert shared_memory.remove_dead(tmp_path) == []
    aged(lock)
    assert shared_memory.remove_dead(tmp_path) == [NAME]


def test_files_of_another_user_stay(tmp_path, monkeypatch):
    lock = tmp_path / f"{NAME}_el"
    lock.touch()
    aged(lock)
    monkeypatch.setattr(os, "geteuid", lambda: 4321)
    assert shared_memory.remove_dead(tmp_path) == []
    assert lock.exists()
