# SPDX-License-Identifier: Apache-2.0
"""Names of earlier versions that have left, and what to use instead of each."""

from __future__ import annotations

_LLVMLITE = "machine code is used wherever llvmlite is installed"

REMOVED_FUNCTIONS = {
    "prepare": "has left: call simulate, whose later calls share the code of the first"
}
"""Public functions."""

REMOVED_ARGUMENTS = {"compiled": f"has left: leave it out, {_LLVMLITE}"}
"""Arguments of functions, and parameters of nodes."""

REMOVED_METHODS = dict.fromkeys(
    ("gauss", "collocation"), "has left: auto and dop853 are as accurate and faster"
)
"""Methods of integration."""

REMOVED_COMMANDS = {
    "compile": "has left: nothing has to be compiled in advance, it takes tenths of a "
    "second in each process",
    "--compiled": REMOVED_ARGUMENTS["compiled"],
}
"""Words of the command line."""

REMOVED_VARIABLES = {
    "SST_ROS_NUMBA": f"has left: unset it; {_LLVMLITE}, with the bits of plain Python",
    "SST_ROS_CACHE": "has left: unset it; code is compiled in each process, not kept",
}
"""Variables of the environment."""
