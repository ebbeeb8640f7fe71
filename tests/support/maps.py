"""Height maps for tests of the fused step, with robots on them."""

from typing import NamedTuple

import mujoco
import numpy as np
import torch
from support.fused import compiled, draw_states, make_a1, spoil

from legged_torque.sim.registry import make_engine
from tools.accuracy import PlanePerFoot, copy_state, reference_step

BALL = """<mujoco><compiler angle="radian" autolimits="true"/>
<option cone="pyramidal" integrator="implicitfast" impratio="1" timestep="0.005"/>
<worldbody>{floors}<body name="trunk" pos="0 0 1"><freejoint/>
 <geom name="ball" type="{kind}" size="{size}" mass="2" contype="1" conaffinity="15" condim="3" friction="1e-5"/>{fill}
 <body><joint axis="1 0 0" range="-9 9" damping="0.01"/><inertial pos="0 0 0" mass="0.01" diaginertia="1e-3 1e-3 1e-3"/>
 </body></body></worldbody></mujoco>"""
# Tiny geoms inside give all kinds as many points and the code of cylinders, so that one kernel simulates them all:
FILL = '<geom size="1e-3" mass="0" contype="1" conaffinity="15" condim="3"/>'
DISC = '<geom type="cylinder" size="1e-3 1e-3" mass="0" contype="1" conaffinity="15" condim="3"/>'
FILLS = {"sphere": DISC + 11 * FILL, "capsule": DISC + 6 * FILL, "cylinder": 12 * FILL, "box": DISC}
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
    spec = mujoco.MjSpec.from_string(BALL.format(floors=floors, kind=kind, size=size, fill=FILLS[kind]))
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


def roofs(x, y):
    """Slopes of 0.8 m by 0.8 m, which meet in ridges and valleys."""
    return 0.3 * np.abs(x % 1.6 - 0.8) + 0.2 * np.abs(y % 1.6 - 0.8)


def states_on_slope(slope, num):
    """The A1 on a tilted plane, states in which it touches it, and the map of this plane.

    Of boxes that are more than half in it, MuJoCo lets only the lower corners touch: those states are left out.
    """
    along, normal, quat = tilted(slope, 0.7)
    model = compiled(make_a1(lambda spec: setattr(spec.geom("floor"), "quat", quat)))
    states = draw_states(model, num, (0.05, 0.4))
    data, boxes = mujoco.MjData(model), model.geom_type == mujoco.mjtGeom.mjGEOM_BOX
    kept = []
    for data.qpos[:] in states["qpos"]:
        mujoco.mj_kinematics(model, data)
        kept.append((data.geom_xpos[boxes] @ normal > 0.0).all())
    states = {field: values[kept] for field, values in states.items()}
    return model, states, make_map(lambda x, y: along[0] * x + along[1] * y)


def feet_only(spec):
    """Let nothing but feet reach the ground: legs are tiny and at the joints, and the trunk's box is far above it.

    Its size stays, since kernels are compiled for the number of parts of boxes.
    """
    for geom in spec.geoms:
        if geom.name == "trunk":
            geom.pos = [0.0, 0.0, 3.0]
        elif geom.conaffinity and not geom.name.endswith("foot") and geom.name != "floor":
            geom.size, geom.pos = [1e-3, 1e-3, 1e-3], [0.0, 0.0, 0.0]


def assert_feet_meet_planes(worlds, device="cpu"):
    """Robots that stand on roofs move as in plain MuJoCo with a plane posed under each foot, where that is exact."""
    rng, ground = np.random.default_rng(2), make_map(roofs, cells=120)
    sim = make_engine("fused", compiled(make_a1(feet_only)), worlds, device, 100, 50, ground)
    home = torch.tensor(sim.mj_model.key_qpos[0], dtype=torch.float32, device=device)
    sim.qpos.copy_(home)
    sim.qpos[:, :2] = torch.tensor(rng.uniform(-1.5, 1.5, (worlds, 2)), device=device)
    sim.qpos[:, 2] += 0.4
    for _ in range(150):
        sim.ctrl.copy_(60.0 * (home[7:] - sim.qpos[:, 7:]) - 1.5 * sim.qvel[:, 6:])
        sim.step()
    states = copy_state(sim)
    planes = PlanePerFoot(make_a1(feet_only), [f"{leg}_foot" for leg in ("FR", "FL", "RR", "RL")], ground)
    expected, exact = reference_step(planes.model, states, planes.pose)
    sim.step()
    assert exact.mean() > 0.3 and (sim.contact_found.cpu().numpy()[exact] > 0).any(axis=1).mean() > 0.9
    np.testing.assert_allclose(sim.qvel.cpu().numpy()[exact], expected[exact], rtol=0, atol=1e-3)
