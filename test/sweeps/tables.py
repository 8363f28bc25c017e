# SPDX-License-Identifier: Apache-2.0
"""Tables of studies, compared."""


def same(one, other):
    """Compare two tables bit by bit."""
    assert list(one.columns) == list(other.columns)
    for name in one.columns:
        if name == "reason":
            assert one[name].tolist() == other[name].tolist()
        else:
            assert one[name].to_numpy().tobytes() == other[name].to_numpy().tobytes(), name
