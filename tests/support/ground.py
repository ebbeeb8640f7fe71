"""Small maps of rough ground, and rays of MuJoCo."""

import mujoco
import numpy as np

from legged_torque.envs.robots.a1 import A1Cfg
from legged_torque.terrain.rough import make_terrain
from legged_torque.utils.config import set_by_path, to_dict


def ground_cfg(cfg=None, **settings):
    """Settings of a task on a small map, changed by name."""
    cfg = cfg or A1Cfg()
    small = {"mesh_type": "heightfield", "num_rows": 3, "num_cols": 2, "border_size": 1.0, "tile_size": 6.0}
    small |= {"terrain_proportions": {"stairs_up": 0.5, "rough_slope": 0.5}, "max_init_terrain_level": 1}
    for name in to_dict(cfg.terrain.terrain_proportions):
        set_by_path(cfg, f"terrain.terrain_proportions.{name}", 0.0)
    for name, value in {**small, **settings}.items():
        set_by_path(cfg, f"terrain.{name}", value)
    return cfg


def make_ground(num_envs=8, **settings):
    """Ground of such a map on the CPU."""
    return make_terrain(ground_cfg(**settings).terrain, num_envs, "cpu")


def rays(model, points):
    """Heights of what MuJoCo's vertical rays meet below points [m]."""
    data, heights = mujoco.MjData(model), np.empty(len(points))
    mujoco.mj_forward(model, data)
    for i, (x, y) in enumerate(points):
        above, down = np.array([x, y, 20.0]), np.array([0.0, 0.0, -1.0])
        heights[i] = 20.0 - mujoco.mj_ray(model, data, above, down, None, True, -1, None, None)
    return heights
