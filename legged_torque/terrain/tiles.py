"""Kinds of rough ground: each a function from a difficulty, 0 to 1, to the heights of one square tile.

Formulas and ranges are legged_gym's (Rudin et al., *Learning to Walk in Minutes Using Massively Parallel Deep
Reinforcement Learning*), but holes are less deep, gaps are around a platform of 3 m, and waves, which legged_gym does
not use, are our own. Lengths are rounded to whole cells, heights not at all. A wall is one cell wide; lengths are
those at half its height. Robots start in the middle of a tile: slopes and stairs go up or down as seen from there.

A kind of one's own is a function with these arguments in :data:`TILES`, and its share in
``terrain.terrain_proportions``.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

START_SIZE = 2.0
"""Side of the square in the middle on which robots start [m]: level but for the roughness of ``rough_slope``."""
HOLE_DEPTH = 1.0
"""Of gaps and of holes between stones [m]: who falls in lands at less than 5 m/s."""
ROUGHNESS, ROUGHNESS_STEP, ROUGHNESS_SCALE = 0.05, 0.005, 0.2
"""Rough slopes: random heights either way, multiples of what, and distance between them [m]."""


@dataclass(frozen=True)
class Grid:
    """The samples of a square tile; those of its edge belong to it on all sides."""

    cells: int  # between the samples of a side
    scale: float  # distance of neighbouring samples [m]

    def length(self, metres: float) -> int:
        """Return how many cells a length is, at least one."""
        return max(round(metres / self.scale), 1)

    def flat(self) -> np.ndarray:
        """Return heights of 0. Shape: (cells + 1, cells + 1), along x and y."""
        return np.zeros((self.cells + 1, self.cells + 1))

    def offsets(self) -> np.ndarray:
        """Return distances of samples from the middle, along one axis [m]. Shape: (cells + 1,)."""
        return (np.arange(self.cells + 1) - self.cells / 2) * self.scale

    def ring(self) -> np.ndarray:
        """Return half the side of the square around the middle on which each sample is [m]. Shape: as heights."""
        distances = np.abs(self.offsets())
        return np.maximum(distances[:, None], distances)

    def is_within(self, side: float) -> np.ndarray:
        """Return which samples are on a square in the middle, by its side [m]. Shape: as heights."""
        return self.ring() <= 0.5 * side + 1e-6 * self.scale


TileFunction = Callable[[float, np.random.Generator, Grid], np.ndarray]
"""From difficulty, random numbers and samples to heights [m] of shape (cells + 1, cells + 1), along x and y."""


def flat(difficulty: float, rng: np.random.Generator, grid: Grid) -> np.ndarray:
    """Return level ground at height 0."""
    return grid.flat()


def smooth_slope_up(difficulty: float, rng: np.random.Generator, grid: Grid) -> np.ndarray:
    """Return a hollow with sides of a slope of 0.4 at most, and a platform of 3 m in it."""
    return -_pyramid(0.4 * difficulty, grid)


def smooth_slope_down(difficulty: float, rng: np.random.Generator, grid: Grid) -> np.ndarray:
    """Return a hill with sides of a slope of 0.4 at most, and a platform of 3 m on it."""
    return _pyramid(0.4 * difficulty, grid)


def rough_slope(difficulty: float, rng: np.random.Generator, grid: Grid) -> np.ndarray:
    """Return such a hill with random heights of 0.05 m either way on all of it, linear between points 0.2 m apart."""
    count = round(grid.cells * grid.scale / ROUGHNESS_SCALE) + 1
    steps = round(ROUGHNESS / ROUGHNESS_STEP)
    coarse = ROUGHNESS_STEP * rng.integers(-steps, steps, (count, count), endpoint=True)
    coarse_places, places = np.linspace(0.0, 1.0, count), np.linspace(0.0, 1.0, grid.cells + 1)
    along_x = np.stack([np.interp(places, coarse_places, column) for column in coarse.T], axis=1)
    return _pyramid(0.4 * difficulty, grid) + np.stack([np.interp(places, coarse_places, row) for row in along_x])


def stairs_up(difficulty: float, rng: np.random.Generator, grid: Grid) -> np.ndarray:
    """Return a hollow with stairs: treads of 0.31 m, steps of 0.05 to 0.23 m, a platform of about 3 m."""
    return -_stairs(0.05 + 0.18 * difficulty, grid)


def stairs_down(difficulty: float, rng: np.random.Generator, grid: Grid) -> np.ndarray:
    """Return a hill with the same stairs."""
    return _stairs(0.05 + 0.18 * difficulty, grid)


def discrete_obstacles(difficulty: float, rng: np.random.Generator, grid: Grid) -> np.ndarray:
    """Return 20 rectangles with sides of 1 to 2 m, all or half of 0.05 to 0.25 m high or low; a platform of 3 m."""
    heights = grid.flat()
    levels = (0.05 + 0.2 * difficulty) * np.array([-1.0, -0.5, 0.5, 1.0])
    for _ in range(20):
        sides = rng.integers(grid.length(1.0), grid.length(2.0), 2, endpoint=True)
        x, y = rng.integers(0, grid.cells - sides, endpoint=True)
        heights[x : x + sides[0] + 1, y : y + sides[1] + 1] = rng.choice(levels)
    return np.where(grid.is_within(3.0), 0.0, heights)


def waves(difficulty: float, rng: np.random.Generator, grid: Grid) -> np.ndarray:
    """Return waves of 2 m along x and y with crests of up to 0.3 m, which grow out of the platform."""
    angles = np.pi * grid.offsets()
    height = 0.15 * difficulty * (np.sin(angles)[:, None] + np.cos(angles))
    return height * (grid.ring() - 0.5 * START_SIZE).clip(0.0, 1.0)


def stepping_stones(difficulty: float, rng: np.random.Generator, grid: Grid) -> np.ndarray:
    """Return rows of square stones, of 1.58 to 0.08 m, with holes of 0.1 m, at first 0.05 m; a platform of 4 m."""
    heights = np.full_like(grid.flat(), -HOLE_DEPTH)
    side, hole = grid.length(1.5 * (1.05 - difficulty)), grid.length(0.05 if difficulty == 0.0 else 0.1)
    for y in range(0, grid.cells + 1, side + hole):
        in_row = (np.arange(grid.cells + 1) + rng.integers(side + hole)) % (side + hole) < side
        heights[in_row, y : y + side] = 0.0
    return np.where(grid.is_within(4.0), 0.0, heights)


def gaps(difficulty: float, rng: np.random.Generator, grid: Grid) -> np.ndarray:
    """Return a platform of 3 m with a trench of up to 1 m around it."""
    is_trench = grid.is_within(3.0 + 2.0 * difficulty) & ~grid.is_within(3.0)
    return np.where(is_trench, -HOLE_DEPTH, 0.0)


def pits(difficulty: float, rng: np.random.Generator, grid: Grid) -> np.ndarray:
    """Return a hole of 4 m, up to 1 m deep, out of which robots have to get."""
    return np.where(grid.is_within(4.0), -difficulty, 0.0)


_ALL = [flat, smooth_slope_up, smooth_slope_down, rough_slope, stairs_up, stairs_down]
_ALL += [discrete_obstacles, waves, stepping_stones, gaps, pits]
TILES: dict[str, TileFunction] = {function.__name__: function for function in _ALL}
"""Kinds of tiles by name."""


def _pyramid(slope: float, grid: Grid) -> np.ndarray:
    """Return a hill with this slope in the middle of its sides, cut off where a platform of 3 m fits on it."""
    half = 0.5 * grid.cells * grid.scale
    along = 1.0 - np.abs(grid.offsets()) / half
    top = (1.0 - 1.5 / half) ** 2
    return slope * half * np.minimum(along[:, None] * along, top)


def _stairs(height: float, grid: Grid) -> np.ndarray:
    """Return a hill with steps of this height, until what is left in the middle is not larger than 3 m."""
    tread, platform = grid.length(0.31), grid.length(3.0)
    count = -(-(grid.cells - platform) // (2 * tread))
    index = np.arange(grid.cells + 1)
    to_edge = np.minimum(index, index[::-1])
    steps = np.minimum(to_edge[:, None], to_edge) // tread
    return height * np.minimum(steps, count)
