# SPDX-License-Identifier: Apache-2.0
"""Initialiser P, stepper S and decoder D in PyTorch; open `network.py` first."""
