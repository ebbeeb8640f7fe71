"""Figures of ``scripts/plot.py`` on the paper's methods: learning curves, and reports on gravity pre-training."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from legged_torque.paper.plotting import load_pyplot, parse_figure, save_figure
from legged_torque.paper.report import check_extra
from legged_torque.utils.cli import slow_imports
from legged_torque.utils.errors import UserError
from legged_torque.utils.files import read_data

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BLUE, ORANGE = "#0072B2", "#D55E00"  # which colour-blind readers can tell apart


def plot_curves() -> None:
    """Draw a panel per metric and a line per training."""
    text = "Draw learning curves (Figure 3): ``python scripts/plot.py curves CURVES.csv.gz --out curves.png``."
    args = parse_figure(text, "files", "evaluations.csv of a run, or evaluations.csv.gz of a report", nargs="+")
    with slow_imports():
        check_extra()
        from legged_torque.paper.report.figures_curves import draw_single_curves
    save_figure(draw_single_curves(args.files), args.out)


def plot_pretraining() -> None:
    """Draw torques, residuals, learning and standing of a pre-training in four panels."""
    example = "python scripts/plot.py pretraining report.json --out pretraining.png"
    text = f"Draw a report on gravity pre-training: ``{example}``."
    args = parse_figure(text, "file", "report of pretrain_gravity.py --json")
    figure, axes = load_pyplot().subplots(1, 4, figsize=(17, 4), layout="constrained")
    report = read_data(args.file, {"histograms", "settings", "rms_error", "standing"}, "pretrain_gravity.py")
    try:
        _draw_histogram(axes[0], report, "mean_torque", "torques", "mean absolute torque [N m]")
        _draw_histogram(axes[1], report, "residual", "contact residuals", "wrench residual [weight]")
        _draw_learning(axes[2], report["rms_error"])
        _draw_standing(axes[3], report["standing"])
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise UserError(f"'{args.file}' is not a whole report of pretrain_gravity.py: {error!r}") from None
    save_figure(figure, args.out)


def _draw_histogram(axis: Axes, report: dict[str, Any], name: str, title: str, label: str) -> None:
    """Draw counts on a logarithmic axis, and the limit beyond which pairs are dropped."""
    histogram, limit = report["histograms"][name], report["settings"][f"max_{name}"]
    axis.stairs(histogram["counts"], histogram["edges"], fill=True, color=BLUE)
    axis.axvline(limit, color=ORANGE, linestyle="--", label=f"dropped beyond {limit:g}")
    axis.set(title=title, xlabel=label, ylabel="pairs", yscale="log")
    axis.legend()


def _draw_learning(axis: Axes, errors: dict[str, Sequence[float]]) -> None:
    """Draw root mean square errors in training and on held out pairs over epochs."""
    for (name, values), color, line in zip(errors.items(), (BLUE, ORANGE), ("-", "--"), strict=True):
        axis.plot(range(1, len(values) + 1), values, line, color=color, label=name.replace("_", " "))
    axis.set(title="learned torques", xlabel="epoch", ylabel="root mean square error [N m]", ylim=(0, None))
    axis.legend()


def _draw_standing(axis: Axes, shares: dict[str, float]) -> None:
    """Draw how many worlds of controller and policy stand."""
    bars = axis.bar(list(shares), [100 * share for share in shares.values()], color=[ORANGE, BLUE], width=0.6)
    axis.bar_label(bars, fmt="%.1f %%")
    axis.set(title="standing after 5 s", ylabel="worlds [%]", ylim=(0, 110))
