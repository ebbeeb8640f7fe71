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

FORCE_COLOR, COLLISION_COLOR, GHOST_COLOR = (240, 140, 0), (174, 62, 201), (31, 170, 85)
FORCE_LENGTH = 0.002  # length of the arrow of a force of 1 N [m]
SMALLEST_FORCE = 1.0  # that is drawn [N]
GHOST_STEPS = 50  # control steps for which a ghost has followed the commands: 1 s


class Layers:
    """Contacts, collision geoms and ghost of one robot, each shown or not."""

    def __init__(self, server: viser.ViserServer, model: mujoco.MjModel, geoms: Sequence[str]) -> None:
        """Build everything; ``geoms`` are the names of those whose forces are known, in the order of the readings."""
        self.shows_contacts, self.shows_collision, self.shows_ghost = True, False, False
        self._scene, self._model = server.scene, model
        self._geoms = [(int(model.geom(name).bodyid[0]), geom_mesh(model, model.geom(name).id)) for name in geoms]
        touching = [geom for geom in range(model.ngeom) if model.geom_contype[geom] or model.geom_conaffinity[geom]]
        self._collision = self._add_bodies("collision", touching, COLLISION_COLOR, 0.5)
        drawn = [geom for geom in range(model.ngeom) if model.geom_group[geom] in DRAWN_GROUPS]
        self._ghost = self._add_bodies("ghost", drawn, GHOST_COLOR, 0.25)
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
        for handles, robot, is_shown in (
            (self._collision, 0, self.shows_collision),
            (self._ghost, 1, self.shows_ghost and is_current),
        ):
            for body, handle in handles.items():
                handle.visible = is_shown
                if is_shown:
                    handle.batched_positions, handle.batched_wxyzs = positions[robot, [body]], quats[robot, [body]]
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

    def _add_bodies(
        self, name: str, geoms: Sequence[int], color: tuple[int, int, int], opacity: float
    ) -> dict[int, viser.BatchedMeshHandle]:
        """Add the bodies that some geoms belong to, translucent and hidden, and return them by number."""
        meshes: dict[int, list[trimesh.Trimesh]] = {}
        for geom in geoms:
            if self._model.geom_bodyid[geom]:
                meshes.setdefault(int(self._model.geom_bodyid[geom]), []).append(geom_mesh(self._model, geom))
        handles = {}
        for body, parts in meshes.items():
            mesh, nowhere = trimesh.util.concatenate(parts), (np.array([[1.0, 0.0, 0.0, 0.0]]), np.zeros((1, 3)))
            look = {"batched_colors": color, "opacity": opacity, "cast_shadow": False, "visible": False}
            path = f"/{name}/{self._model.body(body).name}"
            handles[body] = self._scene.add_batched_meshes_simple(path, mesh.vertices, mesh.faces, *nowhere, **look)
        return handles


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
