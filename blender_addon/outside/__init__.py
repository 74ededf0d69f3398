# SPDX-License-Identifier: GPL-3.0-or-later
"""What runs in another process, and what it says; the standard library alone."""
