# SPDX-License-Identifier: Apache-2.0
"""Packaging for colcon (ament_python) and for pip."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = "sst_ros"
NODES = ("simulator", "torque_player", "inverse_dynamics", "recorder", "viewer")
ROS_MESSAGES = (
    "std",
    "sensor",
    "geometry",
    "trajectory",
    "diagnostic",
    "rosgraph",
)


def wheels(distribution: str) -> list[str]:
    """Name the wheels of a ROS 2 distribution that the nodes need."""
    return [
        f"ros-{distribution}-rclpy[fastrtps]",
        f"ros-{distribution}-rmw-fastrtps-cpp",
        f"ros-{distribution}-std-srvs",
        *(f"ros-{distribution}-{kind}-msgs" for kind in ROS_MESSAGES),
    ]


def files(pattern: str) -> list[str]:
    """List the data files that match, relative to here as setuptools wants them."""
    return sorted(str(path) for path in Path().glob(pattern))


setup(
    name=NAME,
    version="0.1.0",
    description="ROS 2 simulator of the 3-RRP spherical star-triangle manipulator",
    license="Apache-2.0",
    maintainer="sst_ros founders",
    maintainer_email="sst-ros@example.org",
    python_requires=">=3.10",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "nodes/*.xml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", files("config/*.*")),
        (f"share/{NAME}/config/scenes", files("config/scenes/*.yaml")),
        (f"share/{NAME}/config/sros2", files("config/sros2/*.xml")),
        (f"share/{NAME}/launch", files("launch/*.launch.py")),
    ],
    install_requires=["numpy>=1.21", "scipy>=1.8", "PyYAML>=5.4"],
    extras_require={
        "ros": wheels("kilted"),
        "jazzy": wheels("jazzy"),
        "record": ["mcap>=1.6", "rosbags>=0.11"],
        "report": ["mcap>=1.6", "rosbags>=0.11", "matplotlib>=3.5", "pandas>=2"],
        "export": ["mcap>=1.6", "rosbags>=0.11", "pandas>=2", "pyarrow>=14"],
        "docs": ["furo", "latex2mathml", "myst-parser>=3", "sphinx>=7.2"],
        "fast": ["numba>=0.57"],
        "view": ["jinja2>=3", "viser>=1.1,<2"],
        "engines": ["mujoco>=4", "pin>=4"],
        "peers": ["drake", "exudyn", "mpmath", "mujoco>=4", "pin>=4"],
        "test": [
            "colcon-common-extensions",
            "hypothesis",
            "jsonschema",
            "mpmath",
            "mypy",
            "pytest",
            "pytest-timeout",
            "pytest-xdist",
            "ruff",
            "selenium",
            "types-PyYAML",
        ],
    },
    entry_points={
        "console_scripts": [f"{node} = {NAME}.nodes.{node}:main" for node in NODES],
    },
    zip_safe=True,
)
