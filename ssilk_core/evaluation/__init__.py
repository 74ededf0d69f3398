# SPDX-License-Identifier: Apache-2.0
"""How good a garment is, by any method: energies, against the reference simulator, and what energies hide."""
