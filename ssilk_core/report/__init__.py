# SPDX-License-Identifier: Apache-2.0
"""One page about a model or a shot, with nothing outside it: energies over time, worst frames, tables, provenance."""
