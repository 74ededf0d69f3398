# SPDX-License-Identifier: Apache-2.0
"""Checks before training, and repairs; open `inspection.py` first, which lists all checks."""
