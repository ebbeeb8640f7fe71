"""Drawing robots on a viser page."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import viser
from viser import transforms

from legged_torque.viewer.framing import size_of
from legged_torque.viewer.ground import Ground, Smooth
from legged_torque.viewer.lane import Lane
from legged_torque.viewer.layers import Layers
from legged_torque.viewer.meshes import body_glb, ground_glb
from legged_torque.viewer.reading import Reading

COMMAND_COLOR, VELOCITY_COLOR, SCAN_COLOR = (10, 150, 50), (20, 90, 230), (214, 51, 108)
PHONE = 0.6  # width by height of a view below which it is that of a phone
SPACING = 2.0  # distance between neighbouring worlds [m]
TWO_ROBOTS = 1.5  # how much further away the camera is from two robots side by side than from one
LIFTING = 0.2  # share of the way to where it sees the robot by which a camera moves up in a frame
ARROW_LENGTH = 0.5  # length of the arrow of a velocity of 1 m/s [m]


class Scene:
    """The robots of all worlds, their ground and light.

    On a plane, worlds are drawn side by side, though all start at the same place in the simulator. Everything is moved
    such that the followed robot, the middle of two that are compared, or the rough ground below it stays where the
    page's camera looks; so users can turn and zoom freely. Rough ground does not get between camera and robot.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        robot: mujoco.MjModel,
        num_envs: int,
        geoms: Sequence[str],
        ground: Ground | None = None,
    ) -> None:
        """Build everything.

        Args:
            server: Of the page.
            robot: With visual geoms, and joints in the order of the states.
            num_envs: Number of worlds.
            geoms: Names of the collision geoms, in the order of the readings.
            ground: None for a plane.
        """
        self._server, self.ground = server, ground
        self._model = robot
        self._data = mujoco.MjData(self._model)
        self._size = self._distance = size_of(robot)  # in those of an A1, as are distances of cameras
        self.is_following, self.shows_others = True, True  # the camera follows; the other worlds are drawn
        self.shows_scan = True  # where the height scan of the followed robot meets the ground
        self._scan: viser.PointCloudHandle | None = None
        self._places = np.zeros((num_envs, 3)) if ground else places(num_envs)
        self._offset, self._height = np.zeros(3), Smooth()
        self._floor = self._add_rough_ground(ground) if ground else self._add_plane()
        self._add_surroundings()
        self._bodies = {}
        for body in range(1, self._model.nbody):
            glb = body_glb(self._model, body)
            if glb is not None:
                quats, positions = np.tile([1.0, 0.0, 0.0, 0.0], (num_envs, 1)), np.zeros((num_envs, 3))
                name = f"/{self._model.body(body).name}"
                self._bodies[body] = server.scene.add_batched_glb(name, glb, quats, positions, lod="off")
        colors = {"/command": COMMAND_COLOR, "/velocity": VELOCITY_COLOR}
        sizes = {"shaft_radius": 0.009, "head_radius": 0.024, "head_length": 0.05}
        nowhere = np.zeros((1, 2, 3))
        self._arrows = [server.scene.add_arrows(name, nowhere, color, **sizes) for name, color in colors.items()]
        self.layers = Layers(server, self._model, geoms)
        self._lane = Lane()
        self._labels: list[viser.LabelHandle] = []
        self._seen: set[int] = set()  # browsers that have taken the page's camera

    def name_robots(self, first: str, second: str) -> None:
        """Write names above the followed robot and the one beside it, and let new browsers see both."""
        self._distance *= TWO_ROBOTS
        self._server.initial_camera.position = TWO_ROBOTS * np.array(self._server.initial_camera.position)
        self._labels = [self._server.scene.add_label(f"/name/{i}", name) for i, name in enumerate((first, second))]

    def update(self, reading: Reading, world: int, ghost: np.ndarray, beside: np.ndarray | None = None) -> None:
        """Draw a state, and all that is shown of a world to follow.

        Args:
            reading: The state.
            world: The followed one.
            ghost: Positions of its ghost, like a row of the reading's.
            beside: Likewise of the robot beside it, in a simulation of its own; None if there is none.
        """
        num_envs, lane = len(reading.qpos), []
        if beside is not None:
            lane = [self._lane.place(reading.qpos[world], beside)]
        rows = np.vstack([reading.qpos, *lane, ghost])
        positions, quats = self._poses(rows, [*range(num_envs)] + [world] * (len(lane) + 1))
        shown = [*(range(num_envs) if self.shows_others else [world]), *range(num_envs, num_envs + len(lane))]
        if self.is_following:
            followed = [world, *range(num_envs, num_envs + len(lane))]
            self._offset[:2] = -positions[followed, 1, :2].mean(axis=0)
            if self.ground:
                self._offset[2] = -self._height.follow(float(self.ground.height(positions[world, 1])))
                self._lift_cameras()
        self._frame_phones()
        positions += self._offset
        is_current = world == reading.world
        trunk, rotation = positions[world, 1], transforms.SO3(quats[world, 1]).as_matrix()
        with self._server.atomic():
            self._floor.position = self._offset
            for body, handle in self._bodies.items():
                handle.batched_positions = positions[shown, body]
                handle.batched_wxyzs = quats[shown, body]
            if self._scan:
                self._scan.visible = self.shows_scan and is_current
                self._scan.points = (reading.scan + self._offset + [0.0, 0.0, 0.01]).astype(np.float32)
            self.layers.update(reading, positions[[world, -1]], quats[[world, -1]], is_current)
            for label, robot in zip(self._labels, (world, num_envs), strict=False):
                label.position = positions[robot, 1] + [0.0, 0.0, 0.35 * self._size]
            velocities = (reading.commands[world], reading.velocities[world])
            for handle, vector, height in zip(self._arrows, velocities, (0.22, 0.17), strict=True):
                start = trunk + np.array([0.0, 0.0, height * self._size])
                end = start + ARROW_LENGTH * rotation @ [vector[0], vector[1], 0.0]
                handle.points = np.stack([start, end])[None].astype(np.float32)
                handle.visible = bool(np.hypot(vector[0], vector[1]) > 0.05)

    def _poses(self, qpos: np.ndarray, worlds: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and quaternions of all bodies of robots that are drawn where their worlds are.

        Shapes: (robots, nq) to (robots, nbody, 3) and (robots, nbody, 4).
        """
        positions = np.zeros((len(qpos), self._model.nbody, 3), np.float32)
        quats = np.zeros((len(qpos), self._model.nbody, 4), np.float32)
        for i, (world, row) in enumerate(zip(worlds, qpos, strict=True)):
            self._data.qpos[:] = row
            mujoco.mj_kinematics(self._model, self._data)
            positions[i] = self._data.xpos + self._places[world]
            quats[i] = self._data.xquat
        return positions, quats

    def _frame_phones(self) -> None:
        """Let new browsers on phones see the robot above the sheet with the controls."""
        for number, client in self._server.get_clients().items():
            camera = client.camera
            if number in self._seen or not np.any(camera.look_at):
                continue
            self._seen.add(number)
            if camera.aspect < PHONE:
                with client.atomic():
                    camera.position = self._distance * np.array([1.85, -1.85, 1.0])  # moves what it looks at, too
                    camera.look_at = (0.0, 0.0, -0.4 * self._distance)

    def _lift_cameras(self) -> None:
        """Let the cameras of all browsers look over the ground between them and what they look at."""
        assert self.ground
        for client in self._server.get_clients().values():
            camera = client.camera
            place, target = np.array(camera.position), np.array(camera.look_at)
            if not target.any():
                continue  # the browser has not taken the page's camera yet
            lowest = self.ground.lowest_view(target - self._offset, place - self._offset) + self._offset[2]
            if place[2] < lowest - 0.01:
                place[2] += LIFTING * (lowest - place[2])
                with client.atomic():
                    camera.position = place  # this moves what it looks at, too
                    camera.look_at = target

    def _add_surroundings(self) -> None:
        """Add light, and place the camera."""
        scene = self._server.scene
        scene.configure_default_lights(True, cast_shadow=True)
        scene.configure_environment_map("studio", environment_intensity=0.5)
        camera = self._server.initial_camera
        camera.position, camera.fov = self._size * np.array([1.2, -1.2, 0.62]), 0.75
        camera.look_at = (0.0, 0.0, 0.24 * self._size)

    def _add_plane(self) -> viser.GridHandle:
        """Add a plane, and return it."""
        return self._server.scene.add_grid(
            "/ground",
            infinite_grid=True,
            cell_size=0.25,
            section_size=1.0,
            cell_color=(196, 201, 208),
            section_color=(150, 157, 168),
            plane_color=(226, 229, 234),
            plane_opacity=1.0,
            shadow_opacity=0.35,
            fade_distance=18.0,
        )

    def _add_rough_ground(self, ground: Ground) -> viser.GlbHandle:
        """Add rough ground and the points of the height scan, and return the ground."""
        scene = self._server.scene
        self._scan = scene.add_point_cloud(
            "/scan", np.zeros((1, 3)), SCAN_COLOR, point_size=0.009, point_shape="circle", precision="float32"
        )
        return scene.add_glb("/ground", ground_glb(ground), cast_shadow=False, receive_shadow=True)


def places(num_envs: int) -> np.ndarray:
    """Return where worlds are drawn: on a square grid, the first one in its middle. Shape: (num_envs, 3)."""
    side = int(np.ceil(np.sqrt(num_envs)))
    cells = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), axis=-1).reshape(-1, 2)
    centers = SPACING * (cells - (side - 1) // 2)
    order = np.argsort(np.linalg.norm(centers, axis=1), kind="stable")
    return np.pad(centers[order][:num_envs], ((0, 0), (0, 1)))
