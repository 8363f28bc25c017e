# SPDX-License-Identifier: Apache-2.0
"""A recorded run as a pandas DataFrame: angles, rates and torques by time.

python examples/bag_to_pandas.py BAG
"""

import sys

import pandas as pd

from sst_ros.recording import recording

run = recording.read(sys.argv[1])
columns = {"time": run.seconds}
for name, values in (("gamma", run.gamma), ("gamma_dot", run.gamma_dot), ("tau", run.effort)):
    columns |= {f"{name}_{k + 1}": values[:, k] for k in range(3)}
table = pd.DataFrame(columns).set_index("time")
print(table.describe().loc[["min", "max"]].T)
