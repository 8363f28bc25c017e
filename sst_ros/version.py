# SPDX-License-Identifier: Apache-2.0
"""Version of the package."""

VERSION = "0.2.0"
