# SPDX-License-Identifier: Apache-2.0
"""Baked garments as glTF 2.0 binaries, and a reader of these files. Without other libraries than numpy."""
