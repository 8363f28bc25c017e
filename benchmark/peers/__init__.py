# SPDX-License-Identifier: Apache-2.0
"""The same second of Example 2 on sst_ros and on its peers: error against processor
time.
"""
