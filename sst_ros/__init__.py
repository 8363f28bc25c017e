# SPDX-License-Identifier: Apache-2.0
"""Simulator of the 3-RRP spherical star-triangle parallel manipulator."""

from sst_ros.scene.scene import Scene
from sst_ros.scene.scene import load as load_scene
from sst_ros.simulation import Simulation

__all__ = ["Scene", "Simulation", "load_scene"]
