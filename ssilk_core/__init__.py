# SPDX-License-Identifier: Apache-2.0
"""SSILK: loose garments simulated by a network that physics alone has trained.

Nine rooms, from the ground up: `scene`, `physics`, `network`, `training`, `authoring`, `quality`, `delivery`, `demo`,
`cli`. Each imports from those before it alone, and its first lines say what is in it (docs/architecture.md).
Importing this package is cheap: torch, pxr and the geometry libraries load where they are used.
"""

__version__ = "0.1.0"
