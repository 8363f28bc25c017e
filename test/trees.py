# SPDX-License-Identifier: Apache-2.0
"""Documents as plain trees, with one place changed."""

import copy


def changed(tree, path, value):
    tree = copy.deepcopy(tree)
    inner = tree
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return tree
