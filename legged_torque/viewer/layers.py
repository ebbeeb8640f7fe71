"""What can be drawn of the followed robot besides itself: contacts, collision geoms, and where its commands lead."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import trimesh
import viser
from viser import transforms

from legged_torque.utils.mjcf import DRAWN_GROUPS
from legged_torque.viewer.lane import heading_of
from legged_torque.viewer.meshes import geom_mesh
from legged_torque.viewer.reading import Reading

Color = tuple[int, int, int]

FORCE_COLOR, COLLISION_COLOR, GHOST_COLOR = (240, 140, 0), (174, 62, 201), (31, 170, 85)
FORCE_LENGTH = 0.002  # length of the arrow of a force of 1 N [m]
SMALLEST_FORCE = 1.0  # that is drawn [N]
OPACITY = 0.35  # of what is translucent
GHOST_STEPS = 50  # control steps for which a ghost has followed the commands: 1 s


class Layers:
    """Contacts, collision geoms and ghost of one robot, each shown or not."""

    def __init__(self, server: viser.ViserServer, model: mujoco.MjModel, geoms: Sequence[str]) -> None:
        """Build everything; ``geoms`` are the names of those whose forces are known, in the order of the readings."""
        self.shows_contacts, self.shows_collision, self.shows_ghost = True, False, False
        self._geoms = [(int(model.geom(name).bodyid[0]), geom_mesh(model, model.geom(name).id)) for name in geoms]
        touching = [geom for geom in range(model.ngeom) if model.geom_contype[geom] or model.geom_conaffinity[geom]]
        self._collision = Bodies(server, model, "collision", touching, COLLISION_COLOR)
        drawn = [geom for geom in range(model.ngeom) if model.geom_group[geom] in DRAWN_GROUPS]
        self._ghost = Bodies(server, model, "ghost", drawn, GHOST_COLOR)
        sizes = {"shaft_radius": 0.006, "head_radius": 0.016, "head_length": 0.03}
        self._forces = server.scene.add_arrows("/forces", np.zeros((1, 2, 3)), FORCE_COLOR, **sizes, visible=False)
        shape = {"point_size": 0.02, "point_shape": "circle", "precision": "float32"}
        self._points = server.scene.add_point_cloud("/contacts", np.zeros((1, 3)), FORCE_COLOR, **shape, visible=False)

    def update(self, reading: Reading, positions: np.ndarray, quats: np.ndarray, is_current: bool) -> None:
        """Draw what is shown.

        Args:
            reading: The last step.
            positions: Of the bodies of the followed robot, then of its ghost, on the page [m]. Shape: (2, nbody, 3).
            quats: Their orientations. Shape: (2, nbody, 4).
            is_current: Whether the reading is one of the followed robot.
        """
        self._collision.draw(positions[0], quats[0], self.shows_collision)
        self._ghost.draw(positions[1], quats[1], self.shows_ghost and is_current)
        touching = np.flatnonzero(np.linalg.norm(reading.forces, axis=1) > SMALLEST_FORCE).tolist()
        self._forces.visible = self._points.visible = self.shows_contacts and is_current and bool(touching)
        if self._forces.visible:
            points = np.stack([self._lowest_point(geom, positions[0], quats[0]) for geom in touching])
            self._forces.points = np.stack([points, points + FORCE_LENGTH * reading.forces[touching]], axis=1)
            self._points.points = points.astype(np.float32)

    def _lowest_point(self, geom: int, positions: np.ndarray, quats: np.ndarray) -> np.ndarray:
        """Return the lowest point of a collision geom [m]. Shape: (3,)."""
        body, mesh = self._geoms[geom]
        corners = mesh.vertices @ transforms.SO3(quats[body]).as_matrix().T
        return corners[corners[:, 2].argmin()] + positions[body]


class Bodies:
    """A translucent drawing of some geoms of a robot, which browsers get when it is first shown."""

    def __init__(
        self, server: viser.ViserServer, model: mujoco.MjModel, name: str, geoms: Sequence[int], color: Color
    ) -> None:
        """Prepare to draw those of the geoms that belong to the robot."""
        self._scene, self._model, self._name, self._color = server.scene, model, name, color
        self._geoms = [geom for geom in geoms if model.geom_bodyid[geom]]
        self._handles: dict[int, viser.BatchedMeshHandle] = {}

    def draw(self, positions: np.ndarray, quats: np.ndarray, is_shown: bool) -> None:
        """Draw the bodies at some poses, or hide them. Shapes: (nbody, 3), (nbody, 4)."""
        if is_shown and not self._handles:
            self._add()
        for body, handle in self._handles.items():
            handle.visible = is_shown
            if is_shown:
                handle.batched_positions, handle.batched_wxyzs = positions[[body]], quats[[body]]

    def _add(self) -> None:
        """Add a mesh per body."""
        meshes: dict[int, list[trimesh.Trimesh]] = {}
        for geom in self._geoms:
            meshes.setdefault(int(self._model.geom_bodyid[geom]), []).append(geom_mesh(self._model, geom))
        look = {"batched_colors": self._color, "opacity": OPACITY, "cast_shadow": False, "lod": "off"}
        nowhere = (np.array([[1.0, 0.0, 0.0, 0.0]]), np.zeros((1, 3)))
        for body, parts in meshes.items():
            mesh, path = trimesh.util.concatenate(parts), f"/{self._name}/{self._model.body(body).name}"
            handle = self._scene.add_batched_meshes_simple(path, mesh.vertices, mesh.faces, *nowhere, **look)
            self._handles[body] = handle


def commanded_pose(past: Sequence[Reading], dt: float) -> np.ndarray:
    """Return where the followed robot would be if it had followed its commands for a second, as ``sim.qpos``.

    It is upright, and has the present height and joints; in the first second of an episode, it follows from its start.
    ``past`` are the last steps, the present one included, which are ``dt`` [s] long.
    """
    now = past[-1]
    steps = min(GHOST_STEPS, len(past) - 1, int(now.age[0]))
    pose, begin = now.qpos[now.world].copy(), past[-1 - steps].qpos[now.world]
    heading, place = heading_of(begin), begin[:2].astype(float)
    for reading in past[len(past) - steps :]:
        v_x, v_y, rate = reading.commands[now.world]
        cos, sin = np.cos(heading + 0.5 * rate * dt), np.sin(heading + 0.5 * rate * dt)
        place += dt * np.array([cos * v_x - sin * v_y, sin * v_x + cos * v_y])
        heading += rate * dt
    pose[:2], pose[3:7] = place, (np.cos(0.5 * heading), 0.0, 0.0, np.sin(0.5 * heading))
    return pose
