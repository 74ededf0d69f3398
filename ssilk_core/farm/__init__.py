# SPDX-License-Identifier: Apache-2.0
"""Bakes in bulk: which garment in which shot, what is done already, and how farms are told of it."""
