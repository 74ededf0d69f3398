# SPDX-License-Identifier: Apache-2.0
"""A trained garment in numpy: its networks, its decoder and its skin, without any motion."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...errors import fail
from ...scene.assets import Deformer
from ..checkpoint import ModelFile
from ..parameters import descriptor_sizes
from ..proximity import proximity_size
from .decoder import NumpyDecoder
from .deformer import deformer
from .feedback import ClothPoints
from .kinematics import ProxyKinematics
from .networks import Layer, evaluate, layers
from .skinning import tiles
from .stepper import NumpyStepper, SoftClamp, SpringStepper, VerletStepper, diverged

if TYPE_CHECKING:
    from .compiled import SparseSkin

STEPPERS = {"spring_verlet": SpringStepper, "verlet": VerletStepper, "quasi_static": None}  # by scheme


class NumpyGarment:
    """A trained garment whose networks are evaluated with numpy.

    Raises:
        SsilkError: the runtime does not support the model's integration scheme, or it is a model of a family of
            bodies that was put on none of them.
    """

    def __init__(self, file: ModelFile) -> None:
        file.need_body()
        scene, config = file.scene, file.config
        if config.scheme not in STEPPERS:
            fail(
                scene.garment.mesh.path,
                f"the model's scheme is '{config.scheme}'",
                f"the runtime plays {', '.join(map(repr, STEPPERS))}",
                "play it in PyTorch with ssilk_core.network.rollout, or train with one of these",
            )
        self.file, self.skeleton = file, scene.character.skeleton
        self.proximity = proximity_size(scene, config)  # features of it
        self.initialiser = layers(file.parameters, "initialiser")
        self.decoder = NumpyDecoder(scene, file.parameters, config)
        self.kinematics = ProxyKinematics(scene.rig, self.skeleton.joint_count)
        self.tiles = tiles(scene, file.parameters)

    @cached_property
    def stepper(self) -> NumpyStepper[Any] | None:
        """What takes it from frame to frame; None where each frame is for itself."""
        file, stepper = self.file, STEPPERS[self.file.config.scheme]
        if stepper is None:
            return None
        sizes = descriptor_sizes(file.scene, file.joints, file.config)
        return stepper(file.config, file.parameters, *sizes, ClothPoints(file, self.decoder))

    @cached_property
    def sparse_skin(self) -> SparseSkin:
        """The same skin as that of the tiles, for compiled loops; needs numba."""
        from .compiled import SparseSkin

        return SparseSkin.of(self.tiles)

    def deformer(self) -> Deformer:
        """Return the trained garment's skin and shapes, as files and host applications hold them."""
        return deformer(self.file)

    def quasi_static(self, static: NDArray) -> NDArray:
        """Return the quasi-static latents (F, latent) of static descriptors (F, S) (Eq. 1).

        Proximity, which comes first in these, may be left out where nothing is near.
        """
        first, *others = self.initialiser
        seen = first.rows if static.shape[1] + 1 == len(first.rows) else first.rows[self.proximity :]
        rest = np.ascontiguousarray(evaluate([Layer(seen), *others], static.T).T)
        SoftClamp(self.file.config.latent_bound, rest.shape)(rest)
        rest[diverged(rest)] = 0
        return rest
