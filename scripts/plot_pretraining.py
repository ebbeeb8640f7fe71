"""Draw a report on gravity pre-training: ``python scripts/plot_pretraining.py report.json --out pretraining.png``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from legged_torque.utils.args import Parser
from legged_torque.utils.cli import check_output, run_script
from legged_torque.utils.errors import UserError
from legged_torque.utils.plotting import load_pyplot, read_data, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BLUE, ORANGE = "#0072B2", "#D55E00"  # colour-blind readers can tell them apart


def main() -> None:
    """Read the report and draw it."""
    parser = Parser(__doc__)
    parser.add_argument("file", type=Path, help="report of pretrain_gravity.py --json")
    parser.add_argument("--out", type=Path, required=True, help="figure to write (png, svg, pdf)")
    args = parser.parse_args()
    check_output(args.out)
    figure, axes = load_pyplot().subplots(1, 4, figsize=(17, 4), layout="constrained")
    report = read_data(args.file, {"histograms", "settings", "rms_error", "standing"}, "pretrain_gravity.py")
    try:
        draw(axes, report)
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise UserError(f"'{args.file}' is not a whole report of pretrain_gravity.py: {error!r}") from None
    save_figure(figure, args.out)


def draw(axes: Sequence[Axes], report: dict[str, Any]) -> None:
    """Draw four panels: torques, residuals, learning and standing."""
    draw_histogram(axes[0], report, "mean_torque", "torques", "mean absolute torque [N m]")
    draw_histogram(axes[1], report, "residual", "contact residuals", "wrench residual [weight]")
    errors, styles = report["rms_error"].items(), ((BLUE, "-"), (ORANGE, "--"))
    for (name, values), (color, line) in zip(errors, styles, strict=True):
        axes[2].plot(range(1, len(values) + 1), values, line, color=color, label=name.replace("_", " "))
    axes[2].set(title="learned torques", xlabel="epoch", ylabel="root mean square error [N m]", ylim=(0, None))
    axes[2].legend()
    shares = [100 * share for share in report["standing"].values()]
    bars = axes[3].bar(list(report["standing"]), shares, color=[ORANGE, BLUE], width=0.6)
    axes[3].bar_label(bars, fmt="%.1f %%")
    axes[3].set(title="standing after 5 s", ylabel="worlds [%]", ylim=(0, 110))


def draw_histogram(axis: Axes, report: dict[str, Any], name: str, title: str, label: str) -> None:
    """Draw counts on a logarithmic axis, and the limit beyond which pairs are dropped."""
    histogram, limit = report["histograms"][name], report["settings"][f"max_{name}"]
    axis.stairs(histogram["counts"], histogram["edges"], fill=True, color=BLUE)
    axis.axvline(limit, color=ORANGE, linestyle="--", label=f"dropped beyond {limit:g}")
    axis.set(title=title, xlabel=label, ylabel="pairs", yscale="log")
    axis.legend()


if __name__ == "__main__":
    run_script(main)
