# SPDX-License-Identifier: Apache-2.0
"""SSILK: loose garments simulated by a network that physics alone has trained.

Importing this package is cheap: torch, pxr and the geometry libraries load where they are used.
"""

__version__ = "0.1.0"
