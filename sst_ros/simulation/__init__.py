# SPDX-License-Identifier: Apache-2.0
"""A scene in motion: step by step, a whole motion in one call, and its trajectory."""
