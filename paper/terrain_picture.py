"""A picture of every kind of tile."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from legged_torque.paper.plotting import load_pyplot, save_figure
from legged_torque.terrain.colors import color_of
from legged_torque.terrain.tiles import TILES, Grid
from legged_torque.utils import cli
from legged_torque.utils.limits import Number, Share

_COLUMNS = 4
_REACH = (-4.0, 4.0)  # of a tile along each axis [m]


def plot_terrain() -> None:
    """Read the command line, and draw a tile of each kind."""
    parser = cli.Parser("Draw every kind of rough ground: ``python scripts/plot.py terrain --out tiles.png``.")
    parser.add_argument("--difficulty", type=float, default=0.8, help="from 0 to 1; default: %(default)s")
    parser.add_argument("--seed", type=int, default=1, help="of the random numbers; default: %(default)s")
    parser.add_argument("--out", type=Path, required=True, help="picture to write (png, svg, pdf)")
    args = parser.parse_args()
    cli.check_args(args, difficulty=Share, seed=Number)
    cli.check_output(args.out)
    draw_tiles(args.out, args.difficulty, args.seed)


def draw_tiles(file: Path, difficulty: float, seed: int) -> None:
    """Draw all kinds of tiles, 8 m wide, at one difficulty into a file; UserError if it cannot be written."""
    pyplot = load_pyplot()
    from matplotlib.colors import LightSource

    grid, light = Grid(160, 0.05), LightSource(azdeg=5.0, altdeg=-50.0)  # which shines from above on such a surface
    x, y = np.meshgrid(grid.offsets(), grid.offsets(), indexing="ij")
    rows = -(-len(TILES) // _COLUMNS)
    figure = pyplot.figure(figsize=(2.5 * _COLUMNS, 1.9 * rows), layout="constrained")
    for place, (name, function) in enumerate(TILES.items(), 1):
        heights = function(difficulty, np.random.default_rng(seed), grid)
        axis = figure.add_subplot(rows, _COLUMNS, place, projection="3d", proj_type="ortho", elev=35.0, azim=-135.0)
        color = [part / 255.0 for part in color_of(name)]
        axis.plot_surface(x, y, heights, rstride=1, cstride=1, color=color, lightsource=light, antialiased=False)
        axis.set_axis_off()
        axis.set_box_aspect((1.0, 1.0, 1.0), zoom=1.2)
        axis.set(xlim=_REACH, ylim=_REACH, zlim=_REACH)
        axis.set_title(name, y=0.88)
    save_figure(figure, file)
