# SPDX-License-Identifier: Apache-2.0
"""Tables of README.md and docs/: `forms` formats numbers, the other modules hold one function for each table."""
