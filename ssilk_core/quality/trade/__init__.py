# SPDX-License-Identifier: Apache-2.0
"""Measuring the trade of speed and size for accuracy."""
