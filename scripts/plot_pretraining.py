"""Draw a report on gravity pre-training: ``python scripts/plot_pretraining.py report.json --out pretraining.png``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from legged_torque.utils.args import Parser
from legged_torque.utils.cli import run_script
from legged_torque.utils.errors import UserError
from legged_torque.utils.plotting import load_pyplot, read_data, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BLUE, ORANGE = "#0072B2", "#D55E00"  # colour-blind readers can tell them apart
PARTS = {"histograms", "settings", "rms_error", "standing"}


def main() -> None:
    """Read the report and draw it."""
    parser = Parser(__doc__)
    parser.add_argument("file", type=Path, help="report of pretrain_gravity.py --json")
    parser.add_argument("--out", type=Path, required=True, help="figure to write (png, svg, pdf)")
    args = parser.parse_args()
    pyplot = load_pyplot()
    report = read_data(args.file, PARTS, "pretrain_gravity.py")
    figure, axes = pyplot.subplots(1, 4, figsize=(17, 4), layout="constrained")
    try:
        draw(axes, report)
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise UserError(f"'{args.file}' is not a whole report of pretrain_gravity.py: {error!r}") from None
    save_figure(figure, args.out)


def draw(axes: Sequence[Axes], report: dict[str, Any]) -> None:
    """Draw four panels: torques, residuals, learning and standing."""
    settings = report["settings"]
    draw_histogram(axes[0], report["histograms"]["mean_torque"], settings["max_mean_torque"])
    axes[0].set(title="torques", xlabel="mean absolute torque [N m]", ylabel="pairs")
    draw_histogram(axes[1], report["histograms"]["residual"], settings["max_residual"])
    axes[1].set(title="contact residuals", xlabel="wrench residual [weight]", ylabel="pairs")
    draw_errors(axes[2], report["rms_error"])
    names = list(report["standing"])
    bars = axes[3].bar(names, [100 * report["standing"][name] for name in names], color=[ORANGE, BLUE], width=0.6)
    axes[3].bar_label(bars, fmt="%.1f %%")
    axes[3].set(title="standing after 5 s", ylabel="worlds [%]", ylim=(0, 110))


def draw_histogram(axis: Axes, histogram: dict[str, list[float]], limit: float) -> None:
    """Draw counts on a logarithmic axis, and the limit beyond which pairs are dropped."""
    axis.stairs(histogram["counts"], histogram["edges"], fill=True, color=BLUE)
    axis.axvline(limit, color=ORANGE, linestyle="--", label=f"dropped beyond {limit:g}")
    axis.set_yscale("log")
    axis.legend()


def draw_errors(axis: Axes, errors: dict[str, list[float]]) -> None:
    """Draw the error of the learned torques by epoch."""
    for (name, values), color, line in zip(errors.items(), (BLUE, ORANGE), ("-", "--"), strict=True):
        axis.plot(range(1, len(values) + 1), values, line, color=color, label=name.replace("_", " "))
    axis.set(title="learned torques", xlabel="epoch", ylabel="root mean square error [N m]", ylim=(0, None))
    axis.legend()


if __name__ == "__main__":
    run_script(main)
