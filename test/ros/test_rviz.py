# SPDX-License-Identifier: Apache-2.0
"""The RViz layout listens to what the simulator publishes, in the frame of the tree."""

from pathlib import Path

import pytest
import yaml

from sst_ros.description.tree import BASE
from sst_ros.nodes import topics
from sst_ros.nodes.messages import BASE_FRAME
from tools.node_tables import SIMULATOR

pytestmark = pytest.mark.ros
LAYOUT = Path(__file__).parents[2] / "config" / "sst_ros.rviz"


def test_the_layout_names_our_topics_and_frame():
    manager = yaml.safe_load(LAYOUT.read_text(encoding="utf-8"))["Visualization Manager"]
    displays = {display["Class"].split("/")[1]: display for display in manager["Displays"]}
    description = displays["RobotModel"]["Description Topic"]
    assert description["Value"] == topics.ROBOT_DESCRIPTION.name
    assert description["Durability Policy"] == "Transient Local"
    markers = displays["MarkerArray"]["Topic"]["Value"]
    assert markers == topics.MARKERS.name.replace("~", SIMULATOR)
    assert manager["Global Options"]["Fixed Frame"] == BASE == BASE_FRAME
