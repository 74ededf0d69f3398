# SPDX-License-Identifier: Apache-2.0
"""Physical constants that several parts share."""

from __future__ import annotations

GRAVITY = 9.81
"""Standard acceleration of gravity [m/s2], rounded; it points along -y."""
