"""Rough ground: the surface as MuJoCo has it, tiles by legged_gym's formulas, levels by its rule."""

import math
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from support.ground import ground_cfg, make_ground, rays
from support.settings import error_of

from legged_torque.envs.base.evaluation import evaluation_cfg
from legged_torque.envs.base.validation import check_env_cfg
from legged_torque.envs.robots.a1 import A1Cfg
from legged_torque.terrain.height_map import HeightMap
from legged_torque.terrain.layout import Layout
from legged_torque.terrain.rough import make_terrain
from legged_torque.terrain.selection import named_kinds, select_tiles
from legged_torque.terrain.tiles import TILES, Grid
from legged_torque.utils.config import flat, to_dict
from legged_torque.utils.task_registry import task_registry

GRID = Grid(160, 0.05)
MIDDLE = 80
FLOOR = """<mujoco><worldbody><geom name="wall" type="box" size="1 1 1" pos="0 0 -90"/>
<geom name="floor" type="plane" size="0 0 0.05" friction="0.7 0.02 0.01" quat="1 0.2 0 0"/></worldbody></mujoco>"""


def tile(name, difficulty, seed=0):
    """Heights of one tile."""
    return TILES[name](difficulty, np.random.default_rng(seed), GRID)


@pytest.mark.parametrize("name", TILES)
def test_surface_is_that_of_mujocos_hfield(name):
    """Heights of every kind of tile are those that rays find, in both precisions."""
    layout = Layout(2, 1, 8.0, 0.5, 0.05, [0.1, 1.0], {name: 1.0}, 3)
    surface = HeightMap(layout.heights(), 0.05, layout.corner, "cpu")
    spec = mujoco.MjSpec.from_string(FLOOR)
    surface.add_to(spec, "floor")
    model = spec.compile()
    assert model.geom("floor").type == mujoco.mjtGeom.mjGEOM_HFIELD
    np.testing.assert_array_equal(model.geom("floor").friction, [0.7, 0.02, 0.01])
    points = np.random.default_rng(0).uniform(-0.499, 0.499, (1000, 2)) * surface.size
    heights = rays(model, points)
    double = torch.from_numpy(points)
    np.testing.assert_allclose(surface.height(double), heights, atol=1e-5)
    steepest = np.abs(np.diff(surface.heights, axis=0)).max() / 0.05
    np.testing.assert_allclose(surface.height(double.float()), heights, atol=1e-5 * (1.0 + steepest))


def test_place_of_the_map():
    """Row and column are x and y; samples are met exactly; points outside have the height of the nearest edge."""
    heights = np.arange(12.0).reshape(3, 4) ** 2
    surface = HeightMap(heights, 0.5, (-1.0, 2.0), "cpu")
    assert surface.size == (1.0, 1.5)
    x, y = np.meshgrid([-1.0, -0.5, 0.0], [2.0, 2.5, 3.0, 3.5], indexing="ij")
    np.testing.assert_array_equal(surface.height(torch.tensor(np.stack([x, y], -1))), heights)
    outside = torch.tensor([[-9.0, 2.5], [9.0, 9.0], [-0.5, -1e30], [torch.inf, 2.0]])
    assert surface.height(outside).tolist() == [1.0, 121.0, 16.0, 64.0]
    broken = torch.tensor([[torch.nan, 2.5, 0.0], [0.0, -torch.inf, torch.nan]])
    assert surface.height(broken).isfinite().all()


@pytest.mark.parametrize("name", TILES)
def test_start_is_level(name):
    """The middle of every tile is level 1 m around, except for 0.05 m of a rough slope."""
    heights = tile(name, 1.0)
    assert heights.shape == (161, 161) and np.isfinite(heights).all()
    start = heights[MIDDLE - 20 : MIDDLE + 21, MIDDLE - 20 : MIDDLE + 21]
    assert np.ptp(start) <= (0.1 + 1e-9 if name == "rough_slope" else 1e-9)


@pytest.mark.parametrize(("name", "sign"), [("stairs_up", 1.0), ("stairs_down", -1.0)])
def test_stairs(name, sign):
    """From the middle to the edge there are nine steps of 0.05 + 0.18 d, each tread 0.31 m long in whole cells."""
    heights = tile(name, 0.5)
    for line in (heights[MIDDLE:, MIDDLE], heights[MIDDLE, MIDDLE::-1]):
        rises = np.diff(line)
        (steps,) = np.nonzero(rises)
        np.testing.assert_allclose(rises[steps], sign * 0.14)
        assert len(steps) == 9 and (np.diff(steps) == 6).all() and heights[0, 0] == 0.0
    assert steps[0] * 0.05 == pytest.approx(1.3)  # half the platform


@pytest.mark.parametrize(("name", "sign"), [("smooth_slope_up", 1.0), ("smooth_slope_down", -1.0)])
def test_slopes(name, sign):
    """Seen from the middle, sides have a slope of 0.4 d; the platform is 4 m x 0.4 d x (1 - 1.5 / 4)^2 off."""
    heights = tile(name, 0.6)
    np.testing.assert_allclose(np.diff(heights[150:, MIDDLE]) / 0.05, sign * 0.24)
    assert heights[MIDDLE, MIDDLE] == pytest.approx(-sign * 4.0 * 0.24 * 0.625**2)
    assert heights[MIDDLE + 30, MIDDLE + 30] == pytest.approx(heights[MIDDLE, MIDDLE])


def test_roughness():
    """A rough slope is the hill and random multiples of 0.005 m at points 0.2 m apart, linear between them."""
    rough = tile("rough_slope", 0.6) - tile("smooth_slope_down", 0.6)
    coarse = rough[::4, ::4]
    np.testing.assert_allclose(coarse / 0.005, np.rint(coarse / 0.005), atol=1e-9)
    assert coarse.min() == pytest.approx(-0.05) and coarse.max() == pytest.approx(0.05) and coarse.std() > 0.025
    np.testing.assert_allclose(rough[2::4, ::4], 0.5 * (coarse[1:] + coarse[:-1]), atol=1e-12)


def test_other_tiles():
    """Sizes at known difficulties: obstacles, crests, sides of stones and holes, widths of trenches, depths of pits."""
    obstacles = np.unique(tile("discrete_obstacles", 0.5))
    np.testing.assert_allclose(obstacles / 0.15, [-1.0, -0.5, 0.0, 0.5, 1.0], atol=1e-9)  # of 0.05 + 0.2 d
    assert tile("waves", 1.0).max() == pytest.approx(0.3, abs=0.01) and (tile("waves", 0.0) == 0.0).all()
    for difficulty, side, hole in ((0.0, 32, 1), (0.5, 16, 2), (0.9, 4, 2)):  # 1.575, 0.825, 0.225 m; 0.05, 0.1 m
        row = tile("stepping_stones", difficulty)[:, 0]
        (edges,) = np.nonzero(np.diff(row))
        assert set(np.diff(edges)) == {side, hole} and set(row) == {0.0, -1.0}
    for difficulty, cells in ((0.0, 0), (0.5, 10), (1.0, 20)):
        row = tile("gaps", difficulty)[MIDDLE:, MIDDLE]
        assert (row < 0.0).sum() == cells and (row[:31] == 0.0).all() and (row[31 : 31 + cells] == -1.0).all()
    pit = tile("pits", 0.3)
    assert pit[MIDDLE + 40, MIDDLE - 40] == pit[MIDDLE, MIDDLE] == -0.3 and pit[MIDDLE + 41, MIDDLE] == 0.0


def test_map_repeats_and_its_seed_matters():
    """A seed gives the same map; each tile's numbers are its own, so that a larger map has the same tiles."""
    layout = Layout.of(ground_cfg().terrain)
    np.testing.assert_array_equal(layout.heights(), Layout.of(ground_cfg().terrain).heights())
    assert (layout.heights() != Layout.of(ground_cfg(seed=2).terrain).heights()).any()
    higher = Layout.of(ground_cfg(num_rows=6, difficulty_range=[0.0, 0.5]).terrain)
    assert higher.difficulty(0) == layout.difficulty(0)
    np.testing.assert_array_equal(higher.tile(0, 1), layout.tile(0, 1))
    assert (layout.tile(0, 1) != layout.tile(1, 1)).any()


def test_map_is_put_together():
    """Tiles lie in rows along x that get more difficult; the border is level; origins are on the middles."""
    layout = Layout.of(ground_cfg().terrain)
    heights = layout.heights()
    assert heights.shape == (3 * 120 + 41, 2 * 120 + 41) and layout.corner == (-10.0, -7.0)
    assert not heights[:20].any() and not heights[:, -20:].any()
    for row, difficulty in enumerate((0.0, 1 / 3, 2 / 3)):
        assert layout.difficulty(row) == pytest.approx(difficulty)
        stairs = heights[20 + 120 * row + 60, 20 + 180 : 20 + 240]
        np.testing.assert_allclose(np.diff(stairs).max(), 0.05 + 0.18 * difficulty, atol=1e-6)
    ground = make_ground()
    surface = ground.map.height(ground.origins)
    is_stairs = ground.columns == 1
    torch.testing.assert_close(surface[is_stairs], ground.origins[is_stairs, 2])
    assert (ground.origins[:, 2] >= surface).all()
    expected = {(-6.0, -3.0), (0.0, -3.0), (-6.0, 3.0), (0.0, 3.0)}  # levels 0 and 1 of both columns
    assert {(x, y) for x, y, _ in ground.origins.tolist()} == expected


@pytest.mark.parametrize(("size", "scale"), [(8.1, 0.3), (8.4, 0.3), (8.4, 0.4), (8.0, 0.05)])
def test_origins_are_above_the_ground(size, scale):
    """No point at which robots start, up to 1 m from the middle, is higher, even between samples or on odd cells."""
    layout = Layout(4, 1, size, scale, scale, [0.1, 1.0], {"rough_slope": 1.0}, 3)
    surface = HeightMap(layout.heights(), scale, layout.corner, "cpu")
    origins = torch.from_numpy(layout.origins(layout.heights()))
    x, y = torch.meshgrid(torch.linspace(-1, 1, 201), torch.linspace(-1, 1, 201), indexing="ij")
    for x0, y0, height in origins[:, 0].tolist():
        highest = float(surface.height(torch.stack([x0 + x, y0 + y], dim=-1)).max())
        assert highest - 1e-5 <= height <= highest + 0.03


def test_columns_by_share():
    """The default shares get the columns that legged_gym gives them, whatever their number."""
    cfg = A1Cfg()
    shares = to_dict(cfg.terrain.terrain_proportions)
    names, sums = list(shares), np.cumsum(list(shares.values()))
    for num_cols in (20, 40, 100):
        cfg.terrain.num_cols = num_cols
        legged_gym = [names[int(np.argmax(j / num_cols + 0.001 < sums))] for j in range(num_cols)]
        assert Layout.of(cfg.terrain).kinds() == legged_gym


def test_a_kind_of_ones_own(monkeypatch):
    """The page's own text: a ramp that is level up to 1 m and rises by 0.3 d from there, in a fifth of the columns.

    A kind that is not in TILES, or returns what is no tile, is an error.
    """
    monkeypatch.setitem(TILES, "ramp", None)  # to be forgotten afterwards, as is the task
    monkeypatch.setattr(task_registry, "_tasks", dict(task_registry._tasks))
    page = (Path(__file__).parents[2] / "docs" / "terrain.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"^```python\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL)
    names = {"__name__": "page"}
    exec(code, names)
    layout = Layout.of(names["RampCfg"]().terrain)
    assert layout.kinds().count("ramp") == 4
    slopes = np.diff(layout.tile(5, layout.kinds().index("ramp")), axis=0) / 0.05
    np.testing.assert_allclose(slopes, np.repeat([0.0, 0.15], [100, 60])[:, None].repeat(161, 1), atol=1e-9)
    only = {"cfg": names["RampCfg"](), "terrain_proportions": {"ramp": 1.0}, "difficulty_range": [0.5, 0.5]}
    ground, cfg = make_ground(**only), A1Cfg()
    select_tiles(cfg.terrain, named_kinds(["all"]), [], 1)
    cfg.check()  # which declares no share of it
    assert Layout.of(cfg.terrain).kinds() == list(TILES)
    place = torch.tensor([[2.02, 0.0, 0.0]])
    torch.testing.assert_close(ground.map.height(place), torch.tensor([0.15 * 2.02]))
    for heights in (np.zeros(3), None):
        monkeypatch.setitem(TILES, "ramp", lambda difficulty, rng, grid, heights=heights: heights)
        line = error_of(make_ground, **only)
        assert line == "the kind of tile 'ramp' must return finite heights of shape (121, 121)"
    monkeypatch.delitem(TILES, "ramp")
    assert "unknown kind in terrain.terrain_proportions 'ramp';" in error_of(make_ground, **only)


def test_worlds_are_spread():
    """Columns are shared evenly; levels are the first ones with the curriculum, all without it."""
    ground = make_ground(12)
    assert ground.columns.tolist() == [0] * 6 + [1] * 6 and set(ground.levels.tolist()) == {0, 1}
    assert ground.levels[:6].bincount().tolist() == [3, 3]
    assert make_ground(12, curriculum=False).levels[6:].bincount().tolist() == [2, 2, 2]


def test_levels_move_by_legged_gyms_rule():
    """Up beyond half a tile, down below half of what was commanded, any after the highest; others stay."""
    torch.manual_seed(0)
    ground = make_ground(2000, num_rows=4, max_init_terrain_level=3)
    before = ground.levels.clone()
    mask, distance = torch.rand(2000) < 0.7, 6.0 * torch.rand(2000)
    commands = torch.rand(2000, 3) - 0.5
    commanded = 10.0 * commands[:, 0].hypot(commands[:, 1])
    direction = torch.nn.functional.normalize(torch.randn(2000, 2), dim=1)
    place = ground.origins + torch.cat([direction * distance.unsqueeze(1), torch.rand(2000, 1)], dim=1)
    kept = ground.levels
    ground.end_episodes(mask, place, commands, 10.0)
    drawn = []
    for was, is_over, got, asked, now in zip(before.tolist(), mask, distance, commanded, kept.tolist(), strict=True):
        change = 0 if not is_over else 1 if got > 3.0 else -1 if got < 0.5 * asked else 0
        if was + change == 4:
            drawn.append(now)
        else:
            assert now == max(was + change, 0)
    assert set(drawn) == {0, 1, 2, 3} and len(drawn) > 50


def test_levels_stay_in_evaluations():
    """Measured worlds are spread over all levels, wherever they get."""
    cfg = evaluation_cfg(ground_cfg(), 12)
    ground = make_terrain(cfg.terrain, 12, "cpu")
    before = ground.levels.clone()
    assert set(before.tolist()) == {0, 1, 2}
    ended = torch.ones(12, dtype=torch.bool)
    ground.end_episodes(ended, ground.origins + 5.0, torch.ones(12, 3), 20.0)
    assert torch.equal(ground.levels, before)


@pytest.fixture
def make_rough_task(make_task):
    """Factory of tasks on stairs."""
    cfg = flat({"terrain": to_dict(ground_cfg(terrain_proportions={"rough_slope": 0.0, "stairs_up": 1.0}).terrain)})
    return lambda num_envs, **changes: make_task("a1_position", num_envs, **(cfg | changes))


def test_height_scan(make_rough_task):
    """Point by point: 17 x 11 heights along the heading, clipped and scaled; the policy sees them by option only."""
    task = make_rough_task(2)
    seen = {"terrain.measure_heights": True, "noise.add_noise": True, "noise.noise_scales.height_measurements": 0.02}
    other = make_rough_task(2, **seen)
    position = torch.tensor([[2.0, 1.7, 0.9], [-5.2, -3.1, -0.7]])
    for robots in (task, other):
        robots.base_pos.copy_(position)
        yaw, roll = torch.tensor([0.4, -1.1]), torch.tensor([0.3, 0.0])
        turns = [yaw.cos() * roll.cos(), yaw.cos() * roll.sin(), yaw.sin() * roll.sin(), yaw.sin() * roll.cos()]
        robots.base_quat.copy_(torch.stack(turns, dim=1))  # half the angles: first about x, then about z
        robots.set_state(robots.sim.qpos.clone(), robots.sim.qvel.clone())
    x, y = torch.meshgrid(0.1 * torch.arange(17) - 0.8, 0.1 * torch.arange(11) - 0.5, indexing="ij")
    expected = torch.empty(2, 17 * 11)
    for world, heading in enumerate((0.8, -2.2)):
        cos, sin = math.cos(heading), math.sin(heading)
        points = position[world, :2] + torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)
        above = position[world, 2] - 0.5 - task.terrain.map.height(points)
        expected[world] = 5.0 * above.clamp(-1.0, 1.0).flatten()
    assert (expected == -5.0).any() and expected.max() > 0.0
    obs, others = task.get_observations(), other.get_observations()
    assert obs["policy"].shape == (2, 45) and others["policy"].shape == (2, 45 + 187)
    torch.testing.assert_close(obs["critic"][:, -187:], expected, atol=1e-3, rtol=0.0)
    errors = (others["policy"][:, 45:] - expected).abs()
    assert 0.08 < errors.max() < 0.1 + 1e-3
    mirrored = task.mirror("critic", obs["critic"])[:, -187:].view(2, 17, 11)
    torch.testing.assert_close(mirrored.flip(2).flatten(1), obs["critic"][:, -187:])


def test_levels_and_places_in_episodes(make_rough_task):
    """Worlds begin on their tiles; when an episode ends far away, the next begins a level higher."""
    task = make_rough_task(4)
    torch.testing.assert_close(task.base_pos[:, :2], task.terrain.origins[:, :2])
    assert task.terrain.levels.tolist() == [0, 1, 0, 1] and task.curriculum_values()["terrain_level"] == 0.5
    task.base_pos[:, 0] += torch.tensor([3.2, 3.2, 2.8, 2.8])
    task.commands.copy_(torch.tensor([0.2, 0.0, 0.0]).expand(4, 3))
    task.episode_length_buf = torch.full((4,), task.max_episode_length - 1)
    task.step(torch.zeros(4, 12))
    assert task.reset_buf.all() and task.terrain.levels.tolist() == [1, 2, 0, 1]
    torch.testing.assert_close(task.base_pos[:, :2], task.terrain.origins[:, :2])
    task.base_pos[0, 0], task.base_pos[1, 1] = torch.inf, 1e30  # broken worlds have walked nowhere
    task.step(torch.zeros(4, 12))
    assert task.reset_buf.tolist() == [True, True, False, False] and task.terrain.levels.tolist() == [1, 2, 0, 1]
    assert (task.base_pos - task.terrain.origins)[:, :2].abs().max() < 0.1  # the others have not been moved


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"terrain_proportions": {"flat": 0.5, "pits": 0.4}}, "terrain_proportions must sum to 1, not 0.9"),
        ({"terrain_proportions": {"flat": 0.9, "pits": 0.1}}, "terrain_proportions.pits of 0.1 is too small for a"),
        ({"difficulty_range": [0.0, 1.1]}, "difficulty_range must be [minimum, maximum], from 0 to 1"),
        ({"max_init_terrain_level": 3}, "max_init_terrain_level must be at most 2, since terrain.num_rows is 3, not 3"),
        ({"tile_size": 6.03}, "tile_size must be a multiple of terrain.horizontal_scale, 0.05, not 6.03"),
        ({"measured_points_y": [0.0, -1.5]}, "measured_points_y must be at most terrain.border_size, 1.0, either way"),
        ({"num_rows": 100, "num_cols": 100, "horizontal_scale": 0.01}, "samples, more than 134217728"),
    ],
)
def test_mistakes_are_told(settings, line):
    """One line says what cannot be, before anything is built."""
    assert line in error_of(lambda: check_env_cfg(ground_cfg(**settings)))
