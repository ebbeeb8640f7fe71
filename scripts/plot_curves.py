"""Draw learning curves (Figure 3): ``python scripts/plot_curves.py docs/learning/*.json --out curves.png``."""

from pathlib import Path

from legged_torque.utils.args import Parser
from legged_torque.utils.cli import run_script
from legged_torque.utils.plotting import load_pyplot, read_data, save_figure

PANELS = {
    "track_percentage": "tracking (1 is perfect)",
    "track_xy": "mean squared error of v_xy [m²/s²]",
    "cost_of_transport": "cost of transport",
}
COLORS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#000000",
    "#E69F00",
    "#56B4E9",
)  # told apart by colour-blind eyes
LINES = ("-", "--", ":", "-.")


def main() -> None:
    """Draw one panel per metric and one line per run."""
    parser = Parser(__doc__)
    parser.add_argument("files", type=Path, nargs="+", help="files that learning_curve.py has written")
    parser.add_argument("--out", type=Path, required=True, help="picture to write (png, svg, pdf)")
    args = parser.parse_args()
    pyplot = load_pyplot()
    runs = [read_data(file, {"task", "seed", "points"}, "learning_curve.py") for file in args.files]
    tasks = sorted({run["task"] for run in runs})
    figure, axes = pyplot.subplots(1, len(PANELS), figsize=(15, 4.5), layout="constrained")
    for axis, (metric, title) in zip(axes, PANELS.items(), strict=True):
        for run in runs:
            points = run["points"]
            axis.plot(
                [point["steps"] / 1e6 for point in points],
                [point[metric] for point in points],
                color=COLORS[tasks.index(run["task"]) % len(COLORS)],
                linestyle=LINES[(run["seed"] - 1) % len(LINES)],
                label=f"{run['task']}, seed {run['seed']}",
            )
        axis.set(title=title, xlabel="environment steps [millions]", xlim=(0, None), ylim=(0, None))
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize="small")
    save_figure(figure, args.out)


if __name__ == "__main__":
    run_script(main)
