"""Crossing tiles of rough ground: places of starts, crossings and their counts."""

import math

import pytest
import torch
from support.ground import ground_cfg, make_ground
from support.settings import error_of

from legged_torque.envs.base.crossing import Grounds, cross
from legged_torque.envs.robots.a1 import A1Cfg
from legged_torque.terrain.layout import Layout
from legged_torque.terrain.rough import make_terrain
from legged_torque.terrain.tiles import TILES
from legged_torque.utils.options import Options
from legged_torque.utils.task_registry import task_registry

FAST = [2.0, 0.0, 0.0]  # a command under which a trial lasts 2 * 4 m / 2 m/s = 4 s


def make_crossing(grounds, worlds, task="a1_position"):
    """A task for trials on grounds, on the CPU."""
    torch.manual_seed(0)
    cfg, _ = task_registry.get_cfgs(task)
    cfg.commands.fixed = [0.5, 0.1, 0.3]  # of the training, not of trials
    return task_registry.make_env(task, Options(device="cpu"), grounds.cfg(cfg, worlds))[0]


def tile_of(task, world):
    """Kind and level of a world's tile, found out by the heights of trenches and pits on the map."""
    origin = task.terrain.origins[world]
    places = origin + torch.tensor([[1.6, 0.0, 0.0], [1.8, 0.0, 0.0], [2.5, 0.0, 0.0]])
    trenches = {(0.0, 0.0, 0.0): ("flat", None), (-1.0, 0.0, 0.0): ("gaps", 0.2), (-1.0, -1.0, 0.0): ("gaps", 0.8)}
    return trenches[tuple(task.terrain.map.height(places).tolist())]


def test_crossings():
    """Robots carried at known speeds cross if they get 4 m away in time; nothing counts after a fall or a crossing."""
    grounds = Grounds.of(["gaps", "flat"], [0.8, 0.2], FAST)
    task = make_crossing(grounds, 4)
    assert (grounds.kinds, grounds.levels, task.num_envs) == (["gaps", "flat"], [0.2, 0.8], 16)
    speeds = torch.tensor([0.0, 0.95, 1.05, 2.0] * 4)  # [m/s]: 4 m in 4 s need 1 m/s
    falls_at = torch.full((16,), 1000)
    falls_at[[5, 7]], falls_at[11], falls_at[14] = 60, 150, 250  # 11: after it has crossed; 14: after its trial
    commanded, headings, state = [], [], {}

    def carry(obs):
        """Put robots where they are to be, 1 m high or, to let them fall, into the ground."""
        if not state:
            x, y = task.base_pos[:, 0], task.base_pos[:, 1]
            torch.testing.assert_close(torch.stack([x, y], 1), task.terrain.origins[:, :2])
            w, z = task.base_quat[:, 0], task.base_quat[:, 3]
            headings.append(2.0 * torch.atan2(z, w))
            state.update(qpos=task.sim.qpos.clone(), step=0)
        state["step"] += 1
        commanded.append(task.commands.clone())
        qpos, along = state["qpos"].clone(), speeds * state["step"] * task.dt
        qpos[:, 0] += along * headings[0].cos()
        qpos[:, 1] += along * headings[0].sin()
        qpos[:, 2] = torch.where(falls_at == state["step"], 0.0, 1.0)
        task.set_state(qpos, torch.zeros_like(task.sim.qvel))
        return torch.zeros(16, 12)

    results = {(result.kind, result.level): result for result in cross(task, carry, grounds)}
    assert state["step"] == 200  # of 0.02 s
    quarters = (headings[0] / (0.5 * math.pi)).round()
    torch.testing.assert_close(headings[0], quarters * 0.5 * math.pi, atol=0.06, rtol=0.0)  # also rolled and pitched
    assert sorted((quarters % 4).tolist()) == [0.0] * 4 + [1.0] * 4 + [2.0] * 4 + [3.0] * 4
    for commands in commanded:
        whole = commands[falls_at == 1000]  # in new episodes headings are others
        torch.testing.assert_close(whole, torch.tensor(FAST).expand(12, 3), atol=0.02, rtol=0.0)
    fallen = {5, 7}
    arrived = {world for world in range(16) if speeds[world] > 1.0} - fallen
    flat = iter([0.2, 0.8] * 4)
    tiles = [(kind, level or next(flat)) for kind, level in (tile_of(task, world) for world in range(16))]
    for tile, result in results.items():
        worlds = [world for world in range(16) if tiles[world] == tile]
        assert result.worlds == len(worlds) == 4
        for share, members in ((result.crossed, arrived), (result.fell, fallen)):
            mean = len(members & set(worlds)) / 4
            assert share.mean == mean
            assert share.standard_error == pytest.approx(math.sqrt(mean * (1.0 - mean) / 3))
    assert list(results) == [("gaps", 0.2), ("gaps", 0.8), ("flat", 0.2), ("flat", 0.8)]


def test_standing_robots_do_not_cross():
    """Robots that hold their nominal pose neither cross nor fall, even on the steepest stairs."""
    grounds = Grounds.of(["stairs_up"], [1.0], FAST)
    task = make_crossing(grounds, 4)
    (result,) = cross(task, lambda obs: torch.zeros(4, 12), grounds)
    assert (result.crossed.mean, result.fell.mean, result.worlds) == (0.0, 0.0, 4)
    assert abs(result.metrics["speed"].mean) < 0.1 and 0.2 < result.metrics["height"].mean < 0.4


def test_a_trial_by_default():
    """Robots have twice as long as 4 m take at 0.6 m/s; kinds and levels are sets."""
    grounds = Grounds.of(["flat", "all"], [0.3, 0.1, 0.3])
    assert (grounds.kinds, grounds.levels, grounds.command) == (list(TILES), [0.1, 0.3], (0.6, 0.0))
    assert grounds.time_limit(8.0) == pytest.approx(2 * 4.0 / 0.6)
    sideways = Grounds.of(["pits", "flat", "pits"], [1.0], [0.3, -0.4, 0.0])
    assert sideways.kinds == ["pits", "flat"] and sideways.time_limit(6.0) == pytest.approx(2 * 3.0 / 0.5)


def test_difficulties_of_rows():
    """They take the place of a range; another number of them than of rows is refused."""
    layout = Layout.of(ground_cfg(difficulties=[0.7, 0.1, 1.0]).terrain)
    assert [layout.difficulty(row) for row in range(3)] == [0.7, 0.1, 1.0]
    message = "terrain.difficulties must be empty or one number for each row, not 2: terrain.num_rows is 3"
    assert error_of(Layout.of, ground_cfg(difficulties=[0.7, 0.1]).terrain) == message


def test_random_tiles_differ():
    """Worlds on one kind and level stand on four tiles, which are not those of the training."""
    grounds = Grounds.of(["discrete_obstacles"], [0.5])
    ground = make_terrain(grounds.cfg(A1Cfg(), 8).terrain, 8, "cpu")
    training = make_ground(terrain_proportions={"discrete_obstacles": 1.0}, difficulty_range=[0.5, 0.5], tile_size=8.0)
    places = torch.cartesian_prod(torch.arange(-3.5, 4.0, 0.5), torch.arange(-3.5, 4.0, 0.5), torch.zeros(1))
    tiles = {tuple(of.map.height(origin + places).tolist()) for of in (ground, training) for origin in of.origins}
    assert len(tiles) == 4 + len({*zip(training.levels.tolist(), training.columns.tolist(), strict=True)})
