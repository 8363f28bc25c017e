# SPDX-License-Identifier: Apache-2.0
"""Speed and accuracy, measured. Never imported by the package."""
