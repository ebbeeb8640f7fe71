"""A picture of every kind of tile."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from legged_torque.terrain.colors import color_of
from legged_torque.terrain.tiles import TILES, Grid
from legged_torque.utils.cli import Parser, check_at_least, check_output
from legged_torque.utils.errors import UserError
from legged_torque.utils.plotting import load_pyplot, save_figure

_COLUMNS = 4
_SINE, _COSINE = np.sin(np.radians(35.0)), np.cos(np.radians(35.0))  # of the angle at which one looks down
_LIGHT = np.array([-0.66, -0.22, 0.72])  # where it comes from: walls that face the eye are of two shades


def plot_terrain() -> None:
    """Read the command line, and draw a tile of each kind."""
    parser = Parser("Draw every kind of rough ground: ``python scripts/plot.py terrain --out tiles.png``.")
    parser.add_argument("--difficulty", type=float, default=0.8, help="from 0 to 1; default: %(default)s")
    parser.add_argument("--seed", type=int, default=1, help="of the random numbers; default: %(default)s")
    parser.add_argument("--out", type=Path, required=True, help="picture to write (png, svg, pdf)")
    args = parser.parse_args()
    if not 0.0 <= args.difficulty <= 1.0:
        raise UserError(f"--difficulty must be from 0 to 1, not {args.difficulty}")
    check_at_least(args, 0, "seed")
    check_output(args.out)
    draw_tiles(args.out, args.difficulty, args.seed)


def draw_tiles(file: Path, difficulty: float, seed: int) -> None:
    """Draw all kinds of tiles, 8 m wide, at one difficulty into a file; UserError if it cannot be written."""
    pyplot = load_pyplot()
    from matplotlib.collections import PolyCollection

    grid = Grid(160, 0.05)
    rows = -(-len(TILES) // _COLUMNS)
    figure, axes = pyplot.subplots(rows, _COLUMNS, figsize=(2.5 * _COLUMNS, 1.9 * rows), layout="constrained")
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, (name, function) in zip(axes.flat, TILES.items(), strict=False):
        heights = function(difficulty, np.random.default_rng(seed), grid)
        quads, light = _project(heights, grid)
        depth = 1.0 + 0.2 * heights[:-1, :-1].clip(max=0.0).reshape(-1, 1)[::-1]  # what is deep is darker
        faces = (np.array(color_of(name)) / 255.0 * depth * light[:, None]).clip(0.0, 1.0)
        ahead, across = (quads[:, corner + 2] - quads[:, corner] for corner in (0, 1))
        is_seen = ahead[:, 0] * across[:, 1] > ahead[:, 1] * across[:, 0]  # not those that face away
        axis.add_collection(PolyCollection(list(quads[is_seen]), facecolors=faces[is_seen], antialiased=False))
        axis.set(title=name, xlim=(-5.8, 5.8), ylim=(-4.4, 4.4), aspect="equal")
    save_figure(figure, file)


def _project(heights: np.ndarray, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Return cells as seen from x = y = -infinity, the last first, and how bright they are.

    Shapes: (cells, 4, 2), (cells,).
    """
    x, y = np.meshgrid(grid.offsets(), grid.offsets(), indexing="ij")
    seen = np.stack([(x - y), (x + y) * _SINE + np.sqrt(2.0) * heights * _COSINE], axis=-1) / np.sqrt(2.0)
    quads = np.stack([seen[:-1, :-1], seen[1:, :-1], seen[1:, 1:], seen[:-1, 1:]], axis=2)
    rise_x, rise_y = np.diff(heights, axis=0)[:, :-1], np.diff(heights, axis=1)[:-1]
    normal = np.stack([-rise_x, -rise_y, np.full_like(rise_x, grid.scale)], axis=-1)
    light = (normal @ _LIGHT) / np.linalg.norm(normal, axis=-1) / _LIGHT[2]
    return quads.reshape(-1, 4, 2)[::-1], light.clip(0.25, 1.3).ravel()[::-1]
