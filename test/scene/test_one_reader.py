# SPDX-License-Identifier: Apache-2.0
"""Every YAML document of a user is read by the scene's reader, with its limits."""

import os
import re

import pytest

from sst_ros.errors import InputError
from sst_ros.recording.bag_reader import Bag
from sst_ros.runtime.arguments import unused_files
from sst_ros.scene.scene import load
from sst_ros.sweeps.sweep_study import SweepStudy

ANCHORS = "a0: &a0 [1, 1]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 10)
)
STUDY = "scene: example2\nvary: {star.mass: {uniform: [1.5, 2.5]}}\nn: 4\nsteps: 40\n"
REFUSED = {
    "anchors": (ANCHORS, r"line 2: .*no aliases"),
    "brackets": ("a: " + "[" * 500 + "]" * 500, "20 levels"),
    "twice": ("a: 1\nb: 2\na: 3", "line 3: a = '3': is given twice, first on line 1"),
    "long": ("a: " + "1" * 1_000_001, "no more than 1000000 characters"),
    "values": ("a: [" + "1, " * 20_001 + "1]", "20000 values"),
    "no yaml": ("a: {", "must be YAML"),
}


def read_bag(path):
    folder = path.parent / "bag"
    folder.mkdir()
    (folder / "bag_0.mcap").write_bytes(b"")
    path.rename(folder / "metadata.yaml")
    return [*Bag(folder, ()).messages()]


def read_parameters(path):
    return [*unused_files(["--params-file", str(path)], "/node")]


READERS = {
    "scene": load,
    "study": SweepStudy.read,
    "bag": read_bag,
    "node": read_parameters,
}


@pytest.mark.parametrize("read", READERS.values(), ids=READERS)
@pytest.mark.parametrize(("text", "said"), REFUSED.values(), ids=REFUSED)
def test_no_document_breaks_the_limits(tmp_path, read, text, said):
    path = tmp_path / "given.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=said) as caught:
        read(path)
    assert str(caught.value).count("\n") == len(caught.value.problems) - 1


@pytest.mark.parametrize("read", READERS.values(), ids=READERS)
@pytest.mark.parametrize("kind", ["pipe", "zeros"])
@pytest.mark.timeout(20)
def test_a_pipe_or_a_device_is_refused_at_once(tmp_path, read, kind):
    path = tmp_path / "given.yaml"
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    with pytest.raises(InputError, match="it is no regular file"):
        read(path)


def study(tmp_path, old="", new=""):
    path = tmp_path / "study.yaml"
    path.write_text(STUDY.replace(old, new))
    return SweepStudy.read(path)


def test_numbers_of_a_study_are_those_of_a_scene(tmp_path):
    """A scene has YAML 1.2's: 010 is ten, and 1:30 and 1_000 are text."""
    assert study(tmp_path, "n: 4", "n: 010").n == 10
    for word in "1:30", "1_000", "0x10", "1e3":
        with pytest.raises(
            InputError, match=re.escape(f"n = '{word}': must be a whole number")
        ):
            study(tmp_path, "n: 4", f"n: {word}")
        if word != "1e3":
            with pytest.raises(InputError, match=r"vary\.star\.mass = "):
                study(tmp_path, "2.5", word)


def test_numbers_of_every_form_are_read_in_what_varies(tmp_path):
    (one,) = study(
        tmp_path, "uniform: [1.5, 2.5]", "normal: [2, 1e-1, 1, +.inf]"
    ).variations
    assert one.numbers.ravel().tolist() == [2.0, 0.1, 1.0, float("inf")]
    even = "linspace: [1, 2, 4], relative: true"
    (one,) = study(tmp_path, "uniform: [1.5, 2.5]", even).variations
    assert len(one.numbers) == 4
    assert one.numbers[-1] == 2.0 * one.numbers[0]
    assert study(tmp_path, "steps", "torque: [1, 2.5, 0]\nsteps").torque == [1, 2.5, 0]
