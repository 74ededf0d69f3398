# SPDX-License-Identifier: Apache-2.0
"""Garments in the physics engine newton (VBD and Style3D), over bodies that are animated triangle meshes.

Shots stand beside each other in one model. In every substep each body's vertices are moved between those of two
frames and its tree is refitted; pinned cloth goes where linear blend skinning puts it. Drag and tethers, which the
engine does not have, are external forces. On a GPU a frame is one CUDA graph, as in the engine's own examples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import style3d

from ssilk_core.scene.assets import PINNED, TIGHT, Floats, Ints, Mesh, Scene
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.mesh import topology

GRAVITY = (0.0, -9.81, 0.0)
APART = 10.0  # [m] between shots, along x
GAP = 0.03  # [m] beyond the distance of contact in which the body is looked for: it moves in a substep
# With self-contact VBD moves no vertex by more than 0.42 of the distance within which cloth is looked for: 10 mm in a
# substep of 1/600 s are 6 m/s.
OWN_GAP = 0.02  # [m] of that distance beyond contact
PAIRS, EDGE_PAIRS = 64, 128  # of each vertex and edge that are kept, as in the engine's example of twisted cloth


@dataclass(frozen=True)
class PeerSettings:
    """How the engine takes a frame.

    Attributes:
        solver: "vbd" or "style3d".
        substeps: of a frame; an even number, since a graph leaves the state where it took it.
        iterations: of each substep.
        self_contact: whether cloth is kept from passing through cloth; Style3D always does.
    """

    solver: str
    substeps: int
    iterations: int
    self_contact: bool


@dataclass(frozen=True, eq=False)
class Shots:
    """What N shots of F frames begin with and follow, in world space [m].

    Attributes:
        start: the garment in the first frame, shape (N, V, 3).
        bodies: vertices of the bodies, shape (N, F, B, 3).
        skinned: the garment under linear blend skinning, shape (N, F, V, 3).
        roots: of the characters, which air moves with, shape (N, F, 3).
        fps: frames per second.
    """

    start: Floats
    bodies: Floats
    skinned: Floats
    roots: Floats
    fps: float


@wp.kernel
def _move_body(course: wp.array2d[wp.vec3], frame: wp.array[int], share: float, points: wp.array[wp.vec3]):
    vertex = wp.tid()
    points[vertex] = wp.lerp(course[frame[0], vertex], course[frame[0] + 1, vertex], share)


@wp.kernel
def _move_cloth(
    course: wp.array2d[wp.vec3],
    roots: wp.array2d[wp.vec3],
    frame: wp.array[int],
    share: float,
    fps: float,
    shot: wp.array[int],
    pinned: wp.array[int],
    drag: wp.array[float],
    tether: wp.array[float],
    velocity: wp.array[wp.vec3],
    position: wp.array[wp.vec3],
    force: wp.array[wp.vec3],
):
    vertex = wp.tid()
    now = frame[0]
    target = wp.lerp(course[now, vertex], course[now + 1, vertex], share)
    if pinned[vertex] == 1:
        position[vertex] = target
    else:
        air = (roots[now + 1, shot[vertex]] - roots[now, shot[vertex]]) * fps
        force[vertex] = drag[vertex] * (air - velocity[vertex]) + tether[vertex] * (target - position[vertex])


@wp.kernel
def _next_frame(frame: wp.array[int]):
    frame[0] = frame[0] + 1


class NewtonCloth:
    """A garment of a scene in N shots; `advance` takes all of them one frame further.

    Args:
        device: of warp, "cpu" or "cuda:0".
    """

    def __init__(self, scene: Scene, fabric: Fabric, shots: Shots, settings: PeerSettings, device: str) -> None:
        self.settings, self.shots, self.device = settings, shots, device
        self.offsets = np.zeros((len(shots.start), 1, 3))
        self.offsets[:, 0, 0] = APART * np.arange(len(shots.start))
        mesh = scene.garment.rest_mesh
        law = _MappedContact.of(mesh, fabric)
        with wp.ScopedDevice(device):
            self.bodies = self._build(scene, fabric, law)
            self._upload(scene, fabric)
        self.graph: Any = None

    def _build(self, scene: Scene, fabric: Fabric, law: _MappedContact) -> list[newton.Mesh]:
        """Build model, solver and contacts, and return the bodies' meshes."""
        settings, body, is_vbd = self.settings, scene.character.merged_body().mesh, self.settings.solver == "vbd"
        builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=GRAVITY)
        shape = newton.ModelBuilder.ShapeConfig(ke=law.stiffness, kd=0.0, mu=0.0, has_shape_collision=False)
        meshes = []
        for points, offset in zip(self.shots.bodies[:, 0], self.offsets):
            part = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=GRAVITY)
            if not is_vbd:
                newton.solvers.SolverStyle3D.register_custom_attributes(part)
            meshes.append(newton.Mesh(points + offset, body.faces.reshape(-1), compute_inertia=False))
            part.add_shape_mesh(-1, mesh=meshes[-1], cfg=shape)
            _add_cloth(part, scene.garment.rest_mesh, offset[0], fabric, law, is_vbd)
            builder.add_world(part)
        if is_vbd:
            builder.color()
        self.model = model = builder.finalize()
        model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = law.stiffness, 0.0, 0.0
        whole = np.full(
            (len(meshes), 3), 1e3, dtype=np.float32
        )  # a shape is culled by the box that it was built with
        model.shape_collision_aabb_lower.assign(-whole)
        model.shape_collision_aabb_upper.assign(whole)
        flags = model.particle_flags.numpy()
        flags[np.tile(_held(scene), len(meshes))] &= ~int(newton.ParticleFlags.ACTIVE)
        model.particle_flags.assign(flags)
        if is_vbd:
            _bend_alike(model, fabric)
            self.solver: Any = newton.solvers.SolverVBD(
                model,
                iterations=settings.iterations,
                particle_enable_self_contact=settings.self_contact,
                particle_self_contact_margin=law.own_start,
                particle_self_contact_gap=OWN_GAP,
                particle_vertex_contact_buffer_size=PAIRS,
                particle_edge_contact_buffer_size=EDGE_PAIRS,
            )
        else:
            config = newton.solvers.SolverStyle3D.Config(iterations=settings.iterations)
            self.solver = newton.solvers.SolverStyle3D(model, config=config)
            self.solver.collision.radius = law.own_start
        self.states, self.control = [model.state(), model.state()], model.control()
        self.pipeline = newton.CollisionPipeline(model, soft_contact_gap=GAP)
        self.contacts = self.pipeline.contacts()
        return meshes

    def _upload(self, scene: Scene, fabric: Fabric) -> None:
        """Put what the shots follow onto the device."""
        shots, mesh = self.shots, scene.garment.rest_mesh
        count, offsets = len(shots.start), self.offsets
        areas = np.tile(topology.vertex_areas(mesh.points, mesh.faces), count)
        tight = np.tile(scene.classes == TIGHT, count)

        def vectors(values: Floats) -> wp.array:
            return wp.array(values.astype(np.float32), dtype=wp.vec3)

        self.courses = [vectors(body + offset) for body, offset in zip(shots.bodies, offsets)]
        frames = shots.skinned.shape[1]
        self.skinned = vectors((shots.skinned + offsets[:, None]).swapaxes(0, 1).reshape(frames, -1, 3))
        self.roots = vectors(shots.roots.swapaxes(0, 1))
        self.shot = wp.array(np.repeat(np.arange(count), mesh.vertex_count), dtype=int)
        self.pinned = wp.array(np.tile(_held(scene), count).astype(np.int32), dtype=int)
        self.drag = wp.array((fabric.drag * areas).astype(np.float32), dtype=float)
        self.tether = wp.array((fabric.tether * areas * tight).astype(np.float32), dtype=float)
        self.frame = wp.zeros(1, dtype=int)
        velocity = (shots.skinned[:, 1] - shots.skinned[:, 0]) * shots.fps
        self.begin = vectors((shots.start + offsets).reshape(-1, 3)), vectors(velocity.reshape(-1, 3))

    def restart(self) -> None:
        """Go back to the first frame, with the velocity of linear blend skinning."""
        for state in self.states:
            wp.copy(state.particle_q, self.begin[0])
            wp.copy(state.particle_qd, self.begin[1])
        self.frame.zero_()

    def warm_up(self) -> None:
        """Compile what a frame needs and, on a GPU, capture it; the shots are at their first frame afterwards."""
        self.restart()
        with wp.ScopedDevice(self.device):
            self._frame()
            if wp.get_device(self.device).is_cuda:
                with wp.ScopedCapture() as capture:
                    self._frame()
                self.graph = capture.graph
        self.restart()

    def advance(self) -> None:
        """Go to the next frame, and wait for the device."""
        with wp.ScopedDevice(self.device):
            if self.graph:
                wp.capture_launch(self.graph)
            else:
                self._frame()
            wp.synchronize_device()

    def points(self) -> Floats:
        """Return the garment in world space [m], shape (N, V, 3)."""
        found: Floats = self.states[0].particle_q.numpy().astype(np.float64)
        return found.reshape(len(self.offsets), -1, 3) - self.offsets

    def _frame(self) -> None:
        substeps, fps = self.settings.substeps, self.shots.fps
        for substep in range(substeps):
            now, then = self.states
            share = (substep + 1) / substeps
            for course, body in zip(self.courses, self.bodies):
                points = body.mesh.points
                wp.launch(_move_body, dim=len(points), inputs=[course, self.frame, share], outputs=[points])
                body.mesh.refit()
            now.clear_forces()
            wp.launch(
                _move_cloth,
                dim=len(self.shot),
                inputs=[self.skinned, self.roots, self.frame, share, fps, self.shot, self.pinned, self.drag,
                        self.tether, now.particle_qd],
                outputs=[now.particle_q, now.particle_f],
            )  # fmt: skip
            if substep == 0 and (self.settings.self_contact or self.settings.solver == "style3d"):
                self.solver.rebuild_bvh(now)
            self.pipeline.collide(now, self.contacts)
            self.solver.step(now, then, self.control, self.contacts, 1 / (fps * substeps))
            self.states = [then, now]
        wp.launch(_next_frame, dim=1, outputs=[self.frame])


@dataclass(frozen=True)
class _MappedContact:
    """The fabric's contact as the engine has it: a spring for each vertex [N/m] from a distance on [m].

    Deeper than its ramp our pressure grows with the depth as that of a spring which begins half a ramp later.
    """

    stiffness: float
    body_start: float
    own_start: float

    @classmethod
    def of(cls, mesh: Mesh, fabric: Fabric) -> _MappedContact:
        area = float(topology.vertex_areas(mesh.points, mesh.faces).mean())
        start, own = fabric.contact_distance - 0.5 * fabric.margin, fabric.thickness + 0.25 * fabric.margin
        return cls(fabric.loose_contact * area, start, own)


def _held(scene: Scene) -> np.ndarray:
    """Return which vertices follow linear blend skinning, bool (V,)."""
    return np.asarray(scene.classes == PINNED)


def _add_cloth(
    builder: newton.ModelBuilder, mesh: Mesh, offset: Floats, fabric: Fabric, law: _MappedContact, is_vbd: bool
) -> None:
    """Add a garment at rest."""
    shared = {
        "pos": wp.vec3(*offset),
        "rot": wp.quat_identity(),
        "scale": 1.0,
        "vel": wp.vec3(0.0, 0.0, 0.0),
        "vertices": [wp.vec3(*point) for point in mesh.points],
        "indices": mesh.faces.reshape(-1).tolist(),
        "density": fabric.density,
        "particle_radius": law.body_start,
    }
    if is_vbd:
        membrane = {"tri_ke": fabric.lame_mu, "tri_ka": fabric.lame_lambda, "tri_kd": 0.0}
        builder.add_cloth_mesh(**shared, **membrane, edge_ke=fabric.bending, edge_kd=0.0)
        return
    flat = _flat_triangles(mesh)
    mu, lame = fabric.lame_mu, fabric.lame_lambda
    stretch = 4 * mu * (mu + lame) / (2 * mu + lame)  # of a sheet that may narrow: Style3D has no Poisson's ratio
    bend = fabric.bending / 12  # of its quadratic energy, for small angles; its panels are flat at rest
    style3d.add_cloth_mesh(
        builder,
        panel_verts=flat.reshape(-1, 2).tolist(),
        panel_indices=np.arange(3 * len(flat)).tolist(),
        tri_aniso_ke=wp.vec3(stretch, stretch, mu),
        edge_aniso_ke=wp.vec3(bend, bend, bend),
        **shared,
    )


def _flat_triangles(mesh: Mesh) -> Floats:
    """Return each triangle laid flat by itself, shape (F, 3, 2)."""
    a, b, c = (mesh.points[mesh.faces[:, corner]] for corner in range(3))
    first, second = b - a, c - a
    length = np.linalg.norm(first, axis=1)
    along = (first * second).sum(1) / length
    flat = np.zeros((len(a), 3, 2))
    flat[:, 1, 0], flat[:, 2, 0] = length, along
    flat[:, 2, 1] = np.linalg.norm(np.cross(first, second), axis=1) / length
    return flat


def _bend_alike(model: newton.Model, fabric: Fabric) -> None:
    """Give each edge the bending energy that it has in `ssilk_core.physics.energy`."""
    rows: Ints = model.edge_indices.numpy()
    properties = model.edge_bending_properties.numpy()
    inner = (rows[:, :2] >= 0).all(1)
    points = model.particle_q.numpy().astype(np.float64)
    left, right, start, end = (points[rows[inner, column]] for column in range(4))
    edge = end - start
    doubled = sum(np.linalg.norm(np.cross(edge, tip - start), axis=1) for tip in (left, right))
    properties[inner, 0] = fabric.bending * np.linalg.norm(edge, axis=1) / (2 * doubled)
    model.edge_bending_properties.assign(properties)
