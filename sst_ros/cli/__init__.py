# SPDX-License-Identifier: Apache-2.0
"""The command line: one table of commands, and the functions that run them."""
