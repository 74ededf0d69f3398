# SPDX-License-Identifier: Apache-2.0
"""Read motions from SkelAnimations, in their own files or on characters in stages."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from ssilk_core.errors import fail
from ssilk_core.files import split_location
from ssilk_core.scene.assets import Floats, Ints, Motion, Skeleton
from ssilk_core.scene.kinematics import MAX_FPS, MIN_FPS, matrix_from_quaternion, quaternion_from_matrix, rigid

from ..opening.stage import (
    PRIMS,
    USD_SUFFIXES,
    StageLike,
    listed,
    location,
    named,
    needs_whole_files,
    open_stage,
    world_matrix,
)
from ..opening.times import change_times, xform_attributes
from ..units import StageUnits
from .animation import PosedJoints, animation_source, posed_joints
from .clips import LOOKED_AT, ClipSpace, Posture, clip_space, spread
from .hierarchy import beneath_rest, parents_by_path, placed_at_rest, to_parents_of
from .joint_scales import SCALE_TOLERANCE, spread_out, total_scales
from .skeleton import of_bodies, skeletons
from .skin import match_joints, need_unique
from .spaces import joints_to_core, need_similarity, similarity_scale

_FRAMES_AT_ONCE = 1024  # while reading: 4 MB for each array of matrices of 30 joints
FARTHEST = 100_000.0  # [m] that a joint may be from its parent, or a root from the origin: damage lies beyond
_MOST_TIME_CODES = 1e9  # in a second; some programs count in ticks
_MOST_FRAMES = 200_000  # close to two hours at 30 frames a second


def read_motions(paths: Iterable[str | Path], skeleton: Skeleton) -> list[Motion]:
    """Read several motions, each given as "file[:/Prim/Path]"; a folder means all USD files in it, sorted by name.

    Each is read once, however often it is named.

    Raises:
        SsilkError: a folder has no USD files; also as `read_motion`.
    """
    return [read_motion(path, skeleton) for path in distinct(motion_sources(paths)).values()]


def distinct(sources: Iterable[Path]) -> dict[tuple[Path, str | None], Path]:
    """Return motions that `motion_sources` found, each once, by its file, links followed, and its prim."""
    found: dict[tuple[Path, str | None], Path] = {}
    for source in sources:
        file, prim = split_location(str(source))
        found.setdefault((Path(file).resolve(), prim), source)
    return found


def motion_files(paths: Iterable[str | Path]) -> list[Path]:
    """Return the files that motions are read from, folders sorted by name."""
    return [Path(split_location(str(path))[0]) for path in motion_sources(paths)]


def motion_sources(paths: Iterable[str | Path]) -> list[Path]:
    """Return the motions that paths name, "file[:/Prim/Path]" each; a folder stands for its USD files.

    Raises:
        SsilkError: there is no such file or folder, or a folder holds no USD file.
    """
    files: list[Path] = []
    for path in map(Path, paths):
        if not (path.is_dir() or Path(split_location(str(path))[0]).is_file()):
            fail(str(path), "there is no such file or folder", "motions are USD files or folders of them")
        within = sorted(file for file in path.iterdir() if file.suffix in USD_SUFFIXES) if path.is_dir() else [path]
        if not within:
            fail(str(path), "the folder holds no USD files", f"motions are {', '.join(USD_SUFFIXES)} files")
        files += within
    return files


@needs_whole_files
def read_motion(
    source: StageLike,
    skeleton: Skeleton,
    *,
    prim: str | None = None,
    root: str | None = None,
    within: tuple[float, float] | None = None,
) -> Motion:
    """Read a motion at its own rate: framesPerSecond if authored, else timeCodesPerSecond.

    Frames run from the first to the last authored sample, whatever range the stage says; USD interpolates between
    samples. On a character, the root joints include the xforms above the skeleton, animated or not, and the animation
    poses the joints that UsdSkel poses; one that stands alone may be in the space of the character's skeleton
    (`clips`). Joints are matched by path, then by unique leaf name, and are where the motion has them, beneath
    whichever parents (`hierarchy`). Joints that the animation lacks stay in the rest pose.

    Args:
        source: a file with a SkelAnimation, as "file[:/Prim/Path]", or a stage with an animated character.
        skeleton: skeleton whose joints the motion is for.
        prim: the SkelAnimation, by path or name, if there are several.
        root: the character, by path or name, if several are animated.
        within: time codes of the first and the last frame, in place of all samples.

    Raises:
        SsilkError: there is no animation or several, it is for another skeleton or has scales, or the data is
            malformed.
    """
    if not isinstance(source, Usd.Stage):
        source, asked = split_location(str(source))
        prim = prim or asked
    stage = open_stage(source)
    animation, placed = find_animation(stage, prim, root)
    where = location(animation)
    joints = tuple(str(name) for name in UsdSkel.Animation(animation).GetJointsAttr().Get() or ())
    need_unique(joints, where)
    if not joints and UsdSkel.Animation(animation).GetBlendShapesAttr().Get():
        fail(
            where,
            "this animation turns no joint, it moves blendshapes alone",
            "a motion turns the joints of the skeleton",
            "choose an animation of the body",
        )
    posed = posed_joints(joints, placed) if placed else None
    match = _matched(joints, posed, skeleton, where)
    codes, fps = _time_codes(stage, animation, placed, within)
    placements = np.stack([world_matrix(placed, code) for code in codes]) if placed else np.eye(4)[None]
    if placed:
        need_similarity(placed, placements)
    units = StageUnits.of(stage)
    if placed is None and skeleton.placement is not None:
        found = _space(animation, joints, match, codes, skeleton).placement
        placements, units = (placements, units) if found is None else (found[None], StageUnits())
    scale = similarity_scale(placements)
    rotations, translations = (np.empty((len(codes), skeleton.joint_count, width)) for width in (4, 3))
    for first in range(0, len(codes), _FRAMES_AT_ONCE):
        part = slice(first, first + _FRAMES_AT_ONCE)
        authored = _rigid_joints(animation, joints, codes[part], posed, skeleton, match)
        names, metres = posed.names if posed else joints, scale * units.meters_per_unit
        authored = to_parents_of(skeleton, authored, names, match, metres, alone=placed is None)
        placement = placements[part] if placed else placements
        local = joints_to_core(authored, skeleton.parents, placement, units, scale)
        local[:, match < 0] = skeleton.rest_transforms[match < 0]
        for joint in np.flatnonzero((match < 0) & (np.asarray(skeleton.parents) < 0)) if placed else ():
            local[:, joint] = placed_at_rest(skeleton, joint, units.matrix @ placement, units.matrix)
        beneath_rest(skeleton, local, names, match, units.matrix @ placement)
        if not first:
            kept = match >= 0
            _check_lengths(local[:, kept], skeleton.rest_transforms[kept], skeleton.parents[kept], where)
        rotations[part], translations[part] = quaternion_from_matrix(local[..., :3, :3]), local[..., :3, 3]
    _check_places(translations, skeleton, codes, where)
    start = float(codes[0] * fps / stage.GetTimeCodesPerSecond())
    return Motion(where, fps, rotations, translations, start)


def clip_posture(motion: Motion, skeleton: Skeleton) -> Posture | None:
    """Return by what posture the up axis of a motion was told; None where it stands in files.

    `motion` was read for `skeleton`, from a file that still exists.
    """
    file, prim = split_location(motion.path)
    stage = open_stage(file)
    animation, placed = find_animation(stage, prim, None)
    if placed is not None or skeleton.placement is None:
        return None
    joints = tuple(str(name) for name in UsdSkel.Animation(animation).GetJointsAttr().Get() or ())
    match = np.array(match_joints(skeleton.joint_names, joints))
    codes, _ = _time_codes(stage, animation, None, None)
    return _space(animation, joints, match, codes, skeleton).posture


def _space(animation: Usd.Prim, joints: tuple[str, ...], match: Ints, codes: Floats, skeleton: Skeleton) -> ClipSpace:
    """Return the space of an animation that stands alone, of a character whose Xforms place it."""
    assert skeleton.placement is not None
    stage = animation.GetStage()
    metres = similarity_scale(skeleton.placement)
    authored = _rigid_joints(animation, joints, spread(codes, LOOKED_AT), None, skeleton, match)
    local = to_parents_of(skeleton, authored, joints, match, metres, alone=True)
    says_axis = stage.HasAuthoredMetadata(UsdGeom.Tokens.upAxis)
    return clip_space(local, match, StageUnits.of(stage), skeleton, says_axis=says_axis)


def _rigid_joints(
    animation: Usd.Prim,
    joints: tuple[str, ...],
    codes: Floats,
    posed: PosedJoints | None,
    skeleton: Skeleton,
    match: Ints,
) -> Floats:
    """Return the joint-to-parent transforms of an animation, of the joints `posed` if given, without their scales.

    They are in its stage's units, shape (F, N, 4, 4).

    Raises:
        SsilkError: joints of the skeleton are scaled otherwise than at rest; also as `read_samples`.
    """
    where = location(animation)
    turns, places, factors = _scaled_samples(animation, codes, len(joints), where)
    local, names, kept = rigid(matrix_from_quaternion(turns), places), joints, np.flatnonzero(match >= 0)
    expected = np.ones(len(kept)) if skeleton.scales is None else skeleton.scales[kept]
    if posed:
        still, names = posed.source < 0, posed.names
        at_rest = np.broadcast_to(posed.rest, (len(local), *posed.rest.shape))
        local = np.array(np.where(still[:, None, None], at_rest, local[:, posed.source]))
        factors = np.where(still, posed.factors, factors[posed.source])
        expected = total_scales(posed.factors, parents_by_path(names))[match[kept]]
    parents = parents_by_path(names)
    totals = total_scales(factors, parents)
    off = ~(np.abs(totals[match[kept]] / expected - 1) <= SCALE_TOLERANCE)  # NaN is off, too
    if off.any():
        first = skeleton.joint_names[kept[off.argmax()]]
        fail(
            where,
            f"{np.count_nonzero(off)} joints are scaled otherwise than at rest, {first} first",
            "joints may only rotate and move, and keep the scale of their rest pose",
            "remove the scale",
        )
    totals = np.where(np.isfinite(totals) & (totals != 0), totals, 1.0)  # of joints that the skeleton lacks
    return spread_out(local, totals, parents)


def find_animation(stage: Usd.Stage, prim: str | None, root: str | None) -> tuple[Usd.Prim, Usd.Prim | None]:
    """Return the SkelAnimation and the Skeleton that it animates (None for an unbound animation)."""
    where = stage.GetRootLayer().identifier
    bound: dict[Usd.Prim, Usd.Prim] = {}
    own: dict[Usd.Prim, Usd.Prim] = {}
    off: dict[Usd.Prim, str] = {}
    pairs = skeletons(stage)
    bodies = of_bodies(stage, pairs)
    # Garments may have skeletons of their own, which share the character's animation, or have copies of it.
    for top, skeleton in (*bodies, *(pair for pair in pairs if pair not in bodies)):
        source, is_own = animation_source(skeleton), bool(root and named([top, skeleton], root))
        if source.prim:
            bound.setdefault(source.prim, skeleton)
        if source.prim and is_own:
            own[source.prim] = skeleton
        if source.off and (is_own or not root):
            off[skeleton] = source.off
    moved = {skeleton for _, skeleton in bodies}
    bound = own or {animation: skeleton for animation, skeleton in bound.items() if skeleton in moved} or bound
    if off and not prim and (not bound or (root and not own)):
        skeleton, why = next(iter(off.items()))
        fail(
            location(skeleton),
            f"USD plays no animation on it: {why}",
            "a motion is a SkelAnimation that plays",
            f"activate or bind one, or name one: {where}:/PRIM",
        )
    every = [other for other in Usd.PrimRange.Stage(stage, PRIMS) if other.IsA(UsdSkel.Animation)]
    found = named(every, prim) if prim else list(bound) or every
    if not found:
        fail(
            where,
            f"no SkelAnimation{f' is named {prim!r}' if prim else ''}",
            f"a motion is a SkelAnimation; there are {listed(every)}",
            "export the animation, or name another prim",
        )
    if len(found) != 1:
        fail(
            where,
            f"there are several animations: {listed(found)}",
            "one is needed",
            f"name one, such as {where}:{found[0].GetPath()}",
        )
    return found[0], bound.get(found[0])


def _matched(joints: tuple[str, ...], posed: PosedJoints | None, skeleton: Skeleton, where: str) -> Ints:
    """Return the index of each joint of the skeleton among those posed, else in the animation, or -1."""
    match = np.array(match_joints(skeleton.joint_names, posed.names if posed else joints))
    moved = (match >= 0) & (posed.source[match] >= 0) if posed else match >= 0
    found, smaller = int(np.count_nonzero(moved)), min(len(joints), skeleton.joint_count)
    missing = [name for name, each in zip(skeleton.joint_names, moved) if not each]
    if not found or 2 * found < smaller:
        fail(
            where,
            f"this is a motion of another skeleton: {found} of {skeleton.joint_count} joints match its {len(joints)} "
            f"(it lacks {', '.join(missing[:3])})",
            f"at least half of the joints of {skeleton.path} must be in it, by path or by leaf name",
            "retarget the motion or rename its joints",
        )
    return match


def _time_codes(
    stage: Usd.Stage, animation: Usd.Prim, placed: Usd.Prim | None, within: tuple[float, float] | None
) -> tuple[Floats, float]:
    """Return the time codes of the frames and their rate [1/s]."""
    fps, second = frame_rate(stage)
    span = within or sampled_span(animation, placed)
    if span is None:
        return np.zeros(1), fps
    step = second / fps
    first, last = span
    if last - first >= step * _MOST_FRAMES:
        fail(
            location(animation),
            f"samples run from time code {first:g} to {last:g}",
            f"a motion has at most {_MOST_FRAMES} frames",
            "remove stray samples",
        )
    return first + step * np.arange(int((last - first) / step + 1e-6) + 1), fps


def frame_rate(stage: Usd.Stage) -> tuple[float, float]:
    """Return the frames and the time codes of a second; raise `SsilkError` where they are out of range."""
    second = stage.GetTimeCodesPerSecond()
    fps = stage.GetFramesPerSecond() if stage.HasAuthoredMetadata("framesPerSecond") else second
    for rate, what, most in ((fps, "frames", MAX_FPS), (second, "time codes", _MOST_TIME_CODES)):
        if not MIN_FPS <= rate <= most:
            where = stage.GetRootLayer().identifier
            fail(where, f"a rate of {rate:g} {what}", f"it must be from {MIN_FPS:g} to {most:g} in a second")
    return fps, second


def sampled_span(animation: Usd.Prim, placed: Usd.Prim | None) -> tuple[float, float] | None:
    """Return the time codes of the first and last sample of a motion and its placement; None where there is none.

    Samples of blendshape weights count as far as these change: a body may breathe while its joints are still.
    """
    attributes = [animation.GetAttribute(name) for name in ("rotations", "translations")]
    times = change_times([*attributes, *(xform_attributes(placed) if placed else ())])
    weights = animation.GetAttribute("blendShapeWeights")
    more = change_times([weights])
    if more and (not times or more[0] < times[0] or more[-1] > times[-1]) and _changes(weights, more):
        times = sorted([*times, *more])
    return (times[0], times[-1]) if times else None


def _changes(attribute: Usd.Attribute, times: list[float]) -> bool:
    """Return whether an attribute has other values at some of these time codes than at the first."""
    first = attribute.Get(times[0])
    return any(attribute.Get(time) != first for time in times[1:])


def read_samples(animation: Usd.Prim, codes: Floats, count: int, where: str) -> tuple[Floats, Floats]:
    """Return rotations (F, N, 4) as (w, x, y, z) and translations (F, N, 3) in stage units."""
    rotations, translations, factors = _scaled_samples(animation, codes, count, where)
    scaled = int(np.count_nonzero(factors != 1))
    if scaled:
        fail(where, f"{scaled} joints are scaled", "joints may only rotate and move", "remove the scale")
    return rotations, translations


def _scaled_samples(animation: Usd.Prim, codes: Floats, count: int, where: str) -> tuple[Floats, Floats, Floats]:
    """Return also the one factor by which each joint is scaled, shape (N,): NaN where it differs by time or axis."""
    rotations = _sampled(animation, "rotations", codes, (count, 4), where)
    translations = _sampled(animation, "translations", codes, (count, 3), where)
    factors = np.ones(count)
    if animation.GetAttribute("scales").HasAuthoredValue():
        scales = np.moveaxis(_sampled(animation, "scales", codes, (count, 3), where), 1, 0).reshape(count, -1)
        first = scales[:, :1]
        even = (np.abs(scales - first) <= SCALE_TOLERANCE * np.abs(first)).all(axis=1) & (first[:, 0] != 0)
        near_one = (np.abs(scales - 1) <= SCALE_TOLERANCE).all(axis=1)
        factors = np.where(near_one, 1.0, np.where(even, first[:, 0], np.nan))
    norms = np.linalg.norm(rotations, axis=-1, keepdims=True)
    if norms.min() <= 1e-6:
        fail(where, "a rotation is the zero quaternion", "rotations are unit quaternions", "repair it")
    return np.roll(rotations / norms, 1, axis=-1), translations, factors


def _sampled(animation: Usd.Prim, name: str, codes: Floats, shape: tuple[int, int], where: str) -> Floats:
    """Return an attribute at each time code, shape (F, *shape)."""
    values = [np.array(animation.GetAttribute(name).Get(code)) for code in codes]
    for code, odd in zip(codes, values):
        if odd.shape != shape:
            when = f" at time code {code:g}" if animation.GetAttribute(name).HasValue() else ""
            found = f"{name} for {len(odd)} joints" if odd.ndim else f"no {name}{when}"
            needed = f"{shape[0]} are needed, one for each joint"
            fail(where, f"the animation has {found}", needed, "export it again")
    result = np.array(values, dtype=np.float64)
    bad = np.flatnonzero(~np.isfinite(result).all(axis=(1, 2)))
    if len(bad):
        found = f"{name} hold NaN or infinity in {len(bad)} frames, first at time code {codes[bad[0]]:g}"
        fail(where, found, "all must be finite", "repair the animation")
    return result


def _check_lengths(local: Floats, rest: Floats, parents: Ints, where: str) -> None:
    """Raise `SsilkError` if a motion's bones are far longer or shorter than the skeleton's: its units are wrong."""
    bones = np.linalg.norm(rest[:, :3, 3], axis=-1)
    kept = (parents >= 0) & (bones > 1e-3)
    if not kept.any():
        return
    ratio = float(np.median(np.linalg.norm(local[0, kept, :3, 3], axis=-1) / bones[kept]))
    if not 0.5 < ratio < 2:
        fail(
            where,
            f"bones are {ratio:.3g} times as long as the skeleton's",
            "both must agree in metres",
            "set metersPerUnit of the motion's file to its units",
        )


def _check_places(translations: Floats, skeleton: Skeleton, codes: Floats, where: str) -> None:
    """Raise `SsilkError` if a joint leaves any sensible world; `translations` [m] are local, shape (F, J, 3)."""
    far = np.abs(translations).max(axis=-1)
    beyond = ~(far <= FARTHEST)
    if beyond.any():
        frame, joint = np.argwhere(beyond)[0]
        name = skeleton.joint_names[joint].rpartition("/")[2]
        apart = "the origin" if skeleton.parents[joint] < 0 else "its parent"
        fail(
            where,
            f"joint {name} is {far[frame, joint]:.3g} m from {apart} at time code {codes[frame]:g}",
            f"at most {FARTHEST:g} m are allowed",
            "repair the animation, or set metersPerUnit of its file",
        )
