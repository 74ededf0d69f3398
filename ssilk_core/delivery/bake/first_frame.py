# SPDX-License-Identifier: Apache-2.0
"""The first frame of a shot that begins with given cloth: its latents, and a blendshape for what they miss."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ...errors import fail
from ...events import Message, Reporter
from ...scene.assets import PINNED, Deformer, Floats, GarmentPose, Motion, Scene
from ...scene.kinematics import motion_transforms, resample, sample_felt, sample_motion
from .direction import Direction
from .shot_samples import ShotSamples, step_before
from .start import StartCloth

if TYPE_CHECKING:
    from ...network.model.network import GarmentModel
    from ...network.start import GivenStart

FAR = 0.01  # [m] RMS, from which on latents do not reach the cloth: it is warned of
ELSEWHERE = 0.1  # of the garment's size, RMS, from which on the cloth is of another moment or character
SEEN = 1e-4  # [m] that latents may miss at most without a blendshape that makes up for it
BLEND = 0.5  # [s] after which that weighs nothing
TO_DO = "name the frame after '@' that is this shot's first, of a shot of this character"


def fitted_to(cloth: StartCloth, model: GarmentModel, samples: ShotSamples) -> GivenStart:
    """Return the state whose cloth is nearest to that which a shot begins with."""
    from ...network.start import fitted_start

    fps, points, source = model.config.fps, cloth.points, samples.source
    whole = resample(samples.driver(0, samples.rolled, 1), fps, cover=True)
    first, earlier = whole.clip(0, 1), samples.source_frame(-samples.lead) - source.fps / fps
    if not cloth.moves:  # then it stands still: cloth and character go on together
        return fitted_start(model, first, first, points)
    if earlier < 0:  # as it goes on
        return fitted_start(model, step_before(whole), first, points)
    position = np.array([earlier])
    poses, felt = sample_motion(source, position), sample_felt(source, position)
    return fitted_start(model, Motion(source.path, fps, *poses, **felt), first, points)


def need_near(cloth: StartCloth, scene: Scene, motion: Motion, direction: Direction | None) -> None:
    """Raise `SsilkError` where the first frame is held, or its character is not where the cloth is."""
    if direction is not None and (direction.hold > 1 or direction.free[0] < 1):
        found = "poses that are held" if direction.hold > 1 else "ssilk:free below 1 in the first frame"
        fail("--start-cloth", f"a start and {found}", "one of both", "leave --start-cloth out, or let it go")
    root = motion_transforms(motion.clip(0, 1), scene.character.skeleton.parents)[0, :, :3, 3]
    away = np.linalg.norm(cloth.points[1][:, None] - root[None], axis=2).min()
    reach = scene.garment.mesh.diagonal
    if away > reach:
        found = f"its cloth is {away:.3g} m away from the character's first pose"
        fail(cloth.where, found, f"{reach:.3g} m are allowed", TO_DO)


def need_fitted(cloth: StartCloth, given: GivenStart, scene: Scene) -> None:
    """Raise `SsilkError` where the network's cloth does not come near to the cloth that is given."""
    allowed = ELSEWHERE * scene.garment.mesh.diagonal
    if given.left[0] > allowed:
        found = f"the network's cloth comes no nearer to it than {given.left[0]:.3g} m (RMS)"
        fail(cloth.where, found, f"{allowed:.3g} m are allowed", TO_DO)


def with_missing(deformer: Deformer, motion: Motion, pose: GarmentPose, cloth: StartCloth) -> Deformer:
    """Return the garment with a blendshape for what its pose in the first frame of a motion lacks of the cloth."""
    from ...scene.decomposition.rest import rest_residuals

    ((_, offsets),) = rest_residuals(deformer, motion.clip(0, 1), replace(pose, start=0), [cloth.points[1]])
    own = np.where((deformer.scene.classes == PINNED)[:, None], 0, offsets[0])
    return replace(deformer, shapes=np.concatenate([deformer.shapes, own[None]]))


def faded(pose: GarmentPose, fps: float, direction: Direction | None) -> GarmentPose:
    """Return poses with the weight of that blendshape, at a rate [1/s]: none where skinning holds the garment."""
    frames = range(pose.start, pose.start + pose.frame_count)
    weights = fading(frames, fps)
    if direction is not None:
        weights = weights * direction.free[frames.start : frames.stop]
    return replace(pose, weights=np.concatenate([pose.weights, weights[:, None]], axis=1))


def fading(frames: range, fps: float) -> Floats:
    """Return the weights (F,) of what latents miss, in frames that are counted from the first, at a rate [1/s]."""
    done: Floats = np.clip(np.array(frames, np.float64) / (fps * BLEND), 0, 1)
    return np.asarray(1 - done**2 * (3 - 2 * done), np.float64)


def tell_first(cloth: StartCloth, given: GivenStart, is_fading: bool, name: str, report: Reporter) -> None:
    """Report how near the first frame of a motion is to the cloth that it begins with.

    Args:
        is_fading: whether there is a blendshape for the rest.
    """
    rms, most = (1000 * value for value in given.left)
    slow = "" if cloth.moves else "; nothing is known of how it moves there"
    near = f"{rms:.2f} mm (RMS), {most:.2f} mm at most"
    rest = f"; a blendshape that fades in {BLEND:g} s makes up for the rest" if is_fading else ""
    text = f"the cloth begins as in {cloth.where}; latents come within {near}{rest}{slow}"
    report(Message(f"{name}: {text}", "warning" if given.left[0] > FAR else "info"))
