# SPDX-License-Identifier: Apache-2.0
"""Every finding of the preflight: an input that triggers it, and one that does not; repairs as index maps."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from ssilk_core.authoring.preflight import attachment, cost, fit, motion, pose, units, winding
from ssilk_core.authoring.preflight import mesh as meshes
from ssilk_core.authoring.preflight.finding import Finding
from ssilk_core.authoring.preflight.inspection import PreflightInput, inspect
from ssilk_core.authoring.preflight.motion import MotionFile
from ssilk_core.authoring.preflight.repair import MeshRepair, merge_targets, plan_repair
from ssilk_core.authoring.preflight.table import format_findings
from ssilk_core.authoring.preflight.units import FileUnits
from ssilk_core.authoring.setup.prepare import prepare_scene
from ssilk_core.authoring.setup.rig import RigOptions
from ssilk_core.scene.assets import (
    LOOSE,
    PINNED,
    TIGHT,
    Body,
    Character,
    Garment,
    Mesh,
    Motion,
    Skeleton,
    SkinWeights,
)
from ssilk_core.scene.kinematics import MAX_JOINT_SPEED, multiply_quaternions, split_at_cuts
from ssilk_core.training.prediction import SECONDS_PER_SAMPLE, training_seconds
from ssilk_core.training.settings import PRESETS

METRES = FileUnits("hero.usda", 1.0, "Y", True, True)
CENTIMETRES_ASSUMED = FileUnits("cape.usda", 0.01, "Y", False, False)
SKELETON = Skeleton("/Rig", ("Hips", "Hips/Spine", "Hips/Tail"), [-1, 0, 0], *[np.tile(np.eye(4), (3, 1, 1))] * 2)


def grid(columns: int = 4, rows: int = 4, size: float = 0.1) -> Mesh:
    """A square sheet in the xy plane with its normals along +z."""
    y, x = np.mgrid[0:rows, 0:columns]
    corner = (y[:-1, :-1] * columns + x[:-1, :-1]).reshape(-1)
    faces = np.concatenate(
        [np.c_[corner, corner + 1, corner + columns + 1], np.c_[corner, corner + columns + 1, corner + columns]]
    )
    return Mesh("cape.usda:/Cape", np.c_[x.reshape(-1), y.reshape(-1), np.zeros(x.size)] * size, faces)


def pillar(height: float = 1.7, radius: float = 0.15) -> Mesh:
    """A closed body: a cylinder that stands on the floor, with its normals outward."""
    side = [(radius, at) for at in np.linspace(0, height, 25)]  # long triangles are near much of the cloth
    shape = trimesh.creation.revolve([(0, 0), *side, (0, height)], sections=24)
    return Mesh("hero.usda:/Body", shape.vertices[:, [0, 2, 1]] * [1, 1, -1], shape.faces)


def tube(radius: float = 0.17, low: float = 0.9, high: float = 1.4, rows: int = 13) -> Mesh:
    """Cloth around the pillar, its normals outward."""
    columns = 32
    angle, y = np.arange(columns) * 2 * np.pi / columns, np.linspace(low, high, rows)
    points = np.stack(np.broadcast_arrays(radius * np.sin(angle), y[:, None], radius * np.cos(angle)), -1).reshape(
        -1, 3
    )
    row, column = (part.reshape(-1) for part in np.mgrid[0 : rows - 1, 0:columns])
    a, b = row * columns + column, row * columns + (column + 1) % columns
    faces = np.concatenate([np.c_[a, b, b + columns], np.c_[a, b + columns, a + columns]])
    return Mesh("cape.usda:/Tube", points, faces)


def hero(body: Mesh | None = None) -> Character:
    body = body or pillar()
    count = body.vertex_count
    skin = SkinWeights(body.path, (body.points[:, 1:2] > 1.0).astype(int), np.ones((count, 1)))
    return Character("hero.usda:/Hero", SKELETON, (Body(body, skin),))


def still(frames: int = 60, fps: float = 30.0) -> Motion:
    return Motion("walk.usda:/Walk", fps, np.tile([1.0, 0, 0, 0], (frames, 3, 1)), np.zeros((frames, 3, 3)))


def turning(frames: int = 60) -> Motion:
    angle = np.linspace(0, 0.5, frames)[:, None] * [1, 1, 1]
    rotations = np.stack([np.cos(angle), np.sin(angle), 0 * angle, 0 * angle], -1)
    return replace(still(frames), rotations=rotations)


def only(findings) -> Finding:
    (finding,) = findings
    return finding


def codes(findings: list[Finding]) -> set[str]:
    return {finding.code for finding in findings}


# The mesh by itself


def test_cloth_with_thickness_is_told_and_other_cloth_is_not():
    sheet = tube()
    count, rows = sheet.vertex_count, sheet.vertex_count // 32
    outer = sheet.points * [1.03, 1, 1.03]  # 5 mm further out
    rim = [(a, (a + 1) % 32) for a in range(32)]
    joined = [[(a, b, b + count), (a, b + count, a + count)] for a, b in rim]
    top = [[(a + low, b + low + count, b + low), (a + low, a + low + count, b + low + count)]
           for low in [32 * (rows - 1)] for a, b in rim]  # fmt: skip
    faces = np.concatenate([sheet.faces[:, ::-1], sheet.faces + count, *joined, *top])
    shell = Mesh(sheet.path, np.concatenate([sheet.points, outer]), faces)
    for mesh in (shell, replace(shell, faces=faces[:, ::-1])):  # inside out, too
        found = only(meshes.two_layers(mesh))
        assert found.count == 2 * count and "two layers are 5.1 mm apart" in found.found
    cord = replace(sheet, points=sheet.points * [0.03, 1, 0.03])  # of 10 mm
    for mesh in (sheet, grid(), cord, replace(shell, faces=faces[: 2 * len(sheet.faces)])):
        assert not list(meshes.two_layers(mesh))


def test_isolated_vertices():
    sheet = grid()
    with_lone = Mesh(
        sheet.path,
        np.r_[sheet.points[:2], [[9, 9, 9]], sheet.points[2:]],
        np.where(sheet.faces > 1, sheet.faces + 1, sheet.faces),
    )
    found = only(meshes.isolated_vertices(with_lone))
    assert (found.severity, found.indices, found.count, found.fixable) == ("error", (2,), 1, True)
    assert not list(meshes.isolated_vertices(sheet))


def test_duplicate_vertices_name_both_sides_of_a_seam_and_what_can_be_merged():
    left = grid(2, 3)
    both = Mesh(left.path, np.r_[left.points, left.points + [0.1, 0, 0]], np.r_[left.faces, left.faces + 6])
    seam = (1, 3, 5, 6, 8, 10)
    found = only(meshes.duplicate_vertices(both, np.array(seam)))
    assert found.indices == seam and found.fixable
    part = only(meshes.duplicate_vertices(both, np.array([1, 6])))
    assert not part.fixable and "--fix merges 2" in part.fix
    apart = replace(both, points=np.r_[left.points, left.points + [0.1001, 0, 0]])
    assert not list(meshes.duplicate_vertices(apart, np.array([])))


def test_duplicate_faces():
    sheet = grid()
    doubled = Mesh(sheet.path, sheet.points, np.r_[sheet.faces, [np.roll(sheet.faces[3], 1), sheet.faces[0][::-1]]])
    assert only(meshes.duplicate_faces(doubled)).indices == (18, 19)
    assert not list(meshes.duplicate_faces(sheet))
    assert not list(meshes.non_manifold_edges(doubled))  # said once


def test_non_manifold_edges():
    sheet = grid()
    fin = Mesh(sheet.path, np.r_[sheet.points, [[0.15, 0.15, 0.1]]], np.r_[sheet.faces, [[5, 6, 16]]])
    found = only(meshes.non_manifold_edges(fin))
    assert found.indices == (5, 6) and not found.fixable
    assert not list(meshes.non_manifold_edges(sheet))


def test_degenerate_faces_and_slivers():
    triangles = np.array(
        [
            [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
            [[0, 0, 0], [1, 0, 0], [0.5, 0, 0]],
            [[0, 0, 0], [1, 0, 0], [0.5, 0.01, 0]],
        ]
    )
    mesh = Mesh("m", triangles.reshape(-1, 3), np.arange(9).reshape(3, 3))
    flat, sliver = meshes.degenerate_faces(mesh, 0)
    assert (flat.code, flat.severity, flat.indices, flat.fixable) == ("degenerate-faces", "error", (1,), False)
    assert (sliver.code, sliver.severity, sliver.indices) == ("sliver-faces", "warning", (2,))
    assert not list(meshes.degenerate_faces(grid(), 0))


def test_what_has_no_area_here_is_what_training_refuses():
    from ssilk_core.errors import SsilkError
    from ssilk_core.physics.energy.stretch import rest_frames

    for height in np.logspace(-12, -6, 13):
        mesh = Mesh("m", [[0, 0, 0], [1, 0, 0], [0.5, height, 0]], [[0, 1, 2]])
        flat = "degenerate-faces" in codes(list(meshes.degenerate_faces(mesh, 0)))
        try:
            rest_frames(mesh)
        except SsilkError:
            assert flat
        else:
            assert not flat


# Winding


def test_inconsistent_winding_names_the_minority():
    sheet = grid()
    faces = sheet.faces.copy()
    faces[[2, 11]] = faces[[2, 11], ::-1]
    assert only(winding.inconsistent_winding(Mesh(sheet.path, sheet.points, faces))).indices == (2, 11)
    assert not list(winding.inconsistent_winding(sheet))


def test_each_surface_has_its_own_winding():
    sheet = grid()
    two = Mesh(sheet.path, np.r_[sheet.points, sheet.points + 1], np.r_[sheet.faces, sheet.faces[:, ::-1] + 16])
    assert not list(winding.inconsistent_winding(two))
    _, surface = winding.consistent_flips(np.full(36, 3), two.faces.reshape(-1))
    assert surface.tolist() == [0] * 18 + [1] * 18


def test_a_moebius_strip_is_left_as_it_is():
    turns = np.arange(8)
    corners = np.r_[np.c_[turns, turns + 8].reshape(-1), 8, 0]  # the end meets the start upside down
    faces = np.array([[corners[2 * i], corners[2 * i + 1], corners[2 * i + 3], corners[2 * i + 2]] for i in range(8)])
    flips, surface = winding.consistent_flips(np.full(8, 4), faces.reshape(-1))
    assert not flips.any() and not surface.any()


def test_inside_out():
    cloth, body = tube(), pillar()
    assert not list(winding.inside_out(cloth, body))
    found = only(winding.inside_out(Mesh(cloth.path, cloth.points, cloth.faces[:, ::-1]), body))
    assert found.count == len(cloth.faces) and found.fixable


# Fit


MOVED = "it appears to have been moved"


@pytest.mark.parametrize(
    ("change", "hint"),
    [
        (lambda p: p * 100, "100 times its size"),
        (lambda p: p * 0.01, "0.01 times its size"),
        (lambda p: p[:, [0, 2, 1]] * [1, -1, 1], "Z is up"),
        (lambda p: (p * [1, 1.6, 1] + [2.5, 0, 0]) * 100, "be 100 times its size"),  # far away besides
        (lambda p: p + [3, 0, 0], MOVED),
        (lambda p: p * 0.6 + [0, 0, 1], MOVED),  # made a tenth of its size, it would lie at the body's feet
    ],
)
def test_alignment(change, hint):
    cloth, body = tube(), pillar()
    assert not list(fit.alignment(cloth, body))
    moved = Mesh(cloth.path, change(cloth.points), cloth.faces)
    found, guess = only(fit.alignment(moved, body)), fit.find_unit_correction(moved, body)
    assert found.severity == "error" and hint in found.found
    # A mere offset is nothing that units could explain, and what is authored is not contradicted.
    assert ("metersPerUnit" in found.fix) == CENTIMETRES_ASSUMED.allows(guess) == (hint != MOVED)
    assert not METRES.allows(guess)


def test_a_wide_gown_is_not_misplaced():
    gown = tube(0.6, 0.2, 1.2)
    held = np.linspace(0.16, 0.6, 13).repeat(32) / 0.6  # from the pillar outward to the hem
    points = gown.points * np.c_[held[::-1], np.ones(416), held[::-1]]
    assert np.median(fit.signed_distance(points, pillar())) > 0.2
    assert not list(fit.alignment(Mesh(gown.path, points, gown.faces), pillar()))


def test_body_not_watertight_and_inside_out():
    body = pillar()
    open_body = Mesh(body.path, body.points, body.faces[1:])
    assert only(fit.body_holes(open_body)).indices == tuple(sorted(body.faces[0].tolist()))
    assert not list(fit.body_holes(body)) and not list(fit.body_inside_out(body))
    corners = np.arange(open_body.faces.size).reshape(-1, 3)
    split = Mesh(body.path, open_body.points[open_body.faces].reshape(-1, 3), corners)
    found = only(fit.body_holes(split))  # as glTF files split bodies along seams of their textures
    assert found.found == "the body is open along 3 edges"
    rim = np.unique(split.points[list(found.indices)], axis=0)
    np.testing.assert_array_equal(rim, np.unique(body.points[body.faces[0]], axis=0))
    assert only(fit.body_inside_out(Mesh(body.path, body.points, body.faces[:, ::-1]))).severity == "error"


def test_penetration_counts_and_measures():
    body = pillar()
    assert not list(fit.penetration(tube(0.17), body))
    near = only(fit.penetration(tube(0.1525), body))
    assert (near.code, near.severity, near.fixable) == ("inside-margin", "info", False)
    assert "collisions start at 8.5 mm" in near.found  # a margin of 8 mm, to fabric of 1 mm
    cloth = tube(0.157)
    points = cloth.points.copy()
    points[:32, [0, 2]] *= 0.145 / 0.157
    deep, near = fit.penetration(Mesh(cloth.path, points, cloth.faces), body)
    assert (deep.code, deep.fixable, near.code, near.fixable) == ("penetration", True, "inside-margin", False)
    cloth = tube(0.17)
    points = cloth.points.copy()
    points[:32, [0, 2]] *= 0.12 / 0.17
    deep = only(fit.penetration(Mesh(cloth.path, points, cloth.faces), body))
    assert (deep.code, deep.severity, deep.fixable) == ("penetration", "warning", True)
    assert (deep.indices == tuple(range(32)) and "30." in deep.found) or "29." in deep.found
    assert only(fit.penetration(tube(0.1), body)).severity == "error"
    box = trimesh.creation.box((0.28, 0.3, 0.28))  # only its corners are outside
    through = next(fit.penetration(Mesh("box", box.vertices + [0, 1.1, 0], box.faces), body))
    assert through.count == 8 and through.found.startswith("points inside triangles are inside the body")


def test_signed_distance_against_a_sphere():
    ball = trimesh.creation.icosphere(4, 0.5)
    mesh = Mesh("ball", ball.vertices, ball.faces)
    points = np.random.default_rng(0).normal(size=(200, 3)) * 0.4
    expected = np.linalg.norm(points, axis=1) - 0.5
    assert np.abs(fit.signed_distance(points, mesh) - expected).max() < 1e-3
    inverted = Mesh("ball", ball.vertices, ball.faces[:, ::-1])
    assert np.allclose(fit.signed_distance(points, inverted), fit.signed_distance(points, mesh))


def test_what_stays_inside_is_told_with_its_place():
    deep = Mesh("cape.usda:/Tube", tube(0.17).points * [0.4, 1, 0.4], tube().faces)  # 80 mm, not fitted at all
    found = next(fit.penetration(deep, pillar()))
    assert not found.fixable and "more than 40 mm deep" in found.fix
    (told,) = plan_repair(hero(), Garment(deep), None, topology=False).done
    assert told.startswith("left 416 vertices inside the body, up to 8") and "at Spine, Hips" in told


def test_rest_pose():
    character, cloth = hero(), tube(0.17, 1.2, 1.6)
    assert not list(pose.rest_pose(character, cloth))
    bent = SKELETON.rest_transforms.copy()
    bent[1, :3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    other = replace(character, skeleton=replace(SKELETON, rest_transforms=bent))
    told = only(pose.rest_pose(other, cloth))
    assert (told.severity, told.indices) == ("info", (1,)) and "Spine" in told.found
    # Cloth that lies inside the bound body, and free where the body bends away at rest: modelled on the rest pose.
    assert only(pose.rest_pose(other, tube(0.1, 1.2, 1.6))).severity == "error"
    assert np.allclose(pose.rest_angles(other.skeleton), [0, 90, 0])


# Units


def test_unauthored_units():
    assert not list(units.unauthored_units(METRES))
    meters, axis = units.unauthored_units(CENTIMETRES_ASSUMED)
    assert "metersPerUnit" in meters.found and "upAxis" in axis.found and meters.fixable


@pytest.mark.parametrize(("size", "hint"), [(0.01, "metersPerUnit 1;"), (100.0, "metersPerUnit 0.0001;")])
def test_character_size(size, hint):
    body = pillar()
    assert not list(units.body_size(body, METRES))
    wrong = only(units.body_size(Mesh(body.path, body.points * size, body.faces), CENTIMETRES_ASSUMED))
    assert wrong.severity == "error" and wrong.fixable and hint in wrong.found + ";"


def test_a_character_that_lies_is_read_with_the_wrong_axis():
    body = pillar()
    lying = Mesh(body.path, body.points[:, [0, 2, 1]] * [1, -1, 1], body.faces)
    found = only(units.body_size(lying, CENTIMETRES_ASSUMED))
    assert "upAxis Z" in found.found and found.fixable
    corrected = CENTIMETRES_ASSUMED.corrected(units.find_upright_units(lying))
    assert (corrected.meters_per_unit, corrected.up_axis) == (0.01, "Z")
    assert METRES.corrected(units.find_upright_units(lying)) == METRES  # what is authored stays


# What holds the garment


def lying(offset: tuple[float, float, float]) -> Mesh:
    """A sheet of 30 cm with a patch of 9 cm, moved from its corner."""
    sheet = grid()
    patch = sheet.points * 0.3 + np.array(offset)
    points, faces = np.r_[sheet.points, patch], np.r_[sheet.faces, sheet.faces + sheet.vertex_count]
    return Mesh(sheet.path, points, faces)


def test_what_lies_on_an_island_is_stitched_and_what_touches_it_at_its_side_is_not():
    on, beside, off = lying((0.1, 0.1, 0.002)), lying((0.302, 0.1, 0)), lying((0.1, 0.1, 0.02))
    loose, tight = (np.full(on.vertex_count, kind) for kind in (LOOSE, TIGHT))
    found = only(attachment.stitched_islands(on, loose))
    assert found.severity == "info" and found.found.startswith("1 of 2 islands lie on others: stitches")
    assert "and 1 that lie wholly" in found.found and found.indices == tuple(range(16, 32))
    assert not list(attachment.touching_islands(on, loose))
    warned = only(attachment.touching_islands(beside, loose))
    assert warned.severity == "warning" and warned.found.startswith("1 of 2 islands touch others side by side")
    assert warned.indices == (16, 20, 24, 28) and not list(attachment.stitched_islands(beside, loose))
    sheet = grid()
    for mesh, classes in ((on, tight), (beside, tight), (off, loose), (sheet, loose[:16])):
        assert not list(attachment.touching_islands(mesh, classes))
        assert not list(attachment.stitched_islands(mesh, classes))


def test_an_island_that_is_stitched_to_a_held_one_is_held():
    classes = np.full(32, LOOSE)
    classes[0] = PINNED
    assert not list(attachment.unattached_islands(lying((0.1, 0.1, 0.002)), classes))
    assert only(attachment.unattached_islands(lying((0.1, 0.1, 0.02)), classes)).indices == tuple(range(16, 32))


def test_class_coverage_and_unheld_islands():
    sheet = grid()
    two = Mesh(sheet.path, np.r_[sheet.points, sheet.points + 1, [[9, 9, 9]]], np.r_[sheet.faces, sheet.faces + 16])
    classes = np.full(33, LOOSE)
    classes[0], classes[1] = PINNED, TIGHT
    assert "1 pinned, 1 tight, 31 loose" in only(attachment.class_coverage(two, classes)).found
    assert only(attachment.unattached_islands(two, classes)).indices == tuple(
        range(16, 32)
    )  # the lone vertex is another finding
    classes[20] = TIGHT
    assert not list(attachment.unattached_islands(two, classes))
    assert "no proxies" in only(attachment.class_coverage(two, np.full(33, TIGHT))).found


# Motions


def test_root_jumps():
    motion_ = turning()
    assert not list(motion.root_jumps(motion_, SKELETON))
    jumped = motion_.translations.copy()
    jumped[40:, 0] += [2.0, 0, 0]
    found = only(motion.root_jumps(replace(motion_, translations=jumped), SKELETON))
    assert found.indices == (40,) and "2 m" in found.found


def leaning(*degrees: float) -> Motion:
    """A motion in which the hub leans about x, by so many degrees in each frame."""
    half = np.radians(degrees)[:, None] / 2 * [1, 0, 0]
    return replace(still(len(degrees)), rotations=np.stack([np.cos(half), np.sin(half), 0 * half, 0 * half], axis=-1))


def test_a_character_that_lies_throughout_is_told():
    found = only(motion.lying(leaning(*[90] * 40, *[100] * 20), SKELETON))
    assert "lies or stands on its head in 60 of 60 frames" in found.found and found.count == 60
    assert not list(motion.lying(leaning(*[90] * 20, *[0] * 40), SKELETON))


@pytest.mark.parametrize("turn", [-90, 90])  # Z-up read as Y-up, and Y-up as Z-up
def test_a_dancer_who_leans_is_told_where_the_other_axis_stands_her_up(turn):
    lean = np.array([10.0, 30, 35, 40, 45, 30]) * -np.sign(turn)
    assert not list(motion.lying(leaning(*lean), SKELETON))
    found = only(motion.lying(leaning(*lean + turn), SKELETON))
    assert "leans by 59 degrees on average, and by 33 if the up axis" in found.found and found.count == 6


def test_joint_jumps():
    assert not list(motion.joint_jumps(turning(), SKELETON))
    moved = turning().translations.copy()
    moved[40:, 0] += 2.0  # the root: another finding
    assert not list(motion.joint_jumps(replace(turning(), translations=moved), SKELETON))
    moved[30:, 2, 1] += 1000.0
    found = only(motion.joint_jumps(replace(turning(), translations=moved), SKELETON))
    assert found.indices == (30,) and "Tail moves 1e+03 m" in found.found


def test_joint_snaps():
    flipped = turning().rotations.copy()
    flipped[30:, 2] = [0, 0, 1, 0]
    found = only(motion.joint_snaps(replace(turning(), rotations=flipped), SKELETON))
    assert found.indices == (30,) and "Tail" in found.found
    assert not list(motion.joint_snaps(turning(), SKELETON))
    assert not list(motion.joint_snaps(replace(turning(), rotations=-turning().rotations), SKELETON))


def test_what_training_cuts_at_is_told_before_it():
    """A joint that turns by 80 degrees in a frame, at 30 frames per second, and stays there."""
    clip = turning()
    rotations, half = clip.rotations.copy(), np.radians(40)
    rotations[:] = rotations[:1]
    rotations[30:, 2] = multiply_quaternions(rotations[30:, 2], np.array([np.cos(half), 0, 0, np.sin(half)]))
    clip = replace(clip, rotations=rotations, fps=30.0)
    spans = split_at_cuts(clip, SKELETON, max_joint_speed=MAX_JOINT_SPEED)
    found = only(motion.joint_snaps(clip, SKELETON))
    assert found.count == len(spans) - 1 == 1 and found.indices == (30,) and "by 80 degrees" in found.found
    assert not list(motion.joint_snaps(replace(clip, fps=24.0), SKELETON))
    longest = max(span.frame_count for span in spans)
    assert longest < clip.frame_count and list(motion.short_motion(clip, SKELETON, 30, longest + 1))


def test_short_motions_count_the_longest_span_at_the_rate_of_the_model():
    assert not list(motion.short_motion(still(61, 60), SKELETON, 30, 31))
    assert "31 poses" in only(motion.short_motion(still(61, 60), SKELETON, 30, 32)).found
    assert "1 poses" in only(motion.short_motion(still(1), SKELETON, 30, 16)).found


@pytest.mark.parametrize(("fps", "count"), [(5, 1), (24, 0), (60, 0), (240, 0), (4800, 1)])
def test_frame_rates(fps, count):
    assert len(list(motion.unusual_rate(still(30, fps)))) == count


def test_gaps_in_samples():
    dense = np.arange(100) / 30
    whole = MotionFile("walk.usda:/Walk", np.arange(3), dense)
    assert not list(motion.sample_gaps(whole))
    assert (
        "1 s from 1.63 s" in only(motion.sample_gaps(replace(whole, times=np.r_[dense[:50], dense[50:] + 1]))).found
    )
    assert not list(motion.sample_gaps(replace(whole, times=np.array([0.0, 2.0, 5.0, 9.0]))))  # keys, not samples


def test_joints_that_a_motion_lacks_or_that_never_turn():
    file = MotionFile("walk.usda:/Walk", np.array([0, 2]), np.arange(10.0))
    assert only(motion.missing_joints(file, SKELETON)).indices == (1,)
    assert not list(motion.missing_joints(replace(file, joints=np.arange(3)), SKELETON))
    one = still().rotations.copy()
    one[:, 1] = turning().rotations[:, 1]
    assert only(motion.still_joints([still(), replace(still(), rotations=one)], SKELETON)).indices == (0, 2)
    assert not list(motion.still_joints([turning()], SKELETON))


# Cost


def dressed(cloth: Mesh):
    classes = np.where(cloth.points[:, 1] > 1.3, TIGHT, LOOSE)
    return prepare_scene(hero(), Garment(cloth, classes=classes), rig_options=RigOptions(proxies=4))


def test_joints_that_cannot_matter(monkeypatch):
    found = list(cost.training_cost(dressed(tube()), [still()], PRESETS["draft"]))
    assert [f.code for f in found] == ["memory", "time", "irrelevant-joints"]
    assert found[-1].indices == (2,)  # nothing is skinned to the tail
    assert "other programs" not in found[1].why
    monkeypatch.setattr("ssilk_core.devices.busy_cores", lambda: 1.5)
    assert (
        "other programs put a load of about 1.5 on"
        in list(cost.memory(dressed(tube()), PRESETS["draft"], 100))[1].why
    )


def test_memory_says_when_the_batch_is_lowered(monkeypatch):
    from ssilk_core.training import memory

    scene = dressed(tube())
    assert next(cost.memory(scene, PRESETS["draft"], 100)).severity == "info"
    step = memory.StepMemory(scene, PRESETS["draft"].model, 100, 900)
    monkeypatch.setattr(memory, "free_memory", lambda device: step.needed(20))
    assert next(cost.memory(scene, PRESETS["draft"], 100)).severity == "warning"


def test_time_grows_with_samples_and_frames_and_is_not_guessed():
    train = replace(PRESETS["draft"].train, iterations=10, static_fraction=0.0, batch=4, window=16)
    assert training_seconds(2700, train, "cpu") == pytest.approx(10 * 64 * 2700 * SECONDS_PER_SAMPLE["cpu"])
    warm = replace(train, static_fraction=0.5, pretraining_batch=128)
    assert training_seconds(2700, warm, "cpu") == pytest.approx(1.5 * training_seconds(2700, train, "cpu"))
    assert training_seconds(2700, train, "abacus") is None


# Repair


def repaired(mesh: Mesh, plan: MeshRepair) -> Mesh:
    """The mesh that a plan describes."""
    indices = plan.new_index[mesh.indices_of_corners[plan.corners]]
    return Mesh(mesh.path, mesh.points[plan.kept] + plan.offsets, indices.reshape(-1, 3), plan.counts, indices)


def damaged() -> Mesh:
    """A tube with every kind of damage that can be repaired: inside out, slit open, doubled, with loose ends."""
    cloth = tube()
    slit = np.arange(0, cloth.vertex_count, 32)
    copy = np.arange(cloth.vertex_count)
    copy[slit] = cloth.vertex_count + np.arange(len(slit))
    faces = cloth.faces.copy()
    before = (faces % 32 == 31).any(axis=1)
    faces[before] = copy[faces[before]]
    faces = faces[:, ::-1].copy()
    faces[5] = faces[5, ::-1]
    points = np.r_[cloth.points, cloth.points[slit], [[1, 1, 1]]]
    return Mesh(cloth.path, points, np.r_[faces, [faces[7]], [[40, 41, 41]], [faces[9][[1, 2, 0]]]])


def test_a_damaged_garment_is_found_out_and_repaired():
    cloth, body, character = damaged(), pillar(), hero()
    before = inspect(world(Garment(cloth)))
    assert {"isolated-vertices", "duplicate-vertices", "duplicate-faces", "degenerate-faces", "inside-out",
            "inconsistent-winding"} <= codes(before)  # fmt: skip
    assert all(f.fixable for f in before if f.severity != "info")
    plan = plan_repair(character, Garment(cloth), None)
    whole = repaired(cloth, plan)
    original = tube()
    assert np.array_equal(np.sort(whole.points, axis=0), np.sort(original.points, axis=0))
    assert len(whole.faces) == len(original.faces) and not list(winding.inside_out(whole, body))
    assert all(f.severity == "info" for f in inspect(world(Garment(whole))))
    assert plan.done[:3] == ("13 vertices merged into others", "1 isolated vertex removed", "3 faces removed")


def test_vertices_merge_only_where_classes_and_weights_agree():
    left = grid(2, 3)
    both = Mesh(left.path, np.r_[left.points, left.points + [0.1, 0, 0]], np.r_[left.faces, left.faces + 6])
    free = merge_targets(Garment(both), None, hero())
    assert free.tolist() == [0, 1, 2, 3, 4, 5, 1, 7, 3, 9, 5, 11]
    classes = np.full(12, LOOSE)
    classes[6] = TIGHT
    assert merge_targets(Garment(both, classes=classes), None, hero())[[6, 8, 10]].tolist() == [6, 3, 5]
    skin = SkinWeights("w", np.r_[np.zeros((8, 1)), [[1]], np.zeros((3, 1))].astype(int), np.ones((12, 1)))
    assert merge_targets(Garment(both, skin), None, hero())[[6, 8, 10]].tolist() == [1, 8, 5]


def test_layers_that_touch_stay_apart():
    sheet = grid()
    layers = Mesh(sheet.path, np.r_[sheet.points, sheet.points], np.r_[sheet.faces, sheet.faces + 16])
    fin = Mesh(sheet.path, np.r_[layers.points, sheet.points + [0.3, 0, 0]], np.r_[layers.faces, sheet.faces + 32])
    assert np.array_equal(merge_targets(Garment(fin), None, hero())[:32] % 16, np.arange(32) % 16)
    whole = merge_targets(Garment(fin), None, hero())[fin.faces]
    from ssilk_core.scene.mesh.topology import edge_use

    assert edge_use(np.unique(np.sort(whole, axis=1), axis=0))[1].max() <= 2


def test_a_locked_garment_is_only_moved():
    cloth = damaged()
    plan = plan_repair(hero(), Garment(cloth), None, topology=False)
    assert not plan.reshapes and np.array_equal(repaired(cloth, plan).faces, cloth.faces)
    locked = inspect(replace(world(Garment(cloth)), locked="blendshapes"))
    assert not any(f.fixable for f in locked) and any("blendshapes" in f.fix for f in locked)


# The whole


def world(garment: Garment, motions: tuple[Motion, ...] = ()) -> PreflightInput:
    return PreflightInput(
        character=hero(), garment=garment, rig=None, character_units=METRES, garment_units=METRES, locked="",
        motions=motions, files=(), preset=PRESETS["draft"],
    )  # fmt: skip


def test_a_clean_garment_raises_no_alarm():
    findings = inspect(world(Garment(tube()), (turning(),)))
    assert all(finding.severity == "info" for finding in findings)
    assert {"classes", "memory", "time", "irrelevant-joints"} <= codes(findings)
    assert format_findings(findings).endswith("Nothing wrong was found.")


def test_what_cannot_be_rigged_is_an_error_in_the_words_of_the_rig():
    halves = Mesh(
        "g", np.r_[tube().points, tube(0.6, 1.0, 1.2).points], np.r_[tube().faces, tube(0.6, 1.0, 1.2).faces + 416]
    )
    found = only(f for f in inspect(world(Garment(halves))) if f.severity == "error")
    assert found.code == "not-riggable" and "rest nowhere on the body" in found.found
    assert found.found.startswith("1 of 2 islands")  # where it is, the finding says itself
    assert "or it falls off" in found.why and "move the garment onto the body" in found.fix


def test_findings_are_grouped_the_worst_first():
    findings = [
        Finding(severity="info", code="a", prim="p", found="x"),
        *(
            Finding(severity="warning", code="b", prim=f"clip{n}", found="y", elements="frames", fix="z")
            for n in range(7)
        ),
    ]
    text = format_findings(findings)
    assert text.index("WARNING  b") < text.index("INFO  a") and text.count("fix: z") == 1
    assert "1 frame in clip0: y" in text and "2 more places" in text and text.endswith("7 warnings.")
