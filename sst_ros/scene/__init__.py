# SPDX-License-Identifier: Apache-2.0
"""What is simulated, as data: the document, its checks, and the values in it."""
