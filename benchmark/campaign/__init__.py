# SPDX-License-Identifier: Apache-2.0
"""Attempts to break sst_ros, counted: `python -m benchmark.campaign`."""
