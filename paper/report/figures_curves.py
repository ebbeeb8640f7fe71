"""Metrics over steps or time of training: the paper's Figures 3 and 5, and learning curves of single trainings."""

from __future__ import annotations

import math
import textwrap
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from legged_torque.paper.report.curves import CURVE_METRICS, LEVEL, MILLION, LearningCurve, Row
from legged_torque.paper.report.figures_style import Style, draw_seeds, name_of, style
from legged_torque.paper.report.results import LAST_SHARE, Experiment
from legged_torque.paper.values import ENVIRONMENTS
from legged_torque.utils.plotting import load_pyplot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AXES = {
    "steps": (MILLION, "environment steps [millions]", "e6 steps"),
    "seconds": (1.0, "time of training [s]", " s"),
}
"""What curves are drawn over: its unit, the label of its axis, and how notes call the unit."""
SINGLE_CURVES = ("track_percentage", "track_xy", "cost_of_transport")  # metrics that are shown of single trainings
SEED_LINES = ("-.", "-", "--", ":")  # line styles by seed modulo four, where single trainings are shown
METRICS_BY_NAME = {metric.name: metric for metric in (*CURVE_METRICS, LEVEL)}
STRIP = 0.03  # width of a task's place in the strip of single seeds, in lengths of the axis


@dataclass(frozen=True)
class CurveFigure:
    """What a figure of curves shows."""

    metric: str
    scale: str = "linear"  # of its axis
    over: str = "steps"  # one of AXES
    window: float = 0.0  # of a running median, as a share of the longest curve; 0: every evaluation as it is


@dataclass
class Curve:
    """The finite values of a metric of one training, and where they are drawn on the other axis. Shapes: (points,)."""

    places: np.ndarray  # in the unit of :data:`AXES`
    values: np.ndarray
    is_finished: bool = True

    def end_value(self) -> float:
        """Return the mean of the last :data:`LAST_SHARE` of the training."""
        return float(self.values[self.places >= (1.0 - LAST_SHARE) * self.places[-1]].mean())

    def smoothed(self, window: float) -> Curve:
        """Return the running median over places at most half a window away."""
        first = np.searchsorted(self.places, self.places - window / 2)
        last = np.searchsorted(self.places, self.places + window / 2, side="right")
        medians = [np.median(self.values[i:j]) for i, j in zip(first, last, strict=True)]
        return Curve(self.places, np.array(medians), self.is_finished)


def draw_single_curves(runs: list[LearningCurve]) -> Figure:
    """Draw a panel per metric with a line per training."""
    figure, axes = load_pyplot().subplots(1, len(SINGLE_CURVES), figsize=(15, 4.5), layout="constrained")
    tasks = sorted({run.task for run in runs})
    for axis, name in zip(axes, SINGLE_CURVES, strict=True):
        for run in runs:
            look = (style(tasks, run.task)[0], SEED_LINES[run.seed % len(SEED_LINES)], "")
            label = str(run).replace(run.task, name_of(run.task), 1)
            for curve in metric_curves(run.rows, name):
                draw_curve(axis, [curve], label, look)
        axis.set(title=METRICS_BY_NAME[name].label, xlabel=AXES["steps"][1], xlim=(0, None), ylim=(0, None))
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize="small")
    return figure


def draw_curves(experiment: Experiment, what: CurveFigure, title: str) -> Figure | None:
    """Draw a metric over steps or time of training, a panel per environment; return None without data."""
    panels = curves_of(experiment, what)
    if not panels:
        return None
    plan, width = experiment.plan, max(7.0, 5.0 * len(panels))
    grid = {"figsize": (width, 5.2), "sharey": True, "squeeze": False, "layout": "constrained"}
    figure, axes = load_pyplot().subplots(1, len(panels), **grid)
    end = max(curve.places[-1] for curves in panels.values() for seeds in curves.values() for curve in seeds)
    for axis, (environment, curves) in zip(axes[0], panels.items(), strict=True):
        axis.set_yscale(what.scale)  # before lines are drawn, whose means depend on it
        notes = []
        for task, seeds in curves.items():
            shown = [curve.smoothed(what.window * end) for curve in seeds] if what.window else seeds
            draw_curve(axis, shown, name_of(task), style(plan.tasks, task))
            place = end * (1.0 + STRIP * (1 + plan.tasks.index(task)))
            draw_seeds(axis, [place] * len(seeds), [each.end_value() for each in shown], style(plan.tasks, task)[0])
            note = progress_note(seeds, experiment.num_expected(task, environment), AXES[what.over][2])
            notes += [f"{name_of(task)}{note}"] if note else []
        axis.axvline(end * (1.0 + STRIP / 2), color="#999999", linewidth=0.8)
        axis.set_xlim(0, end * (1.0 + STRIP * (len(plan.tasks) + 0.7)))
        axis.set_xticks([tick for tick in axis.get_xticks() if 0 <= tick <= end])
        axis.set_xlabel("\n".join([AXES[what.over][1], *notes]))
        axis.set_title(ENVIRONMENTS.get(environment, environment))
        axis.grid(alpha=0.3)
    if what.scale == "linear":
        axes[0, 0].set_ylim(0, None)
    axes[0, 0].set_ylabel(METRICS_BY_NAME[what.metric].label)
    lines = {line.get_label(): line for axis in axes[0] for line in axis.lines if line.get_label()[0] != "_"}
    columns = legend_columns(list(lines), width)
    figure.legend(lines.values(), lines, loc="outside lower center", ncols=columns, handlelength=3.5, frameon=False)
    figure.suptitle(textwrap.fill(f"{title}: {caption(panels, what)}", int(12 * width)), fontsize=11)
    return figure


def legend_columns(labels: list[str], width: float) -> int:
    """Return into how many columns a legend fits below a figure of this width [inch]."""
    widths = [0.8 + 0.08 * len(label) for label in labels]  # of line, gaps and letters
    return len(labels) if sum(widths) <= width else max(1, int(width / max(widths)))


def curves_of(experiment: Experiment, what: CurveFigure) -> dict[str, dict[str, list[Curve]]]:
    """Return the curves of all seeds by environment, those of Table I first, and task; none where there are no data."""
    panels = {}
    order = [*ENVIRONMENTS, *experiment.plan.environments]
    for environment in sorted(experiment.plan.environments, key=order.index):
        curves: dict[str, list[Curve]] = {}
        for run in (run for task in experiment.plan.tasks for run in experiment.runs_of(task, environment)):
            for curve in metric_curves(run.rows, what.metric, what.over, run.is_finished(run.steps)):
                curves.setdefault(run.cell.task, []).append(curve)
        if curves:
            panels[environment] = curves
    return panels


def caption(panels: dict[str, dict[str, list[Curve]]], what: CurveFigure) -> str:
    """Return what the lines, bands and marks of a figure mean."""
    seeds = [curve for curves in panels.values() for some in curves.values() for curve in some]
    smooth = f" of running medians over {what.window:.0%} of the training" if what.window else ""
    text = (
        f"{'geometric ' if what.scale == 'log' else ''}mean over seeds{smooth}, band: one standard error to each side"
    )
    text += "; finished seeds keep their last value" if what.over == "seconds" else ""
    text += f"; points at the right: single seeds, mean of their last {LAST_SHARE:.0%}"
    return text if all(curve.is_finished for curve in seeds) else f"{text}; cross: a training that is not finished"


def metric_curves(rows: list[Row], name: str, over: str = "steps", is_finished: bool = True) -> list[Curve]:
    """Return the curve of a metric in the evaluations of a training; none without finite values."""
    points = [(row[over], row[name]) for row in rows if math.isfinite(row[over]) and math.isfinite(row[name])]
    if not points:
        return []
    places, values = np.array(points, dtype=float).T
    return [Curve(places / AXES[over][0], values, is_finished)]


def progress_note(seeds: list[Curve], num_expected: int, unit: str) -> str:
    """Return the addition to the name of an incomplete task; nothing if the task is complete."""
    if all(curve.is_finished for curve in seeds):
        return "" if len(seeds) == num_expected else f" ({len(seeds)} of {num_expected} seeds)"
    ends = sorted(curve.places[-1] for curve in seeds)
    texts = dict.fromkeys([f"{ends[0]:.3g}", f"{ends[-1]:.3g}"])
    return f" ({len(seeds)} of {num_expected} seeds, up to {'–'.join(texts)}{unit})"


def draw_curve(axis: Axes, seeds: list[Curve], label: str, styles: Style) -> None:
    """Draw the mean over the seeds with its standard error, and a cross where an unfinished training ends.

    A finished training keeps its last value while others go on. On a logarithmic axis it is the geometric mean.
    """
    color, line, _ = styles
    is_log = axis.get_yscale() == "log"
    on_axis = np.exp if is_log else np.asarray
    places = np.unique(np.concatenate([curve.places for curve in seeds]))
    ends = [curve.values[-1] if curve.is_finished else np.nan for curve in seeds]
    parts = zip(seeds, ends, strict=True)
    values = np.array([np.interp(places, each.places, each.values, left=np.nan, right=end) for each, end in parts])
    values = np.log(np.where(values > 0.0, values, np.nan)) if is_log else values
    count = np.isfinite(values).sum(axis=0)
    mean = np.nansum(values, axis=0) / count
    axis.plot(places, on_axis(mean), color=color, linestyle=line, linewidth=1.6, label=label)
    if len(seeds) > 1:
        error = np.sqrt(np.nansum((values - mean) ** 2, axis=0) / np.maximum(count - 1, 1) / count)
        error[count < 2] = np.nan
        axis.fill_between(places, on_axis(mean - error), on_axis(mean + error), color=color, alpha=0.2, linewidth=0)
    crosses = np.array([curve.places[-1] for curve in seeds if not curve.is_finished])
    axis.plot(crosses, on_axis(np.interp(crosses, places, mean)), "x", color=color, markersize=7, markeredgewidth=1.8)
