"""The paper's Figures 3, 5, 6 and 7, drawn from your own experiment, and learning curves of single trainings.

A task has the same colour, line style and hatch in all figures, so that they can be read in grey too.
"""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from legged_torque.experiments.curves import CURVE_METRICS, LEVEL, MILLION, LearningCurve, Row
from legged_torque.experiments.grounds import by_level, kinds_of
from legged_torque.experiments.matrix import Matrix
from legged_torque.experiments.paper_values import (
    ENVIRONMENTS,
    MODELS,
    PAPER_METRICS,
    paper_value,
    task_on_plane,
)
from legged_torque.experiments.results import Cells, Experiment, Summary, Table
from legged_torque.utils.metrics import Metric
from legged_torque.utils.plotting import load_pyplot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STYLES = {  # colours of Okabe and Ito, which colour-blind readers can tell apart; close to those of the paper
    "a1_position": ("#0072B2", "-", ""),
    "a1_torque": ("#009E73", ":", "..."),
    "a1_torque_gravity": ("#56B4E9", (0, (1, 1, 3, 1)), "xxx"),
    "a1_torque_curriculum": ("#E69F00", "--", "///"),
    "a1_torque_multihead": ("#D55E00", "-.", "\\\\\\"),
    "a1_multihead": ("#CC79A7", (0, (6, 1, 1, 1, 1, 1)), "---"),
}
"""Colour, line style and hatch of each task."""
OTHER_STYLES = (
    ("#777777", "-", "++"),
    ("#999933", "-.", "**"),
    ("#882255", "--", "oo"),
    ("#44AA99", (0, (4, 2, 1, 2)), "||"),
    ("#332288", (0, (8, 2)), "OO"),
    ("#000000", ":", "+++"),
)
"""Those of tasks that the paper does not have, in the order of the plan."""
SEED_LINES = ("-.", "-", "--", ":")  # line styles by seed modulo four, where single trainings are shown
CURVES = {
    "Figure 3": ("track_percentage", "linear", "steps"),
    "Figure 3 over seconds": ("track_percentage", "linear", "seconds"),
    "Figure 5a": ("height", "linear", "steps"),
    "Figure 5b": ("critic_gradient_norm", "log", "steps"),
}
"""Metric, scale of its axis, and what it is drawn over, by title."""
ROUGH_CURVES = {"Levels": (LEVEL.name, "linear", "steps")}
"""Those on rough ground."""
AXES = {
    "steps": (MILLION, "environment steps [millions]", "e6 steps"),
    "seconds": (1.0, "time of training [s]", " s"),
}
"""What curves are drawn over: its unit, the label of its axis, and how notes call the unit."""
BARS = {"Figure 6": ("low", "high"), "Figure 7": ("high_frequency", "doubled")}  # columns of Table I, by title
FIGURES = (*CURVES, *BARS)
SINGLE_CURVES = ("track_percentage", "track_xy", "cost_of_transport")  # metrics that are shown of single trainings
METRICS_BY_NAME = {metric.name: metric for metric in (*CURVE_METRICS, LEVEL)}
MARKERS = ("o", "s", "^", "D", "v", "P")  # of approaches, where lines are many
UNFINISHED_ALPHA = 0.45
CUT_AT = 3.0  # largest height of a panel of bars, in medians of the values that it shows
PAPER_MARKER: dict[str, Any] = {"marker": "D", "color": "none", "markerfacecolor": "white", "markeredgecolor": "black"}
COLOURS = 96  # of a PNG
SETTINGS = {"font.size": 10, "hatch.linewidth": 0.6, "axes.axisbelow": True, "savefig.dpi": 150}

Style = tuple[str, Any, str]  # colour, line style and hatch


@dataclass
class Curve:
    """The finite values of a metric of one training, and where they are drawn on the other axis. Shapes: (points,)."""

    places: np.ndarray  # in the unit of :data:`AXES`
    values: np.ndarray
    is_finished: bool = True


def file_name(title: str) -> str:
    """Return the name of a figure's file."""
    return f"{title.lower().replace(' ', '')}.png"


def draw_all(experiment: Experiment, table: Table, out: Path) -> list[str]:
    """Draw every figure that there are data for, as PNG, and return their titles; UserError without matplotlib."""
    pyplot, drawn = load_pyplot(), []
    with pyplot.rc_context(SETTINGS):
        for title in (*FIGURES, *rough_figures(experiment.plan)):
            figure = draw(experiment, table, title)
            if figure is not None:
                save_small(figure, out / file_name(title))
                pyplot.close(figure)
                drawn.append(title)
    return drawn


def rough_figures(plan: Matrix) -> list[str]:
    """Return the titles of figures on rough ground: levels, and a figure of success per environment of training."""
    return [*ROUGH_CURVES, *success_titles(plan)] if plan.grounds else []


def success_titles(plan: Matrix) -> dict[str, str]:
    """Return the environments of training by the titles of their figures of success."""
    return {f"Success in {name}": name for name in plan.environments}


def draw(experiment: Experiment, table: Table, title: str) -> Figure | None:
    """Draw the figure with a title; return None without data."""
    if title in BARS:
        return draw_bars(experiment, table, title)
    if title in CURVES or title in ROUGH_CURVES:
        return draw_curves(experiment, title)
    return draw_success(experiment, success_titles(experiment.plan)[title])


def save_small(figure: Figure, file: Path) -> None:
    """Write a figure as a PNG of few colours, a third of the usual size."""
    from PIL import Image  # matplotlib needs it too

    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    Image.open(stream).convert("RGB").quantize(COLOURS).save(file, optimize=True)


def style(tasks: Sequence[str], task: str) -> Style:
    """Return the style of one of the tasks in a figure: on rough ground solid, or dashed with the height scan."""
    plain = task_on_plane(task)
    others = list(dict.fromkeys(name for name in map(task_on_plane, tasks) if name not in STYLES))
    color, line, hatch = STYLES[plain] if plain in STYLES else OTHER_STYLES[others.index(plain) % len(OTHER_STYLES)]
    if task == plain:
        return color, line, hatch
    return (color, "--", 2 * hatch or "oo") if task.endswith("_scan") else (color, "-", hatch)


def draw_single_curves(runs: list[LearningCurve]) -> Figure:
    """Draw a panel per metric with a line per training."""
    figure, axes = load_pyplot().subplots(1, len(SINGLE_CURVES), figsize=(15, 4.5), layout="constrained")
    tasks = sorted({run.task for run in runs})
    for axis, name in zip(axes, SINGLE_CURVES, strict=True):
        for run in runs:
            color, _, hatch = style(tasks, run.task)
            for curve in metric_curves(run.rows, name):
                draw_curve(axis, [curve], str(run), (color, SEED_LINES[run.seed % len(SEED_LINES)], hatch))
        axis.set(title=METRICS_BY_NAME[name].label, xlabel=AXES["steps"][1], xlim=(0, None), ylim=(0, None))
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize="small")
    return figure


def draw_curves(experiment: Experiment, title: str) -> Figure | None:
    """Draw a metric over steps or time of training, a panel per environment; return None without data."""
    name, scale, over = (CURVES | ROUGH_CURVES)[title]
    unit, label_over, note = AXES[over]
    plan, panels = experiment.plan, {}
    order = [*ENVIRONMENTS, *plan.environments]  # those of Table I first
    for environment in sorted(plan.environments, key=order.index):
        curves: dict[str, list[Curve]] = {}
        for run in (run for task in plan.tasks for run in experiment.runs_of(task, environment)):
            for curve in metric_curves(run.rows, name, over, run.is_finished(run.steps)):
                curves.setdefault(run.cell.task, []).append(curve)
        if curves:
            panels[environment] = curves
    if not panels:
        return None
    width = max(7.0, 5.5 * len(panels))
    grid = {"figsize": (width, 5.6), "sharey": True, "squeeze": False, "layout": "constrained"}
    figure, axes = load_pyplot().subplots(1, len(panels), **grid)
    end = 1.02 * max(run.total_steps for run in experiment.runs) / unit if over == "steps" else None
    for axis, (environment, curves) in zip(axes[0], panels.items(), strict=True):
        for task, seeds in curves.items():
            label = f"{MODELS.get(task, task)}{progress_note(seeds, len(plan.seeds), note)}"
            draw_curve(axis, seeds, label, style(plan.tasks, task))
        axis.set(xlabel=label_over, xlim=(0, end), yscale=scale)
        axis.set_title(ENVIRONMENTS.get(environment, environment))
        axis.grid(alpha=0.3)
        # below the axis: labels of unfinished curves are long and would hide others
        axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), fontsize=9, handlelength=4, frameon=False)
    if scale == "linear":
        axes[0, 0].set_ylim(0, None)
    axes[0, 0].set_ylabel(METRICS_BY_NAME[name].label)
    text = "mean over seeds, with a band of one standard error to each side"
    if not all(curve.is_finished for curves in panels.values() for seeds in curves.values() for curve in seeds):
        text += "; cross: a training that is not finished"
    figure.suptitle(textwrap.fill(f"{title}: {text}", int(12 * width)), fontsize=11)
    return figure


def metric_curves(rows: list[Row], name: str, over: str = "steps", is_finished: bool = True) -> list[Curve]:
    """Return the curve of a metric in the evaluations of a training; none without finite values."""
    points = [(row[over], row[name]) for row in rows if math.isfinite(row[over]) and math.isfinite(row[name])]
    if not points:
        return []
    places, values = np.array(points, dtype=float).T
    return [Curve(places / AXES[over][0], values, is_finished)]


def progress_note(seeds: list[Curve], num_planned: int, unit: str) -> str:
    """Return the addition to the label of an incomplete task; nothing if the task is complete."""
    if all(curve.is_finished for curve in seeds):
        return "" if len(seeds) == num_planned else f" ({len(seeds)} of {num_planned} seeds)"
    ends = sorted(curve.places[-1] for curve in seeds)
    texts = dict.fromkeys([f"{ends[0]:.3g}", f"{ends[-1]:.3g}"])
    return f" ({len(seeds)} of {num_planned} seeds, up to {'–'.join(texts)}{unit})"


def draw_curve(axis: Axes, seeds: list[Curve], label: str, styles: Style) -> None:
    """Draw the mean over the seeds with its standard error, and a cross where an unfinished training ends."""
    color, line, _ = styles
    places = np.unique(np.concatenate([curve.places for curve in seeds]))
    values = np.array([np.interp(places, curve.places, curve.values, left=np.nan, right=np.nan) for curve in seeds])
    count = np.isfinite(values).sum(axis=0)
    mean = np.nansum(values, axis=0) / count
    axis.plot(places, mean, color=color, linestyle=line, linewidth=1.6, label=label)
    if len(seeds) > 1:
        error = np.sqrt(np.nansum((values - mean) ** 2, axis=0) / np.maximum(count - 1, 1) / count)
        error[count < 2] = np.nan
        axis.fill_between(places, mean - error, mean + error, color=color, alpha=0.2, linewidth=0)
    ends = np.array([curve.places[-1] for curve in seeds if not curve.is_finished])
    axis.plot(ends, np.interp(ends, places, mean), "x", color=color, markersize=7, markeredgewidth=1.8)


def draw_success(experiment: Experiment, environment: str) -> Figure | None:
    """Draw the share of robots that cross tiles over difficulty, for each kind and all; return None without data."""
    plan = experiment.plan
    approaches = list(dict.fromkeys(map(task_on_plane, plan.tasks)))
    by_task = {}
    for task in sorted(plan.tasks, key=lambda name: approaches.index(task_on_plane(name))):
        by_task[task] = [run.crossings for run in experiment.runs_of(task, environment) if run.crossings]
    kinds = kinds_of([each for seeds in by_task.values() for each in seeds])
    if not kinds:
        return None
    columns = min(4, len(kinds) + 1)
    rows = math.ceil((len(kinds) + 1) / columns)
    grid = {"figsize": (3.1 * columns, 2.3 * rows + 1.2), "sharex": True, "sharey": True, "squeeze": False}
    figure, axes = load_pyplot().subplots(rows, columns, layout="constrained", **grid)
    for axis, kind in zip(axes.flat, [*kinds, None], strict=False):
        for task, seeds in by_task.items():
            look = {"marker": MARKERS[approaches.index(task_on_plane(task)) % len(MARKERS)], "markersize": 3.5}
            draw_success_line(axis, plan, task, [by_level(each, "crossed", kind) for each in seeds], look)
        axis.set(title=kind.replace("_", " ") if kind else "mean of all kinds", ylim=(-0.04, 1.04))
        axis.grid(alpha=0.3)
    for axis in axes.flat[len(kinds) + 1 :]:
        axis.set_axis_off()
    for axis in axes[-1]:
        axis.set_xlabel("difficulty")
    for axis in axes[:, 0]:
        axis.set_ylabel("share that crosses")
    shown = axes.flat[0].get_legend_handles_labels()
    figure.legend(*shown, loc="outside lower center", ncols=columns, handlelength=4, frameon=False)
    text = "robots that cross a tile in time, mean over seeds with a band from the lowest to the highest"
    figure.suptitle(textwrap.fill(f"{ENVIRONMENTS.get(environment, environment)}: {text}", 40 * columns), fontsize=11)
    return figure


def draw_success_line(
    axis: Axes, plan: Matrix, task: str, seeds: list[dict[float, float]], look: dict[str, Any]
) -> None:
    """Draw the success of a task, given by difficulty for each seed; nothing without seeds."""
    levels = sorted(set[float]().union(*seeds))
    if not levels:
        return
    color, line, _ = style(plan.tasks, task)
    values = np.array([[seed.get(level, math.nan) for level in levels] for seed in seeds])
    note = "" if len(seeds) == len(plan.seeds) else f" ({len(seeds)} of {len(plan.seeds)} seeds)"
    look = look | {"color": color, "linestyle": line, "markerfacecolor": "white" if line == "--" else color}
    label = f"{MODELS.get(task, task)}{note}"
    axis.plot(levels, values.mean(axis=0), label=label, linewidth=1.5, **look)
    axis.fill_between(levels, values.min(axis=0), values.max(axis=0), color=color, alpha=0.12, linewidth=0)


def draw_bars(experiment: Experiment, table: Table, title: str) -> Figure | None:
    """Draw the metrics of Table I, a row of panels per column of the table; return None without data."""
    columns = [name for name in BARS[title] if any(table.get(name, {}).values())]
    if not columns:
        return None
    grid = {"figsize": (15.0, 3.6 * len(columns) + 0.9), "squeeze": False, "layout": "constrained"}
    figure, axes = load_pyplot().subplots(len(columns), len(PAPER_METRICS), **grid)
    for row, column in zip(axes, columns, strict=True):
        for axis, metric in zip(row, PAPER_METRICS, strict=True):
            draw_panel(axis, experiment.plan, table[column], column, metric)
        row[0].set_ylabel(ENVIRONMENTS[column])
    draw_legend(figure, experiment.plan)
    text = "means over seeds with standard errors; tracking: high is good, forces and cost: low is good"
    figure.suptitle(f"{title}: {text}", fontsize=11)
    return figure


def draw_panel(axis: Axes, plan: Matrix, cells: Cells, column: str, metric: Metric) -> None:
    """Draw a metric in a column of Table I. Bars far beyond the others are cut off, so that the others stay legible."""
    heights, papers, notes = [], [], []
    for place, task in enumerate(plan.tasks):
        summary, paper = cells[task].get(metric.name), paper_value(task, column, metric.name)
        if summary is None:
            heights.append(0.0)
            notes.append("no\ndata")
        else:
            heights.append(summary.mean)
            notes.append("" if summary.is_final else f"{len(summary.values)} of\n{len(plan.seeds)} *")
            draw_bar(axis, summary, metric.digits, style(plan.tasks, task), place)
        if paper is not None:  # beside the middle, where the error bar is
            papers.append(paper)
            axis.plot(place + 0.26, paper, markersize=5.5, markeredgewidth=1.4, zorder=5, **PAPER_MARKER)
    shown = [height for height in heights + papers if height > 0.0] or [1.0]
    top = min(1.12 * max(shown), CUT_AT * median(shown))
    notes = [f"{note}\ncut".strip() if height > top else note for note, height in zip(notes, heights, strict=True)]
    axis.set_xticks(range(len(notes)), notes, fontsize=8)
    axis.tick_params(axis="x", length=0)
    axis.set(title=metric.label, xlim=(-0.6, len(notes) - 0.4), ylim=(0, top))
    axis.grid(axis="y", alpha=0.3)


def draw_bar(axis: Axes, summary: Summary, digits: int, styles: Style, place: int) -> None:
    """Draw a bar with its error and its number; pale if it is not final."""
    color, _, hatch = styles
    mean, alpha = summary.mean, 1.0 if summary.is_final else UNFINISHED_ALPHA
    axis.bar(place, mean, width=0.8, color=color, hatch=hatch, edgecolor="black", linewidth=0.8, alpha=alpha)
    axis.errorbar(place, mean, yerr=summary.standard_error, color="black", capsize=5, linewidth=1.5, zorder=4)
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1.5}
    layout: dict[str, Any] = {"rotation": 90, "ha": "center", "va": "bottom", "fontsize": 9, "bbox": box}
    axis.text(place, 0.04, f"{mean:.{digits}f}", transform=axis.get_xaxis_transform(), **layout)


def draw_legend(figure: Figure, plan: Matrix) -> None:
    """Draw the legend of a figure of bars below it."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    bars = [(MODELS.get(task, task), *style(plan.tasks, task)) for task in plan.tasks]
    handles: list[Any] = [Patch(facecolor=c, hatch=h, edgecolor="black", label=label) for label, c, _, h in bars]
    handles.append(Line2D([], [], label="paper", **PAPER_MARKER))
    pale = f"pale, *: not all {len(plan.seeds)} seeds are there, or trainings are not finished"
    handles += [Patch(color="none", label=label) for label in (pale, "cut: far beyond the others")]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, handlelength=3, frameon=False)
