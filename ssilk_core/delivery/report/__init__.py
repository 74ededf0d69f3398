# SPDX-License-Identifier: Apache-2.0
"""One self-contained page about a model or a shot: energies over time, worst frames, tables, provenance."""
