# SPDX-License-Identifier: Apache-2.0
"""A renderer of shots, for films, pictures and pages; open `output.py` first."""
