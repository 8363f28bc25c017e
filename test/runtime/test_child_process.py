# SPDX-License-Identifier: Apache-2.0
"""ROS domains of processes that start nodes."""

import contextlib
import itertools
import os
import socket
import subprocess
import sys

import pytest
from programs import own_domain

from sst_ros.errors import SstError
from sst_ros.runtime import child_process

KEEP = """
import os, sys
from sst_ros.runtime import child_process
child_process.keep_domain()
names = "ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"
print(*map(os.environ.__getitem__, names), flush=True)
sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def no_domain(monkeypatch):
    for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        monkeypatch.delenv(name, raising=False)


def test_two_at_once_differ_and_the_environment_comes_back():
    with own_domain() as first:
        assert os.environ["ROS_DOMAIN_ID"] == str(first)
        with own_domain() as second:
            assert os.environ["ROS_DOMAIN_ID"] == str(second) != str(first)
        child_process.keep_domain()  # the environment names one
        assert os.environ["ROS_DOMAIN_ID"] == str(first)
    assert "ROS_DOMAIN_ID" not in os.environ


def test_a_process_keeps_its_domain_until_it_ends(monkeypatch):
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", KEEP], **pipes) as process:
        number, network = process.stdout.readline().split()
        assert network == "LOCALHOST"
        monkeypatch.setattr(
            child_process, "_next_domain", itertools.repeat(int(number) - 1)
        )
        with pytest.raises(SstError, match="in use: set ROS_DOMAIN_ID"), own_domain():
            pass
        process.communicate()
    with own_domain() as same:
        assert str(same) == number


@pytest.mark.parametrize("participant", [0, 3])
def test_a_domain_in_which_a_node_is_left_is_not_taken(monkeypatch, participant):
    """A node that has lost its parent goes on for a second or two.

    A user's has no lock at all.

    A test once recorded the scene of another test's simulator beside its own.
    """
    with own_domain() as number:
        pass
    monkeypatch.setattr(child_process, "_next_domain", itertools.count(number - 1))
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as node:
        node.bind(("", 7400 + 250 * number + 10 + 2 * participant))  # RTPS 2.5, 9.6.2.3
        with own_domain() as other:
            assert other != number
    monkeypatch.setattr(child_process, "_next_domain", itertools.count(number - 1))
    with own_domain() as same:
        assert same == number
