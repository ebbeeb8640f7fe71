"""The 3D scene of the page."""

import cmath
import math
from collections.abc import Collection, Iterable, Sequence
from typing import Any

import mujoco
import numpy as np
import trimesh
import viser
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial
from viser.transforms import SE3, SO3

from legged_torque.utils.heading import heading
from legged_torque.utils.mjcf import DRAWN_GROUPS
from legged_torque.viewer.drawing import ARROW_LENGTH, HEIGHTS, MIN_SPEED, Drawing, Ground, smoothed
from legged_torque.viewer.session import Session
from legged_torque.viewer.snapshot import Snapshot

ROOT = "/world"  # node of all that moves such that the followed robot stays where the cameras look
SPACING = 2.0  # distance between neighbouring worlds on a plane [m]
COMMAND_COLOR, VELOCITY_COLOR, SCAN_COLOR = (10, 150, 50), (20, 90, 230), (214, 51, 108)
COLLISION_TINT, GHOST_TINT, COMPANION_TINT = (0.68, 0.24, 0.82, 0.4), (0.12, 0.67, 0.33, 0.4), (0.95, 0.55, 0.1, 1.0)
ARROW_SHAPE: dict[str, Any] = {"shaft_radius": 0.009, "head_radius": 0.024, "head_length": 0.05, "visible": False}
SCAN_SHAPE: dict[str, Any] = {"point_size": 0.009, "point_shape": "circle", "precision": "float32", "visible": False}
SCAN_HEIGHT = 0.01  # of the points above the ground, which would hide them [m]
LABEL_HEIGHT = 0.35  # of a name above the trunk's origin, for the A1 [m]
UP = np.array([0.0, 0.0, 1.0])
GHOST_SECONDS = 1.0  # for which the ghost has followed the commands
SIDE = 0.8  # distance of the companion at the start, to the right of the followed robot [m]
FARTHEST = 2.0  # distance at which the companion returns to the side of the followed robot [m]

FIELD_OF_VIEW, WIDEST = 0.75, 1.4  # vertical, and its limit where two robots are far from each other [rad]
HALF_HEIGHT = math.tan(0.5 * FIELD_OF_VIEW)  # of what is seen at a distance of 1
REACH = 0.45  # of a robot with its name around its trunk's origin, for the A1 [m]
VIEW_FROM, VIEW_TO = np.array([1.2, -1.2, 0.62]), np.array([0.0, 0.0, 0.24])  # place and target, for the A1 [m]
PHONE_FROM, PHONE_TO = np.array([1.85, -1.85, 1.0]), np.array([0.0, 0.0, -0.45])  # the same above a phone's controls
PHONE = 0.57  # ratio of width to height below which a view is a phone's, 16:9; between panels it may be just above
TWO_ROBOTS = 1.5  # factor on the camera's distance for two robots side by side
LIFTING, TOLERANCE = 0.2, 0.01  # share of its way up that a camera moves per frame; way that is ignored [m]

GROUND_FACTOR = (0.45, 0.45, 0.45, 1.0)  # on the colors of rough ground: the light is bright
PLANE: dict[str, Any] = {
    "infinite_grid": True,
    "cell_size": 0.25,  # [m]
    "section_size": 1.0,  # [m]
    "cell_color": (196, 201, 208),
    "section_color": (150, 157, 168),
    "plane_color": (226, 229, 234),
    "plane_opacity": 1.0,
    "shadow_opacity": 0.35,
    "fade_distance": 18.0,  # [m]
}

Color = tuple[float, float, float, float]  # red, green, blue and opacity, 0 to 1

SHARP_EDGE = 40.0  # smallest angle of an edge that is not smoothed [degrees]
TINTED = 0.7  # share of a tint in the color of a part
GAMMA = 2.2  # colors of batched meshes are linear
CONTACT_COLOR = (240, 140, 0)
FORCE_LENGTH = 0.002  # of the arrow of a force of 1 N [m]
MIN_FORCE = 1.0  # that is drawn [N]
FORCE_SHAPE: dict[str, Any] = {"shaft_radius": 0.006, "head_radius": 0.016, "head_length": 0.03}  # [m]
POINT_SHAPE: dict[str, Any] = {"point_size": 0.02, "point_shape": "circle", "precision": "float32"}


class Scene:
    """The robots of all worlds, their ground, light and cameras.

    On a plane, worlds are drawn side by side, though all start at the same place in the simulator. Everything moves
    such that the followed robot, the middle between two that are compared, or the rough ground below the robot stays
    where the page's camera looks. Users can turn and zoom freely.
    """

    def __init__(self, server: viser.ViserServer, session: Session, drawing: Drawing) -> None:
        """Build everything, with ``drawing`` as the session's robot and ground."""
        self._server, self._session, self._ground, self._size = server, session, drawing.ground, drawing.size
        scene, model, task, other = server.scene, drawing.model, session.task, session.companion
        self._distance = self._size * (TWO_ROBOTS if other else 1.0)
        self._places = np.zeros((task.num_envs, model.nq))  # added to the positions of a world
        if not self._ground:
            side = math.ceil(task.num_envs**0.5)
            self._places[:, :2] = SPACING * np.stack(np.divmod(np.arange(task.num_envs), side), axis=1)
        self._shift = SE3.from_translation(np.full(3, math.inf))  # how the companion's world is moved
        self._height: float | None = None  # smoothed height of the ground below the robot [m]
        self._framed: set[int] = set()  # browsers whose first view has been chosen
        camera = server.initial_camera
        camera.position, camera.look_at = self._distance * VIEW_FROM, self._size * VIEW_TO
        camera.fov = FIELD_OF_VIEW
        scene.configure_default_lights(True, cast_shadow=True)
        scene.configure_environment_map("studio", environment_intensity=0.5)
        self._root = scene.add_frame(ROOT, show_axes=False)
        if self._ground:
            scene.add_glb(f"{ROOT}/ground", ground_glb(self._ground), cast_shadow=False, receive_shadow=True)
        else:
            scene.add_grid(f"{ROOT}/ground", **PLANE)
        drawn = np.flatnonzero(np.isin(model.geom_group, DRAWN_GROUPS))
        colliding = np.flatnonzero((model.geom_contype | model.geom_conaffinity) != 0)
        kinds = {
            "robot": (drawn, None),
            "companion": (drawn, COMPANION_TINT),
            "ghost": (drawn, GHOST_TINT),
            "collision": (colliding, COLLISION_TINT),
        }
        self._robots = {name: Robots(scene, f"{ROOT}/{name}", drawing.data, *kind) for name, kind in kinds.items()}
        self._robots["robot"].draw(model.qpos0 + self._places)  # now, since making the meshes takes seconds
        self._contacts = Contacts(scene, f"{ROOT}/contacts", drawing.data, task.asset.geom_names)
        self._scan = scene.add_point_cloud(f"{ROOT}/scan", np.zeros((1, 3)), SCAN_COLOR, **SCAN_SHAPE)
        names = (session.name, other.name) if other else ()
        self._labels = [scene.add_label(f"{ROOT}/{i}", name, anchor="bottom-center") for i, name in enumerate(names)]
        self._command = scene.add_arrows(f"{ROOT}/command", np.zeros((1, 2, 3)), COMMAND_COLOR, **ARROW_SHAPE)
        self._velocity = scene.add_arrows(f"{ROOT}/velocity", np.zeros((1, 2, 3)), VELOCITY_COLOR, **ARROW_SHAPE)

    def update(self, shown: Collection[str]) -> None:
        """Draw the session's last step; ``shown`` are names of :data:`~legged_torque.viewer.web.VIEW`."""
        session, snapshot = self._session, self._session.snapshot
        if not snapshot:
            return
        world, qpos = snapshot.world, snapshot.qpos + self._places
        own, second, none = qpos[[world]], qpos[:0], qpos[:0]
        if session.companion and session.companion.snapshot:
            other = session.companion.snapshot.qpos[0]
            self._shift = side_by_side(own[0], other, self._shift)
            second = moved(other, self._shift)[None]
        ghost = commanded_pose(list(session.history) or [snapshot], session.task.dt) + self._places[world]
        trunks = np.concatenate([own, second])[:, :3]
        with self._server.atomic():
            if "follow" in shown:
                self._follow(trunks)
            self._robots["robot"].draw(qpos if "others" in shown else own)
            self._robots["companion"].draw(second)
            self._robots["ghost"].draw(ghost[None] if "ghost" in shown else none)
            self._robots["collision"].draw(own if "collision" in shown else none)
            self._contacts.draw(own, snapshot.forces if "contacts" in shown else snapshot.forces[:0])
            self._scan.visible = "scan" in shown and len(snapshot.scan) > 0
            self._scan.points = (snapshot.scan + SCAN_HEIGHT * UP).astype(np.float32)
            for label, trunk in zip(self._labels, trunks, strict=False):
                label.position = trunk + LABEL_HEIGHT * self._size * UP
            self._draw_arrow(self._command, own[0], snapshot.commands[world], HEIGHTS[0])
            self._draw_arrow(self._velocity, own[0], snapshot.velocities[world], HEIGHTS[1])
        self._move_cameras()
        if "follow" in shown and len(second):
            self._frame(trunks - trunks.mean(axis=0) * [1.0, 1.0, 0.0])

    def _draw_arrow(self, arrow: viser.ArrowsHandle, qpos: np.ndarray, velocity: np.ndarray, height: float) -> None:
        """Draw a velocity in the trunk's frame, which begins with v_x and v_y [m/s], above a robot."""
        start = qpos[:3] + height * self._size * UP
        end = start + ARROW_LENGTH * SO3(qpos[3:7]).as_matrix()[:, :2] @ velocity[:2]
        arrow.points, arrow.visible = np.stack([start, end])[None], bool(np.hypot(*velocity[:2]) > MIN_SPEED)

    def _follow(self, trunks: np.ndarray) -> None:
        """Move the world such that the middle of some trunks is at the origin. Shape: (robots, 3)."""
        place = np.array([*trunks[:, :2].mean(axis=0), 0.0])
        if self._ground:
            self._height = place[2] = smoothed(self._height, float(self._ground.height(trunks[0])))
        self._root.position = -place

    def _move_cameras(self) -> None:
        """Let new browsers on phones see the robot above the controls, and raise cameras that do not see their target.

        The ground may be between them.
        """
        place = -np.array(self._root.position)
        for number, client in self._server.get_clients().items():
            position, target = np.array(client.camera.position), np.array(client.camera.look_at)
            if not target.any():  # this is not the page's camera yet
                continue
            if number not in self._framed and client.camera.aspect < PHONE:
                place_camera(client, self._distance * PHONE_FROM, self._distance * PHONE_TO)
            elif self._ground:
                lowest = self._ground.lowest_view(target + place, position + place) - place[2]
                if position[2] < lowest - TOLERANCE:
                    position[2] += LIFTING * (lowest - position[2])
                    place_camera(client, position, target)
            self._framed.add(number)

    def _frame(self, trunks: np.ndarray) -> None:
        """Let all cameras see two trunks around the origin, by their fields of view: users choose place and direction.

        Shape: (2, 3) [m].
        """
        cameras = [client.camera for number, client in self._server.get_clients().items() if number in self._framed]
        for camera in cameras:
            is_phone = camera.aspect < PHONE
            first = self._distance * np.linalg.norm(PHONE_FROM if is_phone else VIEW_FROM)
            place = np.array(camera.position) * first / np.linalg.norm(camera.position)
            wanted = field_of_view(place, np.array(camera.look_at), camera.aspect, trunks, REACH * self._size)
            change = np.clip(wanted, FIELD_OF_VIEW, WIDEST) - camera.fov
            if abs(change) > TOLERANCE:
                camera.fov += LIFTING * change
                if is_phone:  # above the controls
                    camera.look_at = self._distance * PHONE_TO * math.tan(0.5 * camera.fov) / HALF_HEIGHT


class Robots:
    """Drawings of equal robots. Browsers get their meshes when the first robot is drawn."""

    def __init__(
        self, scene: viser.SceneApi, name: str, data: mujoco.MjData, geoms: Iterable[int], tint: Color | None = None
    ) -> None:
        """Prepare drawings below the node ``name``, of those geoms that belong to the robot; ``data`` is changed."""
        self._scene, self._name, self._data, self._tint, model = scene, name, data, tint, data.model
        self._geoms: dict[tuple[int, Color], list[int]] = {}  # by body and color
        for geom in geoms:
            material = model.geom_matid[geom]
            rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
            if body := int(model.geom_bodyid[geom]):
                self._geoms.setdefault((body, tuple(rgba.tolist())), []).append(geom)
        self._handles: list[viser.BatchedMeshHandle] = []

    def draw(self, qpos: np.ndarray) -> None:
        """Draw robots at some positions, or none. Shape: (robots, nq)."""
        if len(qpos) and not self._handles:
            self._handles = [self._add(*part, geoms) for part, geoms in self._geoms.items()]
        positions, quats = body_poses(self._data, qpos)
        for (body, _), handle in zip(self._geoms, self._handles, strict=False):
            handle.visible = len(qpos) > 0
            if handle.visible:
                handle.batched_positions, handle.batched_wxyzs = positions[:, body], quats[:, body]

    def _add(self, body: int, color: Color, geoms: Sequence[int]) -> viser.BatchedMeshHandle:
        """Add geoms of a body that have the same color."""
        model, rgb, opacity = self._data.model, np.array(color[:3]) ** GAMMA, color[3]
        if self._tint:
            rgb += TINTED * (np.array(self._tint[:3]) ** GAMMA - rgb)
            opacity = self._tint[3]
        mesh = trimesh.util.concatenate([geom_mesh(model, geom) for geom in geoms])
        return self._scene.add_batched_meshes_simple(
            f"{self._name}/{model.body(body).name}/{geoms[0]}",
            mesh.vertices,
            mesh.faces,
            batched_wxyzs=np.array([[1.0, 0.0, 0.0, 0.0]]),
            batched_positions=np.zeros((1, 3)),
            batched_colors=rgb,
            opacity=None if opacity == 1.0 else opacity,
            lod="off",
            cast_shadow=opacity == 1.0,
        )


class Contacts:
    """Points and arrows of the ground's forces on the collision geoms of one robot."""

    def __init__(self, scene: viser.SceneApi, name: str, data: mujoco.MjData, geoms: Sequence[str]) -> None:
        """Prepare drawings below the node ``name``; ``geoms`` are the names of the collision geoms."""
        self._data, model = data, data.model
        self._geoms = [(int(model.geom(geom).bodyid[0]), geom_mesh(model, model.geom(geom).id)) for geom in geoms]
        nowhere = np.zeros((1, 2, 3))
        self._arrows = scene.add_arrows(f"{name}/forces", nowhere, CONTACT_COLOR, **FORCE_SHAPE, visible=False)
        points = (f"{name}/points", nowhere[0, :1], CONTACT_COLOR)
        self._points = scene.add_point_cloud(*points, **POINT_SHAPE, visible=False)

    def draw(self, qpos: np.ndarray, forces: np.ndarray) -> None:
        """Draw forces in the world [N] at the lowest points of geoms, or none. Shapes: (1, nq), (geoms or 0, 3)."""
        positions, quats = body_poses(self._data, qpos)
        touching = np.flatnonzero(np.linalg.norm(forces, axis=1) > MIN_FORCE).tolist()
        self._arrows.visible = self._points.visible = bool(touching)
        if touching:
            points = []
            for body, mesh in (self._geoms[geom] for geom in touching):
                corners = mesh.vertices @ SO3(quats[0, body]).as_matrix().T
                points.append(corners[corners[:, 2].argmin()] + positions[0, body])
            self._points.points = np.array(points, np.float32)
            self._arrows.points = np.stack([points, points + FORCE_LENGTH * forces[touching]], axis=1)


def place_camera(client: viser.ClientHandle, position: np.ndarray, target: np.ndarray) -> None:
    """Move a browser's camera."""
    with client.atomic():
        client.camera.position = position  # moves the target, too
        client.camera.look_at = target


def field_of_view(place: np.ndarray, target: np.ndarray, aspect: float, middles: np.ndarray, radius: float) -> float:
    """Return the vertical angle in which a camera sees spheres [rad]; ``aspect`` is the picture's width by height.

    Shapes: (3,), (3,), (spheres, 3) [m].
    """
    ahead = (target - place) / np.linalg.norm(target - place)
    right = np.cross(ahead, UP) / max(np.linalg.norm(np.cross(ahead, UP)), 1e-6)
    depth, x, y = np.stack([ahead, right, np.cross(right, ahead)]) @ (middles - place).T
    edges = np.maximum((abs(x) + radius) / aspect, abs(y) + radius) / np.maximum(depth, radius)
    return 2.0 * math.atan(edges.max())


def commanded_pose(past: Sequence[Snapshot], dt: float) -> np.ndarray:
    """Return where the followed robot would be if it had followed its commands for a second. Shape: (nq,).

    The pose is upright, with the present height and joints. A younger episode counts from its start. ``past`` are the
    last steps, the present one included, of ``dt`` [s] each.
    """
    now = past[-1]
    steps = min(round(GHOST_SECONDS / dt), len(past) - 1, now.age)
    pose, start = now.qpos[now.world].copy(), on_ground(past[-1 - steps].qpos[now.world])
    way, angle = 0j, 0.0
    for snapshot in past[len(past) - steps :]:
        v_x, v_y, yaw_rate = snapshot.commands[now.world]
        way += dt * complex(v_x, v_y) * cmath.rect(1.0, angle + 0.5 * yaw_rate * dt)
        angle += yaw_rate * dt
    pose[:2] = start.apply(np.array([way.real, way.imag, 0.0]))[:2]
    pose[3:7] = (start.rotation() @ SO3.from_z_radians(angle)).wxyz
    return pose


def side_by_side(own: np.ndarray, other: np.ndarray, before: SE3) -> SE3:
    """Return how to move a companion's world so that it walks next to a robot, given their positions. Shapes: (nq,).

    That is as ``before`` until they are far apart; then the companion starts again at the robot's right.
    """
    if np.linalg.norm(before.apply(other[:3])[:2] - own[:2]) < FARTHEST:
        return before
    return on_ground(own) @ SE3.from_translation(np.array([0.0, -SIDE, 0.0])) @ on_ground(other).inverse()


def moved(qpos: np.ndarray, by: SE3) -> np.ndarray:
    """Return the positions of a robot in a world that is moved. Shape: (nq,)."""
    return np.array([*by.apply(qpos[:3]), *(by.rotation() @ SO3(qpos[3:7])).wxyz, *qpos[7:]])


def on_ground(qpos: np.ndarray) -> SE3:
    """Return the frame below a robot at height 0 that points where the robot is heading. Shape: (nq,)."""
    x_ahead, y_ahead, _ = heading(qpos[3:7])
    turn = SO3.from_z_radians(math.atan2(y_ahead, x_ahead))
    return SE3.from_rotation_and_translation(turn, np.array([*qpos[:2], 0.0]))


def ground_glb(ground: Ground) -> bytes:
    """Return a binary glTF. It has no normals, so that browsers draw flat triangles with sharp edges."""
    picture = Image.fromarray(ground.picture()[::-1])
    look = {"baseColorFactor": GROUND_FACTOR, "metallicFactor": 0.0, "roughnessFactor": 0.95}
    material = PBRMaterial(baseColorTexture=picture, **look)
    visual = TextureVisuals(ground.uv, material=material)
    mesh = trimesh.Trimesh(ground.vertices, ground.faces, visual=visual, process=False)
    return trimesh.exchange.gltf.export_glb(trimesh.Scene(mesh), include_normals=False)


def body_poses(data: mujoco.MjData, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the poses of all bodies. Shapes: (robots, nq) to (robots, nbody, 3) [m] and (robots, nbody, 4)."""
    positions, quats = (np.zeros((len(qpos), data.model.nbody, size), np.float32) for size in (3, 4))
    for robot, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(data.model, data)
        positions[robot], quats[robot] = data.xpos, data.xquat
    return positions, quats


def geom_mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh:
    """Return a geom in its body's frame."""
    kinds, creation = mujoco.mjtGeom, trimesh.creation
    kind, size = kinds(model.geom_type[geom]), model.geom_size[geom]
    if kind == kinds.mjGEOM_MESH:
        part = model.mesh(model.geom_dataid[geom])
        vertices = model.mesh_vert[part.vertadr[0] :][: part.vertnum[0]]
        faces = model.mesh_face[part.faceadr[0] :][: part.facenum[0]]
        mesh = trimesh.Trimesh(vertices, faces)
    else:
        makers = {
            kinds.mjGEOM_SPHERE: lambda: creation.icosphere(subdivisions=3, radius=size[0]),
            kinds.mjGEOM_CAPSULE: lambda: creation.capsule(height=2.0 * size[1], radius=size[0], count=(16, 16)),
            kinds.mjGEOM_CYLINDER: lambda: creation.cylinder(radius=size[0], height=2.0 * size[1], sections=40),
            kinds.mjGEOM_ELLIPSOID: lambda: creation.icosphere(subdivisions=3).apply_scale(size),
        }
        mesh = makers.get(kind, lambda: creation.box(extents=2.0 * size))()
    mesh = trimesh.graph.smooth_shade(mesh, angle=np.radians(SHARP_EDGE))
    pose = np.eye(4)
    pose[:3, :3] = SO3(model.geom_quat[geom]).as_matrix()
    pose[:3, 3] = model.geom_pos[geom]
    return mesh.apply_transform(pose)
