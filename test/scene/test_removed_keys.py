# SPDX-License-Identifier: Apache-2.0
"""Keys of earlier versions are read over, so that older scenes and recordings stay readable."""

import pytest

from sst_ros.scene import yaml_document
from sst_ros.scene.scene import Scene, load


def test_markers_are_ignored_with_a_warning_that_names_the_line():
    scene = load("example2_heavy")
    text = yaml_document.dump(scene)
    line = text.count("\n") + 1
    with pytest.warns(FutureWarning, match=f"line {line}: markers is ignored: .*robot_description"):
        assert yaml_document.read(Scene, text + "markers: {rate: 10.0}\n", "old") == scene
