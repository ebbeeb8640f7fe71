"""Draw learning curves (Figure 3): ``python scripts/plot_curves.py CURVES.csv.gz --out curves.png``."""

from pathlib import Path

from legged_torque.paper.report.curves import read_curves
from legged_torque.paper.report.figures_curves import draw_single_curves
from legged_torque.utils.args import Parser
from legged_torque.utils.cli import check_output, run_script
from legged_torque.utils.plotting import save_figure


def main() -> None:
    """Draw one panel per metric and one line per training."""
    parser = Parser(__doc__)
    help_text = "JSON of evaluate.py --all_checkpoints, evaluations.csv of a run, or evaluations.csv.gz of a report"
    parser.add_argument("files", type=Path, nargs="+", help=help_text)
    parser.add_argument("--out", type=Path, required=True, help="figure to write (png, svg, pdf)")
    args = parser.parse_args()
    check_output(args.out)
    save_figure(draw_single_curves([curve for file in args.files for curve in read_curves(file)]), args.out)


if __name__ == "__main__":
    run_script(main)
