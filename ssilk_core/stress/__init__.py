# SPDX-License-Identifier: Apache-2.0
"""A trained garment, and what it was trained with, at the extremes: what holds, what is refused, what falls back."""
