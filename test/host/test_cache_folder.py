# SPDX-License-Identifier: Apache-2.0
"""Compiled code is loaded only from where nobody else can write."""

import os
import pickle
import resource
import shutil
import tempfile
from pathlib import Path

import pytest
from programs import python

from sst_ros.host import compiled_module as module
from sst_ros.host.compiled_module import cache_folder, numba_version

OTHER_USER = 65534
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="needs root to act as a second user")
with_numba = pytest.mark.skipif(numba_version() is None, reason="numba is missing")

PROGRAM = """
from sst_ros.host.compiled_module import load
text = "def twice(x):\\n    return 2.0 * x\\n"
print(load([text], {}, numba=True).twice(21.0))
"""


def run(cache, **options):
    return python(PROGRAM, env={"SST_ROS_CACHE": str(cache)}, **options)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    result = tmp_path / "cache"
    result.mkdir(mode=0o700)
    monkeypatch.setenv("SST_ROS_CACHE", str(result))
    module._private_folder.cache_clear()
    return result


def check_refused(folder, said):
    with pytest.warns(RuntimeWarning, match=said):
        private = cache_folder()
    assert private != folder
    assert private.stat().st_mode & 0o777 == 0o700
    assert cache_folder() == private, "the same folder for the whole process"


@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o755, 0o770, 0o701])
def test_a_private_folder_takes_the_place_of_one_that_is_open_to_others(mode, folder):
    assert cache_folder() == folder
    folder.chmod(mode)
    check_refused(folder, f"has mode {mode:o} and must have 700")


def test_a_link_is_followed(folder, tmp_path, monkeypatch):
    link = tmp_path / "link"
    link.symlink_to(folder)
    monkeypatch.setenv("SST_ROS_CACHE", str(link))
    assert cache_folder() == folder, "what was judged, wherever the link leads later"
    folder.chmod(0o777)
    check_refused(link, "must have 700")


def test_what_belongs_to_another_user_is_not_trusted(folder, monkeypatch):
    if os.geteuid() == 0:
        os.chown(folder, OTHER_USER, OTHER_USER)
    else:
        monkeypatch.setattr(module.os, "geteuid", lambda: OTHER_USER)
    check_refused(folder, "belongs to another user")


def test_a_new_folder_is_for_the_user_alone(tmp_path, monkeypatch):
    monkeypatch.delenv("SST_ROS_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "a" / "b"))
    before = os.umask(0)
    found = cache_folder()
    os.umask(before)
    assert found == tmp_path / "a" / "b" / "sst_ros"
    assert [one.stat().st_mode & 0o077 for one in (found, *found.parents[:2])] == [0, 0, 0]


class Planted:
    """Unpickled, it makes a folder."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@as_root
@with_numba
@pytest.mark.parametrize(
    "mine",
    [
        pytest.param(False, id="folder of another user"),
        pytest.param(True, id="own folder", marks=pytest.mark.slow),
    ],
)
def test_the_code_of_another_user_does_not_run(mine, tmp_path):
    """numba unpickles its index: what another user has put there must not be read."""
    assert run(tmp_path / "cache").stdout == "42.0\n"
    shared = Path(tempfile.mkdtemp())
    try:
        shared.chmod(0o777)
        cache, marker = shared / "cache", tmp_path / "planted"
        shutil.copytree(tmp_path / "cache", cache)
        for index in cache.rglob("*.nbi"):
            index.write_bytes(pickle.dumps(Planted(marker)) + pickle.dumps(b""))
            os.chown(index, OTHER_USER, OTHER_USER)
        if mine:  # the folder was open when the file was planted, and is closed now
            shared.chmod(0o700)
        else:
            for path in (cache, cache / "__pycache__", *cache.glob("*.py")):
                os.chown(path, OTHER_USER, OTHER_USER)
        done = run(cache)
        assert done.stdout == "42.0\n"
        assert not marker.exists()
        assert ("compiled code is not kept" in done.stderr) != mine
    finally:
        shutil.rmtree(shared)


@with_numba
@pytest.mark.slow
def test_a_full_disk_costs_the_cache_and_nothing_else(tmp_path):
    def limited():
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))

    done = run(tmp_path / "cache", preexec_fn=limited)
    assert done.stdout == "42.0\n"
    assert "compiled code is not kept" in done.stderr
    assert run(tmp_path / "cache").stdout == "42.0\n"
