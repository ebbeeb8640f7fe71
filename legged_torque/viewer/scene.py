"""The 3D scene of the page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import trimesh
import viser
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial
from viser import transforms

from legged_torque.utils.mjcf import DRAWN_GROUPS
from legged_torque.viewer.ground import Ground
from legged_torque.viewer.mujoco_scene import (
    ARROW_LENGTH,
    COMMAND_HEIGHT,
    MIN_SPEED,
    VELOCITY_HEIGHT,
    size_of,
    smoothed,
)
from legged_torque.viewer.poses import SideBySide
from legged_torque.viewer.robots import Contacts, Robots
from legged_torque.viewer.snapshot import Snapshot

ROOT = "/world"  # node of all that moves such that the followed robot stays where the cameras look
SPACING = 2.0  # distance between neighbouring worlds on a plane [m]
COMMAND_COLOR, VELOCITY_COLOR, SCAN_COLOR = (10, 150, 50), (20, 90, 230), (214, 51, 108)
COLLISION_TINT, GHOST_TINT, COMPANION_TINT = (0.68, 0.24, 0.82, 0.4), (0.12, 0.67, 0.33, 0.4), (0.95, 0.55, 0.1, 1.0)
ARROW_SHAPE: dict[str, Any] = {"shaft_radius": 0.009, "head_radius": 0.024, "head_length": 0.05}  # [m]
SCAN_SHAPE: dict[str, Any] = {"point_size": 0.009, "point_shape": "circle", "precision": "float32"}
SCAN_HEIGHT = 0.01  # of the points above the ground, which would hide them [m]
LABEL_HEIGHT = 0.35  # of a name above the trunk's origin, for the A1 [m]
UP = np.array([0.0, 0.0, 1.0])

FIELD_OF_VIEW = 0.75  # vertical [rad]
VIEW_FROM, VIEW_TO = np.array([1.2, -1.2, 0.62]), np.array([0.0, 0.0, 0.24])  # place and target, for the A1 [m]
PHONE_FROM, PHONE_TO = np.array([1.85, -1.85, 1.0]), np.array([0.0, 0.0, -0.4])  # the same above a phone's controls
PHONE = 0.6  # ratio of width to height below which a view is a phone's
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


@dataclass
class View:
    """What is drawn; changes take effect with the next frame."""

    follow: bool = True  # keep the followed robot in view
    others: bool = True  # the robots of the other worlds
    contacts: bool = True  # points and forces
    collision: bool = False  # the collision geoms
    ghost: bool = False  # where the commands of the last second lead
    scan: bool = True  # the height scan, on rough ground


class Scene:
    """The robots of all worlds, their ground, light and cameras.

    On a plane, worlds are drawn side by side, though all start at the same place in the simulator. Everything moves
    such that the followed robot, the middle between two that are compared, or the rough ground below the robot stays
    where the page's camera looks. Users can turn and zoom freely.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        model: mujoco.MjModel,
        num_envs: int,
        geoms: Sequence[str],
        ground: Ground | None,
        names: Sequence[str] = (),
    ) -> None:
        """Build everything; a ground of None is a plane.

        The model's joints and ``geoms``, the names of its collision geoms, are in the order of the snapshots. ``names``
        are those of the followed robot and its companion, if there is one.
        """
        self.view = View()
        self._server, self._ground = server, ground
        self._size = size_of(model)
        self._distance = self._size * (TWO_ROBOTS if names else 1.0)
        self._places = np.zeros((num_envs, model.nq))  # added to the positions of a world
        if not ground:
            self._places[:, :2] = SPACING * np.stack(np.divmod(np.arange(num_envs), math.ceil(num_envs**0.5)), axis=1)
        self._side_by_side = SideBySide()
        self._height: float | None = None  # smoothed height of the ground below the robot [m]
        self._framed: set[int] = set()  # browsers whose first view has been chosen
        self._add_surroundings()
        scene, data, drawn = server.scene, mujoco.MjData(model), np.isin(model.geom_group, DRAWN_GROUPS)
        colliding = (model.geom_contype | model.geom_conaffinity) != 0
        self._robots = Robots(scene, f"{ROOT}/robot", data, np.flatnonzero(drawn))
        self._robots.draw(model.qpos0 + self._places)  # now, since making the meshes takes seconds
        self._companion = Robots(scene, f"{ROOT}/companion", data, np.flatnonzero(drawn), COMPANION_TINT)
        self._ghost = Robots(scene, f"{ROOT}/ghost", data, np.flatnonzero(drawn), GHOST_TINT)
        self._collision = Robots(scene, f"{ROOT}/collision", data, np.flatnonzero(colliding), COLLISION_TINT)
        self._contacts = Contacts(scene, f"{ROOT}/contacts", data, geoms)
        self._scan = scene.add_point_cloud(f"{ROOT}/scan", np.zeros((1, 3)), SCAN_COLOR, **SCAN_SHAPE)
        self._labels = [scene.add_label(f"{ROOT}/name{i}", name) for i, name in enumerate(names)]
        self._command = scene.add_arrows(f"{ROOT}/command", np.zeros((1, 2, 3)), COMMAND_COLOR, **ARROW_SHAPE)
        self._velocity = scene.add_arrows(f"{ROOT}/velocity", np.zeros((1, 2, 3)), VELOCITY_COLOR, **ARROW_SHAPE)

    def _add_surroundings(self) -> None:
        """Add ground and light, and place the camera."""
        scene, camera = self._server.scene, self._server.initial_camera
        self._root = scene.add_frame(ROOT, show_axes=False)
        if self._ground:
            scene.add_glb(f"{ROOT}/ground", ground_glb(self._ground), cast_shadow=False, receive_shadow=True)
        else:
            scene.add_grid(f"{ROOT}/ground", **PLANE)
        scene.configure_default_lights(True, cast_shadow=True)
        scene.configure_environment_map("studio", environment_intensity=0.5)
        camera.position, camera.look_at = self._distance * VIEW_FROM, self._size * VIEW_TO
        camera.fov = FIELD_OF_VIEW

    def update(self, snapshot: Snapshot, world: int, ghost: np.ndarray, companion: np.ndarray | None) -> None:
        """Draw a snapshot with a world to follow, its ghost, and its companion in its own simulation. Shapes: (nq,)."""
        view, qpos, is_current = self.view, snapshot.qpos + self._places, world == snapshot.world
        own, second, none = qpos[[world]], qpos[:0], qpos[:0]
        if companion is not None:
            second = self._side_by_side.place(own[0], companion)[None]
        trunks = np.concatenate([own, second])[:, :3]
        with self._server.atomic():
            if view.follow:
                self._follow(trunks)
            self._robots.draw(qpos if view.others else own)
            self._companion.draw(second)
            self._collision.draw(own if view.collision else none)
            self._ghost.draw((ghost + self._places[world])[None] if view.ghost and is_current else none)
            self._contacts.draw(own, snapshot.forces if view.contacts and is_current else snapshot.forces[:0])
            self._scan.visible = view.scan and is_current and len(snapshot.scan) > 0
            self._scan.points = (snapshot.scan + SCAN_HEIGHT * UP).astype(np.float32)
            for label, trunk in zip(self._labels, trunks, strict=False):
                label.position = trunk + LABEL_HEIGHT * self._size * UP
            self._draw_arrow(self._command, own[0], snapshot.commands[world], COMMAND_HEIGHT)
            self._draw_arrow(self._velocity, own[0], snapshot.velocities[world], VELOCITY_HEIGHT)
        self._frame_phones()

    def _draw_arrow(self, arrow: viser.ArrowsHandle, qpos: np.ndarray, velocity: np.ndarray, height: float) -> None:
        """Draw a velocity in the trunk's frame, which begins with v_x and v_y [m/s], above a robot."""
        start = qpos[:3] + height * self._size * UP
        end = start + ARROW_LENGTH * transforms.SO3(qpos[3:7]).as_matrix()[:, :2] @ velocity[:2]
        arrow.points, arrow.visible = np.stack([start, end])[None], bool(np.hypot(*velocity[:2]) > MIN_SPEED)

    def _follow(self, trunks: np.ndarray) -> None:
        """Move the world such that the middle of some trunks is at the origin. Shape: (robots, 3)."""
        place = np.array([*trunks[:, :2].mean(axis=0), 0.0])
        if self._ground:
            self._height = place[2] = smoothed(self._height, float(self._ground.height(trunks[0])))
        self._root.position = -place
        if self._ground:
            self._lift_cameras(self._ground, place)

    def _lift_cameras(self, ground: Ground, place: np.ndarray) -> None:
        """Raise cameras that do not see their target over the ground; ``place`` is at the origin. Shape: (3,)."""
        for client in self._server.get_clients().values():
            position, target = np.array(client.camera.position), np.array(client.camera.look_at)
            lowest = ground.lowest_view(target + place, position + place) - place[2]
            if target.any() and position[2] < lowest - TOLERANCE:  # a target of 0 is not the page's yet
                position[2] += LIFTING * (lowest - position[2])
                self._place(client, position, target)

    def _frame_phones(self) -> None:
        """Let new browsers on phones see the robot above the controls."""
        for number, client in self._server.get_clients().items():
            if number not in self._framed and np.any(client.camera.look_at):
                self._framed.add(number)
                if client.camera.aspect < PHONE:
                    self._place(client, self._distance * PHONE_FROM, self._distance * PHONE_TO)

    @staticmethod
    def _place(client: viser.ClientHandle, position: np.ndarray, target: np.ndarray) -> None:
        """Move a browser's camera."""
        with client.atomic():
            client.camera.position = position  # moves the target, too
            client.camera.look_at = target


def ground_glb(ground: Ground) -> bytes:
    """Return a binary glTF. It has no normals, so that browsers draw flat triangles with sharp edges."""
    picture = Image.fromarray(ground.picture()[::-1])
    material = PBRMaterial(
        baseColorTexture=picture, baseColorFactor=GROUND_FACTOR, metallicFactor=0.0, roughnessFactor=0.95
    )
    visual = TextureVisuals(ground.uv, material=material)
    mesh = trimesh.Trimesh(ground.vertices, ground.faces, visual=visual, process=False)
    return trimesh.exchange.gltf.export_glb(trimesh.Scene(mesh), include_normals=False)
