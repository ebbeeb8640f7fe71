"""Trials on rough ground: which tiles a policy crosses in time, of all kinds and levels in one batch of worlds.

A trial is one episode. A robot starts in the middle of its tile, heads along x or y, and is commanded to walk on in
that direction. It crosses the tile if its trunk gets over the tile's edge before it falls and before the trial is over.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from legged_torque.envs.base.commands_config import CommandsCfg
from legged_torque.envs.base.evaluation import evaluation_cfg
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.base.metrics import WalkingMetrics
from legged_torque.terrain.rough import RoughGround
from legged_torque.terrain.selection import COLUMNS, named_kinds, rising_levels, select_tiles
from legged_torque.utils.display import Counter
from legged_torque.utils.errors import UserError
from legged_torque.utils.math import quat_rotate_yaw
from legged_torque.utils.metrics import Estimate, estimates

SPEED = 0.6
"""Commanded forward speed, unless another command is given [m/s]."""
SLOWNESS = 2.0
"""A trial lasts this many times as long as the commanded speed needs: as in the curriculum, half of it is enough."""
MIN_SPEED = 0.1
"""Least commanded speed [m/s]; trials at a lower one would take minutes."""
SEED = 10_000
"""Added to the seed of the map, so that its random tiles are not those of the training."""


@dataclass(frozen=True)
class Grounds:
    """Tiles to be crossed, and the command.

    Attributes:
        kinds: Kinds of tiles, each once.
        levels: Difficulties, in rising order.
        command: Commanded v_x, v_y [m/s] in the trunk's frame.
    """

    kinds: list[str]
    levels: list[float]
    command: tuple[float, float]

    @classmethod
    def of(cls, kinds: Sequence[str], levels: Sequence[float], command: Sequence[float] | None = None) -> "Grounds":
        """Return grounds as users name them; a UserError if a kind, a level or a command of three makes no sense."""
        chosen, rising = named_kinds(kinds), rising_levels(levels)
        v_x, v_y, yaw_rate = command or (SPEED, 0.0, 0.0)
        if math.hypot(v_x, v_y) < MIN_SPEED or yaw_rate:
            needed = f"a speed of {MIN_SPEED} m/s or more and a yaw rate of 0, not {v_x:g} {v_y:g} {yaw_rate:g}"
            raise UserError(f"robots cross tiles straight on: the command must have {needed}")
        return cls(chosen, rising, (v_x, v_y))

    def cfg(self, cfg: Any, worlds_per_tile: int) -> Any:
        """Return a copy of a task's settings for trials of ``worlds_per_tile`` worlds on each kind and level.

        The policy sees what it does with the settings given, whatever ground these are for; the critic may not. A
        UserError if the task has commands of its own kind, under which robots may not walk straight on.
        """
        if type(cfg.commands).build is not CommandsCfg.build:
            raise UserError("robots cross tiles under uniform commands; commands.build of the task gives others")
        cfg = evaluation_cfg(cfg, worlds_per_tile * len(self.kinds) * len(self.levels))
        terrain, ranges = cfg.terrain, cfg.commands.ranges
        select_tiles(terrain, self.kinds, self.levels, COLUMNS)
        terrain.seed += SEED
        cfg.env.episode_length_s = self.time_limit(terrain.tile_size) + 1.0  # no trial ends with the episode
        cfg.commands.resampling_probability = cfg.commands.standing_share = cfg.commands.zero_below = 0.0
        ranges.lin_vel_x, ranges.lin_vel_y = ([speed, speed] for speed in self.command)
        cfg.commands.heading_command, cfg.commands.fixed = True, None
        cfg.domain_rand.init_yaw = [0.0, 0.0]
        return cfg

    def time_limit(self, tile_size: float) -> float:
        """Return the longest duration of a trial [s], on tiles with sides of ``tile_size`` [m]."""
        return SLOWNESS * 0.5 * tile_size / math.hypot(*self.command)


@dataclass
class Result:
    """Outcome of the trials on tiles of one kind and level."""

    kind: str
    level: float
    worlds: int
    crossed: Estimate  # share of robots that have crossed their tile in time
    fell: Estimate  # share of robots that have fallen; the others were too slow
    metrics: dict[str, Estimate]  # of walking, until robots have crossed or fallen


def cross(task: LeggedRobot, policy: Callable[[TensorDict], Tensor], grounds: Grounds) -> list[Result]:
    """Let a policy try to cross the tiles of a task with the settings of :meth:`Grounds.cfg`, once in each world.

    Returns:
        Results by kind and then by level.
    """
    ground = task.terrain
    assert isinstance(ground, RoughGround), "tiles are those of rough ground"
    half = 0.5 * ground.layout.tile_size
    walking = WalkingMetrics(task)
    obs = _start(task, ground, grounds.command)
    starts = task.base_pos[:, :2].clone()
    crossed, fell = (torch.zeros_like(task.reset_buf) for _ in range(2))
    num_steps = math.ceil(grounds.time_limit(ground.layout.tile_size) / task.dt)
    with torch.inference_mode(), Counter("crossing tiles, step", num_steps) as counter:
        for _ in range(num_steps):
            commands, is_trying = task.commands.clone(), ~(crossed | fell)
            obs = task.step(policy(obs))[0]
            walking.add_step(commands, is_trying)
            distance = (task.base_pos[:, :2] - starts).abs().amax(dim=1)
            fell |= is_trying & task.reset_buf
            crossed |= is_trying & ~task.reset_buf & (distance > half)
            counter.add()
    ones = torch.ones_like(task.rew_buf)
    return _results(ground, grounds, {"crossed": (crossed, ones), "fell": (fell, ones), **walking.ratios()})


def _start(task: LeggedRobot, ground: RoughGround, command: tuple[float, float]) -> TensorDict:
    """Begin an episode in the middle of each tile, in turns along x, y, -x and -y, and return the observations."""
    task.reset()
    qpos, qvel = task.sim.qpos.clone(), task.sim.qvel.clone()
    turns = torch.arange(task.num_envs, device=task.device) // ground.layout.num_rows % 4
    angles = 0.5 * math.pi * turns - math.atan2(command[1], command[0])
    cos, sin = (0.5 * angles).cos(), (0.5 * angles).sin()
    w, x, y, z = qpos[:, 3:7].unbind(dim=1)  # without a yaw
    qpos[:, :2] = ground.origins[:, :2]
    qpos[:, 3:7] = torch.stack([cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w], dim=1)
    qvel[:, :3] = quat_rotate_yaw(qpos[:, 3:7], qvel[:, :3])
    task.command_generator.headings.copy_(angles)
    task.set_state(qpos, qvel)
    return task.get_observations()


def _results(ground: RoughGround, grounds: Grounds, ratios: dict[str, tuple[Tensor, Tensor]]) -> list[Result]:
    """Return results from numerators and denominators of each world. Shapes: (num_envs,)."""
    of_kind = np.array(ground.layout.kinds())[ground.columns.cpu().numpy()]
    of_level = np.array(grounds.levels)[ground.levels.cpu().numpy()]
    arrays = {name: [part.double().cpu().numpy() for part in parts] for name, parts in ratios.items()}
    results = []
    for kind, level in product(grounds.kinds, grounds.levels):
        worlds = (of_kind == kind) & (of_level == level)
        found = estimates({name: (above[worlds], below[worlds]) for name, (above, below) in arrays.items()})
        results.append(Result(kind, level, int(worlds.sum()), found.pop("crossed"), found.pop("fell"), found))
    return results
