# SPDX-License-Identifier: Apache-2.0
"""Packaging for colcon (ament_python) and for pip."""

import xml.etree.ElementTree as ET
from itertools import chain
from pathlib import Path

from setuptools import find_packages, setup

NAME = "sst_ros"
# `colcon build --symlink-install` builds beside a link
HERE = Path(__file__).resolve().parent
# the one place of version and metadata
PACKAGE = ET.parse(HERE / "package.xml").getroot()
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


EXTRAS = {
    "ros": wheels("kilted"),
    "record": ["mcap>=1.6", "rosbags>=0.11", "pandas>=2", "pyarrow>=14"],
    "plot": ["matplotlib>=3.5", "pandas>=2"],
    "fast": ["llvmlite>=0.42"],
    "sweep": ["llvmlite>=0.42", "pandas>=2", "pyarrow>=14"],
    "cluster": [
        "dask[distributed]>=2024.5",
        "llvmlite>=0.42",
        "pandas>=2",
        "pyarrow>=14",
    ],
    "view": ["viser>=1.1,<2"],
    "control": ["control>=0.9.4"],
    "proof": ["python-flint>=0.8"],
}
EXTRAS["all"] = ["argcomplete", "xarray", *chain.from_iterable(EXTRAS.values())]
EXTRAS |= {
    "jazzy": wheels("jazzy"),
    # Each for one target of `equations`, and large: not in `all`.
    "casadi": ["casadi>=3.6.5"],
    "jax": ["jax>=0.4.35"],
    "mpmath": ["mpmath"],
    "sympy": ["sympy"],
    # For developers.
    "docs": [
        "casadi>=3.6.5",
        "furo",
        "latex2mathml",
        "matplotlib>=3.5",
        "myst-nb>=1",
        "sphinx>=7.2",
        "sphinx-gallery>=0.16",
    ],
    "engines": ["mujoco>=4", "pin>=4"],
    "peers": ["casadi>=3.6.5", "cmeel-eigen", "mpmath", "mujoco>=4", "pin>=4"],
    # Not in `test`: colcon would measure coverage, and take many times as long.
    "coverage": ["pytest-cov"],
    "test": [
        "argcomplete",
        "build",
        "casadi>=3.6.5",
        "catkin_pkg",  # for rosidl_adapter
        "cmeel-eigen",  # headers of Pinocchio's C++; pin does not bring them
        "codespell",
        "colcon-common-extensions",
        "control",
        "fmpy>=0.3.20",
        "gymnasium",
        "hypothesis",
        "jax>=0.4.35",
        "jsonschema",
        "mpmath",
        "mypy",
        "pytest",
        "pytest-timeout",
        "pytest-xdist",
        "python-flint>=0.8",
        "ruff",
        "selenium",
        "sympy",
        "twine",
        "types-PyYAML",
        "xarray",
    ],
}


def files(pattern: str) -> list[str]:
    """List the data files that match, relative to here as setuptools wants them."""
    return sorted(str(path) for path in Path().glob(pattern))


def text(element: str) -> str:
    """Return the text of an element of package.xml."""
    return str(PACKAGE.findtext(element))


URLS = {str(url.get("type")).capitalize(): str(url.text) for url in PACKAGE.iter("url")}
PYTHONS = ("3.10", "3.11", "3.12", "3.13", "3.14")

setup(
    name=NAME,
    version=text("version"),
    description=text("description"),
    long_description=(HERE / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    url=URLS.pop("Website"),
    project_urls=URLS,
    keywords=(
        "parallel manipulator, spherical mechanism, direct dynamics, robotics, ROS 2"
    ),
    classifiers=[
        "Development Status :: 4 - Beta",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3",
        *(f"Programming Language :: Python :: {version}" for version in PYTHONS),
        "Topic :: Scientific/Engineering :: Physics",
        "Typing :: Typed",
    ],
    license=text("license"),
    maintainer=text("maintainer"),
    maintainer_email=PACKAGE.find("maintainer").get("email"),
    python_requires=">=3.10",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "nodes/*.xml", "*.mplstyle", "*/templates/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", files("config/*.*")),
        (f"share/{NAME}/config/scenes", files("config/scenes/*.yaml")),
        (f"share/{NAME}/config/sros2", files("config/sros2/*.xml")),
        (f"share/{NAME}/launch", files("launch/*.launch.*")),
        # `ros2 run` looks here; pip would put the node executables into bin/.
        (f"lib/{NAME}", files("executables/*")),
    ],
    install_requires=["numpy>=1.21", "scipy>=1.8", "PyYAML>=5.4", "jinja2>=3"],
    extras_require=EXTRAS,
    entry_points={"console_scripts": [f"sst-ros = {NAME}.__main__:main"]},
    zip_safe=True,
)
