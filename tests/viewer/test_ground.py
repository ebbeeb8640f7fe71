"""Rough ground as it is drawn: it is where the physics has it, in the colors of its kinds, and never hides a robot."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from support.ground import make_ground, rays

from legged_torque.viewer.drawing import CLEARANCE, DISTANCE, Camera, Ground, drawn_model, patches, size_of

XML = Path(__file__).resolve().parents[2] / "resources" / "robots" / "a1" / "a1.xml"
KINDS = {"stairs_up": 0.25, "rough_slope": 0.25, "stepping_stones": 0.25, "pits": 0.25}


@pytest.fixture(scope="module")
def terrain():
    """A small map, as the task has it."""
    return make_ground(1, terrain_proportions=KINDS, num_cols=4, num_rows=2, max_init_terrain_level=0)


@pytest.fixture(scope="module")
def ground(terrain):
    """The same, to be drawn."""
    return Ground(terrain.layout)


def test_surface(terrain, ground):
    """Rays meet the drawn triangles, few as they are, at the heights of the map; in twisted rectangles, near them."""
    model = drawn_model(XML, ground)
    floor = model.geom("floor")
    assert floor.type == mujoco.mjtGeom.mjGEOM_MESH and floor.contype == floor.conaffinity == 0
    points = np.random.default_rng(0).uniform(-0.499, 0.499, (600, 2)) * terrain.map.size
    points = points[np.abs(points).max(axis=1) > 1.0]  # where no robot is in the way
    found = rays(model, points)
    errors = np.abs(found - terrain.map.height(torch.from_numpy(points)).numpy())
    assert errors.max() < 0.01 and np.quantile(errors, 0.8) < 1e-5
    assert len(ground.faces) < 0.2 * 2 * terrain.map.heights.size
    outside = np.array([99.0, -99.0])  # as at the edge
    assert ground.height(outside) == terrain.map.heights[-1, 0]


@pytest.mark.parametrize("kind", ["plane", "random", "map"])
def test_patches(terrain, kind):
    """Rectangles cover every cell once; what has one slope is not cut finer than 1 m."""
    plane, random = 0.1 * np.arange(51)[:, None] + 0.2 * np.arange(41), np.random.default_rng(0).normal(size=(51, 41))
    heights = {"plane": plane, "random": random, "map": terrain.map.heights[:200, :90]}[kind].astype(np.float32)
    found = patches(heights)
    covered = np.zeros((heights.shape[0] - 1, heights.shape[1] - 1), int)
    for first_row, last_row, first_col, last_col in found:
        covered[first_row:last_row, first_col:last_col] += 1
        for row in (first_row, last_row):
            line = heights[row, first_col : last_col + 1]
            np.testing.assert_allclose(line, np.linspace(line[0], line[-1], len(line)), atol=2e-3)
    assert (covered == 1).all()
    assert kind != "plane" or len(found) == 3 * 2


@pytest.mark.parametrize("azimuth", np.radians([0.0, 50.0, 90.0, 180.0, 300.0]))
def test_camera(terrain, ground, azimuth):
    """From anywhere in a pit or between stones, the camera of a video sees the robot; on level ground it is as ever."""
    for row, col in ((1, 3), (1, 2), (1, 0)):
        middle = terrain.layout.origins(terrain.map.heights)[row, col]
        position = middle + 1.7 * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        position[2] = ground.height(position) + 0.3
        camera = Camera(ground, 1.0).look_at(position)
        lookat, (azimuth_of, elevation) = np.array(camera.lookat), np.radians([camera.azimuth, camera.elevation])
        ahead = np.array([np.cos(azimuth_of), np.sin(azimuth_of), np.tan(elevation)]) * np.cos(elevation)
        ways = lookat - np.linspace(0.3, 1.0, 50)[:, None] * camera.distance * ahead
        assert lookat[2] == pytest.approx(ground.height(position) + 0.25, abs=1e-5)
        assert (ways[:, 2] > ground.height(ways)).all() and ways[-1, 2] > ground.height(ways[-1]) + 0.9 * CLEARANCE
    plane = Camera(None, 1.0).look_at(np.array([1.0, 2.0, 0.5]))
    assert (plane.distance, plane.azimuth, plane.elevation) == pytest.approx((DISTANCE, 130.0, -18.0))
    np.testing.assert_allclose(plane.lookat, [1.0, 2.0, 0.25])


@pytest.mark.parametrize(("robot", "top", "size"), [("a1", 0.4, 1.0), ("go2", 0.45, None), ("g1", 1.32, None)])
def test_camera_sees_robots_of_every_size(robot, top, size):
    """Feet and head of a robot that is so tall [m] are in the picture, and fill a fifth of its height or more."""
    model = drawn_model(XML.parents[1] / robot / f"{robot}.xml", None)
    camera = Camera(None, size or size_of(model)).look_at(np.zeros(3))
    assert size is None or size_of(model) == size  # pictures of the A1 are as they always were
    elevation = np.radians(camera.elevation)
    away, up = -camera.distance * np.cos(elevation), camera.lookat[2] - camera.distance * np.sin(elevation)
    feet, head = (np.arctan2(z - up, -away) - elevation for z in (0.0, top))
    half = 0.5 * np.radians(model.vis.global_.fovy)
    assert -0.9 * half < feet < 0.0 < head < 0.9 * half and head - feet > 0.4 * half
