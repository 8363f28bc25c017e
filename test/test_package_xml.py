# SPDX-License-Identifier: Apache-2.0
"""package.xml names what setup.py needs, by keys that rosdep knows."""

import re
import runpy
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PYTHON_KEYS = {
    "argcomplete": "python3-argcomplete",
    "hypothesis": "python3-hypothesis",
    "jinja2": "python3-jinja2",
    "jsonschema": "python3-jsonschema",
    "matplotlib": "python3-matplotlib",
    "mcap": "mcap-ros2-support",  # which needs mcap
    "mpmath": "python3-sympy",  # which needs mpmath
    "numba": "python3-numba",
    "numpy": "python3-numpy",
    "pandas": "python3-pandas",
    "pytest": "python3-pytest",
    "pytest-timeout": "python3-pytest-timeout",
    "PyYAML": "python3-yaml",
    "rosbags": "python3-rosbags-pip",
    "scipy": "python3-scipy",
}
"""Keys of rosdep/python.yaml of github.com/ros/rosdistro, commit 8468e88c of 2026-08-22."""

WITHOUT_KEY = {"dask", "pyarrow", "viser", "xarray"}
"""Python packages of setup.py that have no key there: `pip install sst_ros[all]`."""

ROS_KEYS = {
    *("ament_copyright", "ament_flake8", "ament_index_python", "ament_pep257", "ament_xmllint"),
    *("builtin_interfaces", "control_msgs", "diagnostic_msgs", "geometry_msgs", "launch"),
    *("launch_ros", "launch_testing", "rcl_interfaces", "rclpy", "robot_state_publisher"),
    *("ros2bag", "ros2launch", "rosbag2_storage_mcap", "rosgraph_msgs", "rviz2", "sensor_msgs"),
    *("simulation_interfaces", "std_msgs", "std_srvs", "trajectory_msgs"),
}
"""Packages of both jazzy/ and kilted/distribution.yaml of the same commit."""


@pytest.fixture(scope="module")
def depends():
    root = ET.parse(ROOT / "package.xml").getroot()
    return {found.text for found in root if found.tag.endswith("depend")}


@pytest.fixture(scope="module")
def required():
    """Names of the Python packages that setup.py asks for, without the wheels of ROS."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        patch.setattr("setuptools.setup", lambda **_: None)
        extras = runpy.run_path("setup.py")["EXTRAS"]
    text = (ROOT / "setup.py").read_text(encoding="utf-8")
    always = re.findall(r'"([\w.-]+)', text[text.index("install_requires=") :].partition("]")[0])
    words = [*always, *extras["all"]]
    names = {re.match(r"[\w-]+", word)[0] for word in words}
    return {name for name in names if not name.startswith("ros-")}


def test_every_key_is_known(depends):
    assert depends <= ROS_KEYS | set(PYTHON_KEYS.values())


def test_every_requirement_has_its_key(depends, required):
    assert required <= PYTHON_KEYS.keys() | WITHOUT_KEY
    missing = {PYTHON_KEYS[name] for name in required - WITHOUT_KEY} - depends
    assert not missing


def test_every_message_package_of_the_wheels_is_named(depends):
    text = (ROOT / "setup.py").read_text(encoding="utf-8")
    listed = text.partition("ROS_MESSAGES = (")[2].partition(")")[0]
    kinds = re.findall(r'"(\w+)"', listed)
    assert {f"{kind}_msgs" for kind in kinds} <= depends
