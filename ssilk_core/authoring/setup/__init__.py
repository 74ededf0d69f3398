# SPDX-License-Identifier: Apache-2.0
"""Classes, weights and proxy joints of a plain mesh; open `prepare.py` first."""
