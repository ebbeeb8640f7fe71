"""Height maps for tests of the fused step, and what stands on them."""

from typing import NamedTuple

import mujoco
import numpy as np
import torch
from support.fused import compiled, spoil

from legged_torque.sim.registry import make_engine

BALL = """<mujoco><compiler angle="radian" autolimits="true"/>
<option cone="pyramidal" integrator="implicitfast" impratio="1" timestep="0.005"/>
<worldbody>{floors}<body name="trunk" pos="0 0 1"><freejoint/>
 <geom name="ball" type="{kind}" size="{size}" mass="2" contype="1" conaffinity="15" condim="3" friction="1e-5"/>{fill}
 <body><joint axis="1 0 0" range="-9 9" damping="0.01"/><inertial pos="0 0 0" mass="0.01" diaginertia="1e-3 1e-3 1e-3"/>
 </body></body></worldbody></mujoco>"""
# Tiny spheres in the middle make up for the points of other kinds, so that one kernel simulates all of them:
POINTS = {"sphere": 1, "capsule": 2, "box": 8, "cylinder": 16}
FILL = '<geom size="1e-3" mass="0" contype="1" conaffinity="15" condim="3"/>'
FLAT = '<geom name="floor" type="plane" size="0 0 1" contype="15" conaffinity="1" friction="{friction}"/>'


class Map(NamedTuple):
    """Heights as the simulator takes them."""

    heights: np.ndarray
    horizontal_scale: float
    corner: tuple[float, float]


def make_map(height, scale=0.05, cells=60):
    """The map of a function of x and y around the origin."""
    axis = (np.arange(cells + 1) - 0.5 * cells) * scale
    return Map(height(*np.meshgrid(axis, axis, indexing="ij")).astype(np.float32), scale, (axis[0], axis[0]))


def tilted(slope, yaw):
    """A plane's slopes along x and y, its unit normal, and a quaternion (w, x, y, z) that turns z to it."""
    along = slope * np.array([np.cos(yaw), np.sin(yaw)])
    normal = np.array([-along[0], -along[1], 1.0]) / np.sqrt(1.0 + slope**2)
    quat = np.array([1.0 + normal[2], -normal[1], normal[0], 0.0])
    return along, normal, quat / np.linalg.norm(quat)


def ball(friction=1e-5, kind="sphere", size="0.1", planes=()):
    """A ball with a needless leg on a flat floor, or on planes posed by quaternions through the origin."""
    posed = "".join(
        f'<geom type="plane" size="0 0 1" quat="{" ".join(map(str, quat))}" contype="15" conaffinity="1" '
        f'friction="{friction}"/>'
        for quat in planes
    )
    floors = posed or FLAT.format(friction=friction)
    fill = FILL * max(0, 8 - POINTS[kind])
    spec = mujoco.MjSpec.from_string(BALL.format(floors=floors, kind=kind, size=size, fill=fill))
    if not planes:
        return compiled(spec)
    model = spec.compile()
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 100, 50, 1e-12
    return model


def simulate(model, height_map, places, velocities=0.0, steps=0):
    """A simulator with a trunk at each of some places, after some steps."""
    sim = make_engine("fused", model, len(places), "cpu", 50, 30, height_map=height_map)
    spoil(sim)
    sim.qacc_warmstart.zero_()
    sim.qpos[:, :3] = torch.tensor(np.array(places))
    sim.qvel[:, :3] = torch.as_tensor(velocities)
    for _ in range(steps):
        sim.step()
    return sim


def stairs(x, y):
    """Steps of 0.15 m every 0.3 m, whose risers are one cell deep."""
    return 0.15 * np.floor(x / 0.3 + 1e-6)


def pits(x, y):
    """Pits of 0.3 m by 0.3 m, 0.4 m deep."""
    return np.where((np.floor(x / 0.3 + 1e-6) + np.floor(y / 0.3 + 1e-6)) % 2 == 0, 0.0, -0.4)


def rough(x, y):
    """Heights drawn for each sample."""
    return np.random.default_rng(5).uniform(-0.1, 0.1, x.shape)


def heights_under(height_map, points):
    """Heights of the ground under points. Shape: (..., 3) to (...)."""
    heights, scale, corner = height_map
    places = np.clip((points[..., :2] - corner) / scale, 0.0, np.array(heights.shape) - 1.0)
    i, j = np.clip(np.floor(places).astype(int), 0, np.array(heights.shape) - 2).reshape(-1, 2).T
    i, j = (index.reshape(points.shape[:-1]) for index in (i, j))
    x, y = places[..., 0] - i, places[..., 1] - j
    a, b, c, d = heights[i, j], heights[i + 1, j], heights[i, j + 1], heights[i + 1, j + 1]
    return np.where(x >= y, a + (b - a) * x + (d - b) * y, a + (c - a) * y + (d - c) * x)
