# SPDX-License-Identifier: Apache-2.0
"""Families of bodies: what differs between characters, and a garment carried from one to another; open `carry.py`."""
