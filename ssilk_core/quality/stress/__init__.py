# SPDX-License-Identifier: Apache-2.0
"""Stress tests of a trained garment: which extremes work, fall back to rest, or are refused."""
