# SPDX-License-Identifier: Apache-2.0
"""Check a written shot: its path comes in, findings go out.

`shot.check_shot` runs USD's validators, the rules of `rules`, and a comparison with the points that were written.
"""
