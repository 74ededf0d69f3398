# SPDX-License-Identifier: Apache-2.0
"""Evaluation of garments by any method: energies, errors to the reference simulator, settling and drift."""
