# SPDX-License-Identifier: Apache-2.0
"""Recording to pandas
===================

A recorded run (MCAP or sqlite3 bag) as a pandas DataFrame: angles, rates and torques
over time::

    python examples/bag_to_pandas.py BAG
"""

import sys

from sst_ros import read_bag

table = read_bag(sys.argv[1]).trajectory.to_pandas().set_index("t")
columns = [
    f"{name}_{k}" for name in ("gamma", "gamma_dot", "torque") for k in (1, 2, 3)
]
print(table[columns].describe().loc[["min", "max"]].T)
