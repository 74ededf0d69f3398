# SPDX-License-Identifier: Apache-2.0
"""Contact of cloth with cloth, for solvers.

In: the cloth of one garment or of an outfit (`cloth`), and positions (V, 3, N). Out: `ClothContacts`, with energy,
gradient and stiffness. Open `self_contact.py` first: it says which pairs count, and on which side. `neighbours` finds
points near others, `pairs` measures a vertex over a face, or two edges, and `contacts` sums the energy.
"""

from .cloth import TouchingCloth
from .contacts import ClothContacts
from .self_contact import ClothNeighbours, SelfContact

__all__ = ["ClothContacts", "ClothNeighbours", "SelfContact", "TouchingCloth"]
