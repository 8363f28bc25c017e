# SPDX-License-Identifier: Apache-2.0
"""The other world: built by colcon, found as by `ros2 run` and `ros2 launch`."""

import os
import shutil
import sys
from pathlib import Path

import pytest
from programs import python

from sst_ros.runtime.settings import NODE_COMMANDS

pytestmark = [pytest.mark.ros, pytest.mark.slow]
SOURCE = Path(__file__).parents[2]
PATH = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
"""Programs begin with `env python3`: a user starts them with his environment active."""


@pytest.fixture(scope="module", params=["", "--symlink-install"])
def prefix(request, tmp_path_factory):
    if shutil.which("colcon", path=Path(sys.executable).parent) is None:
        pytest.fail("colcon is missing: pip install .[test]")
    workspace = tmp_path_factory.mktemp("workspace")
    ignored = shutil.ignore_patterns(
        ".*", "demo_out*", "__pycache__", "*.egg-info", "build"
    )
    shutil.copytree(SOURCE, workspace / "src" / "sst_ros", ignore=ignored)
    words = ["colcon", "build", "--event-handlers", "console_direct-"]
    python(
        "-m",
        *words,
        *request.param.split(),
        cwd=workspace,
        env={"PATH": PATH},
        timeout=110,
    )
    return workspace / "install" / "sst_ros"


@pytest.fixture
def overlay(prefix):
    packages = next(prefix.glob("lib/python*/site-packages"))
    # of links to the source
    paths = f"{packages}:{prefix.parents[1] / 'build' / 'sst_ros'}"
    return {"AMENT_PREFIX_PATH": str(prefix), "PYTHONPATH": paths, "PATH": PATH}


def test_all_is_installed_where_ros_looks_for_it(prefix):
    share = prefix / "share" / "sst_ros"
    assert (prefix / "share/ament_index/resource_index/packages/sst_ros").is_file()
    assert (share / "package.xml").is_file()
    for folder in ("config", "launch"):
        for path in (SOURCE / folder).rglob("*.*"):
            if "__pycache__" not in path.parts:
                assert (
                    share / path.relative_to(SOURCE)
                ).read_bytes() == path.read_bytes()
    for name in NODE_COMMANDS:  # as `ros2 run` finds it
        assert os.access(prefix / "lib" / "sst_ros" / name, os.X_OK)


def test_the_installed_simulator_runs_from_its_own_workspace(
    prefix, overlay, nodes, observer
):
    executable = [str(prefix / "lib" / "sst_ros" / "simulator")]
    words = ["--ros-args", "-p", "scene:=example1", "-p", "duration:=0.0"]
    process = nodes.start("", *words, executable=executable, env=overlay)
    observer.preview()
    status, _, err = nodes.stop(process)
    assert status == 0, err
    text = "from sst_ros.scene.scene import share_directory as s; print(s())"
    found = python(text, env=overlay, cwd=prefix).stdout
    linked = prefix.parents[1] / "src" / "sst_ros"
    assert Path(found.strip()) in (prefix / "share" / "sst_ros", linked)
