# SPDX-License-Identifier: Apache-2.0
"""What surrounds a character: the distance of cloth to meshes besides the body, and the velocity of the air.

`surface` measures the distance to one mesh, `surroundings` places the meshes of shots around their characters, and
`air` moves. With none of it nothing here runs.
"""
