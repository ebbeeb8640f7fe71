"""Draw every kind of rough ground: ``python scripts/plot_terrain.py --out tiles.png``."""

from pathlib import Path

from legged_torque.utils.args import Parser
from legged_torque.utils.cli import check_at_least, check_output, run_script, slow_imports
from legged_torque.utils.errors import UserError


def main() -> None:
    """Draw a tile of each kind."""
    parser = Parser(__doc__)
    parser.add_argument("--difficulty", type=float, default=0.8, help="from 0 to 1")
    parser.add_argument("--seed", type=int, default=1, help="of the random numbers")
    parser.add_argument("--out", type=Path, required=True, help="picture to write (png, svg, pdf)")
    args = parser.parse_args()
    if not 0.0 <= args.difficulty <= 1.0:
        raise UserError(f"--difficulty must be from 0 to 1, not {args.difficulty}")
    check_at_least(args, 0, "seed")
    check_output(args.out)
    with slow_imports():
        from legged_torque.terrain.picture import draw_tiles
    draw_tiles(args.out, args.difficulty, args.seed)


if __name__ == "__main__":
    run_script(main)
