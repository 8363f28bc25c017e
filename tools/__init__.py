# SPDX-License-Identifier: Apache-2.0
"""Generators of tables and pictures of the documentation."""
