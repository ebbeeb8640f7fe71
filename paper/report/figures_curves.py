"""Metrics over steps of training: the paper's Figures 3 and 5, and learning curves of single trainings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from legged_torque.paper.plotting import load_pyplot
from legged_torque.paper.report.evaluations import CURVE_METRICS, LEVEL, MILLION, read_curves
from legged_torque.paper.report.experiment import LAST_SHARE, Experiment
from legged_torque.paper.report.style import in_words, name_of, style
from legged_torque.paper.values import ENVIRONMENTS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STEPS_LABEL = "environment steps [millions]"
FEW = 0.1  # million steps, below which single steps are counted
SINGLE_CURVES = ("track_percentage", "track_xy", "cost_of_transport")  # metrics shown for single trainings
SEED_LINES = ("-.", "-", "--", ":")  # line styles of single trainings, by seed modulo four
LABELS = {metric.name: metric.label for metric in (*CURVE_METRICS, LEVEL)}
HEADROOM = 1.06  # of a linear axis, so that curves do not touch the frame
STRIP = 0.03  # width of a task's place in the strip of single seeds, as a share of the axis
SEED_MARK: dict[str, Any] = {"marker": "o", "markersize": 4.0, "markeredgecolor": "white", "markeredgewidth": 0.6}


def draw_single_curves(files: list[Path]) -> Figure:
    """Draw learning curves that files hold, a panel per metric; a UserError if a file holds none."""
    tables = [read_curves(file).assign(file=str(file)) for file in files]
    trainings = pd.concat(tables).groupby(["file", "task", "environment", "seed"], sort=False)
    tasks = sorted({task for _, task, _, _ in trainings.groups})
    figure, axes = load_pyplot().subplots(1, len(SINGLE_CURVES), figsize=(15, 4.5), layout="constrained")
    for axis, metric in zip(axes, SINGLE_CURVES, strict=True):
        for (_, task, environment, seed), rows in trainings:
            label = ", ".join(filter(None, [name_of(task), environment, f"seed {seed}"]))
            color, line = style(tasks, task)[0], SEED_LINES[seed % len(SEED_LINES)]
            draw_curve(axis, seed_curves({seed: rows}, metric), [], label, color, line)
        axis.set(title=LABELS[metric], xlabel=STEPS_LABEL, xlim=(0, None), ylim=(0, None))
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize="small")
    return figure


def draw_curves(experiment: Experiment, metric: str, *, scale: str = "linear", window: float = 0.0) -> Figure | None:
    """Draw a metric of an experiment over its trainings, a panel per environment; return None without data.

    Args:
        experiment: The results.
        metric: Name of the metric.
        scale: Scale of the axis of the metric, "linear" or "log".
        window: Width of a running median as a share of the longest training; 0 for none.
    """
    tasks, panels = experiment.plan.tasks, curves_of(experiment, metric)
    if not panels:
        return None
    width = max(7.0, 5.0 * len(panels))
    grid = {"figsize": (width, 5.2), "sharey": True, "squeeze": False, "layout": "constrained"}
    figure, axes = load_pyplot().subplots(1, len(panels), **grid)
    end = max(curves.index[-1] for panel in panels.values() for curves in panel.values())
    for axis, (environment, panel) in zip(axes[0], panels.items(), strict=True):
        axis.set_yscale(scale)  # before lines are drawn, whose means depend on it
        for task, curves in panel.items():
            color, line, _ = style(tasks, task)
            shown = smoothed(curves, window * end) if window else curves
            runs = experiment.runs_of(task, environment)
            unfinished = [run.cell.seed for run in runs if run.cell.seed in curves and not run.is_finished(run.steps)]
            draw_curve(axis, shown, unfinished, name_of(task), color, line)
            ends = [end_value(values.dropna()) for _, values in shown.items()]
            place = end * (1.0 + STRIP * (1 + tasks.index(task)))
            axis.plot([place] * len(ends), ends, color=color, linestyle="none", zorder=5, **SEED_MARK)
        axis.axvline(end * (1.0 + STRIP / 2), color="#999999", linewidth=0.8)
        axis.set_xlim(0, end * (1.0 + STRIP * (len(tasks) + 0.7)))
        axis.set_xticks([tick for tick in axis.get_xticks() if 0 <= tick <= end])
        if end < FEW:
            axis.xaxis.set_major_formatter(lambda steps, _: f"{steps * MILLION:,.0f}")
        axis.set_xlabel("environment steps" if end < FEW else STEPS_LABEL)
        axis.set_title(ENVIRONMENTS.get(environment, in_words(environment)))
        axis.grid(alpha=0.3)
    if scale == "linear":
        axes[0, 0].set_ylim(0, HEADROOM * axes[0, 0].get_ylim()[1])
    else:
        axes[0, 0].yaxis.set_major_formatter("{x:g}")  # powers would be written in TeX
    axes[0, 0].set_ylabel(LABELS[metric])
    lines = {line.get_label(): line for axis in axes[0] for line in axis.lines if line.get_label()[0] != "_"}
    columns = int(width / 3.3)  # as wide as the longest names
    figure.legend(lines.values(), lines, loc="outside lower center", ncols=columns, handlelength=3.5, frameon=False)
    return figure


def curves_of(experiment: Experiment, metric: str) -> dict[str, dict[str, pd.DataFrame]]:
    """Return the curves by environment, those of Table I first, and task; entries without data are left out."""
    panels: dict[str, dict[str, pd.DataFrame]] = {}
    order = [*ENVIRONMENTS, *experiment.plan.environments]
    for environment in sorted(experiment.plan.environments, key=order.index):
        for task in experiment.plan.tasks:
            seeds = {run.cell.seed: run.rows for run in experiment.runs_of(task, environment)}
            curves = seed_curves(seeds, metric)
            if len(curves):
                panels.setdefault(environment, {})[task] = curves
    return panels


def seed_curves(seeds: dict[int, pd.DataFrame], metric: str) -> pd.DataFrame:
    """Return a metric over millions of steps, a column for each seed that has it, from the evaluations of seeds."""
    columns = {}
    for seed, rows in seeds.items():
        places = rows["steps"].astype(float) / MILLION
        columns[seed] = rows.set_axis(places)[metric].groupby(level=0).last()
    return pd.DataFrame(columns, dtype=float).dropna(how="all").dropna(how="all", axis=1)


def smoothed(curves: pd.DataFrame, window: float) -> pd.DataFrame:
    """Return running medians over evaluations that are at most half a window away."""
    times = curves.set_axis(pd.to_timedelta(curves.index, unit="s"))  # rolling windows of a width need times
    medians = times.rolling(pd.Timedelta(window, "s"), center=True, closed="both", min_periods=1).median()
    return medians.set_axis(curves.index).where(curves.notna())


def end_value(curve: pd.Series) -> float:
    """Return the mean over the last :data:`LAST_SHARE` of a training."""
    return curve[curve.index >= (1.0 - LAST_SHARE) * curve.index[-1]].mean()


def draw_curve(axis: Axes, curves: pd.DataFrame, unfinished: list[int], label: str, color: str, line: Any) -> None:
    """Draw the mean over seeds with its standard error, and a cross where an unfinished seed ends.

    A finished seed keeps its last value while others go on. On a logarithmic axis it is the geometric mean.
    """
    shown = curves.interpolate("index", limit_area="inside")
    finished = shown.columns.difference(unfinished)
    shown[finished] = shown[finished].ffill()
    is_log = axis.get_yscale() == "log"
    shown = np.log(shown.where(shown > 0.0)) if is_log else shown
    mean, error = shown.mean(axis=1), shown.sem(axis=1)
    middle, low, high = (np.exp(part) if is_log else part for part in (mean, mean - error, mean + error))
    axis.plot(middle, color=color, linestyle=line, linewidth=1.6, label=label)
    axis.fill_between(middle.index, low, high, color=color, alpha=0.2, linewidth=0)
    ends = middle.loc[[curves[seed].last_valid_index() for seed in unfinished]]
    axis.plot(ends, "x", color=color, markersize=7, markeredgewidth=1.8)
