"""The paper's Figures 3, 5, 6 and 7, from an experiment of one's own.

A task has the same colour, line style and hatch in all figures, so that they can be read in grey too.
"""

from __future__ import annotations

import math
import textwrap
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np

from legged_torque.experiments.paper_values import ENVIRONMENTS, METRICS, MODELS, paper_value
from legged_torque.experiments.report import Experiment, Run, Summary, Table
from legged_torque.utils.plotting import load_pyplot

STYLES = {  # colours of Okabe and Ito, which colour-blind eyes tell apart; near those of the paper
    "a1_position": ("#0072B2", "-", ""),
    "a1_torque": ("#009E73", ":", "..."),
    "a1_torque_gravity": ("#56B4E9", (0, (1, 1, 3, 1)), "xxx"),
    "a1_torque_curriculum": ("#E69F00", "--", "///"),
    "a1_torque_multihead": ("#D55E00", "-.", "\\\\\\"),
    "a1_multihead": ("#CC79A7", (0, (6, 1, 1, 1, 1, 1)), "---"),
}
OTHER_STYLES = (("#000000", "-", "++"), ("#777777", "--", "oo"), ("#999933", "-.", "**"))
CURVES = {
    "figure3": ("Figure 3", "track_percentage", "tracking (1 is perfect)", "linear"),
    "figure5a": ("Figure 5a", "height", "walking height [m]", "linear"),
    "figure5b": ("Figure 5b", "critic_gradient_norm", "gradient norm of the critic", "log"),
}
"""Title, metric, name of the axis and its scale, by name of the file."""
BARS = {"figure6": ("Figure 6", ("low", "high")), "figure7": ("Figure 7", ("high_frequency", "doubled"))}
"""Title and columns of Table I, by name of the file."""
BAND_ALPHA = 0.2
UNFINISHED_ALPHA = 0.45
CUT_AT = 3.0
"""Height of a panel of bars at most, in medians of what it shows."""
SETTINGS = {"font.size": 10, "hatch.linewidth": 0.6, "svg.hashsalt": "report", "axes.axisbelow": True}


@dataclass
class Curve:
    """A metric of one training.

    Attributes:
        steps: Steps of the evaluations with a finite value. Shape: (points,).
        values: The values. Shape: (points,).
        is_finished: Whether the training is.
    """

    steps: np.ndarray
    values: np.ndarray
    is_finished: bool


def draw_all(experiment: Experiment, table: Table, out: Path) -> list[str]:
    """Draw every figure that there is something to draw for, as PNG and SVG.

    Returns:
        The names of the files, without their endings.

    Raises:
        UserError: If matplotlib is missing.
    """
    pyplot = load_pyplot()
    figures = {}
    with pyplot.rc_context(SETTINGS):
        for name, settings in CURVES.items():
            figures[name] = draw_curves(pyplot, experiment, *settings)
        for name, settings in BARS.items():
            figures[name] = draw_bars(pyplot, experiment, table, *settings)
        for name, figure in figures.items():
            if figure is not None:
                figure.savefig(out / f"{name}.png", dpi=150)
                figure.savefig(out / f"{name}.svg", metadata={"Date": None})
                pyplot.close(figure)
    return [name for name, figure in figures.items() if figure is not None]


def style(experiment: Experiment, task: str) -> tuple[str, Any, str]:
    """Return colour, line style and hatch of a task."""
    if task in STYLES:
        return STYLES[task]
    others = [name for name in experiment.tasks if name not in STYLES]
    return OTHER_STYLES[others.index(task) % len(OTHER_STYLES)]


def draw_curves(pyplot: Any, experiment: Experiment, title: str, metric: str, label: str, scale: str) -> Any:
    """Draw a metric over the steps of training, a panel per environment; return None if there is nothing to draw."""
    panels = {}
    for environment in sorted(experiment.environments, key=environment_order):
        curves = {task: seed_curves(experiment.runs_of(task, environment), metric) for task in experiment.tasks}
        if any(curves.values()):
            panels[environment] = {task: seeds for task, seeds in curves.items() if seeds}
    if not panels:
        return None
    size = (max(7.0, 5.5 * len(panels)), 5.6)
    figure, axes = pyplot.subplots(1, len(panels), figsize=size, sharey=True, squeeze=False, layout="constrained")
    end = max(run.total_steps for run in experiment.runs.values()) / 1e6
    for axis, (environment, curves) in zip(axes[0], panels.items(), strict=True):
        for task, seeds in curves.items():
            text = f"{MODELS.get(task, task)}{progress_note(seeds, len(experiment.seeds))}"
            draw_curve(axis, seeds, text, style(experiment, task))
        axis.set(title=ENVIRONMENTS.get(environment, environment), xlabel="environment steps [millions]")
        axis.set(xlim=(0, 1.02 * end), yscale=scale)
        axis.grid(alpha=0.3)
        # below the axis: labels of unfinished curves are long and would hide others
        axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), fontsize=9, handlelength=4, frameon=False)
    if scale == "linear":
        axes[0, 0].set_ylim(0, None)
    axes[0, 0].set_ylabel(label)
    text = "mean over seeds, with a band of one standard error to each side"
    if not all(curve.is_finished for curves in panels.values() for seeds in curves.values() for curve in seeds):
        text += "; cross: a training that is not finished"
    figure.suptitle(textwrap.fill(f"{title}: {text}", int(12 * size[0])), fontsize=11)
    return figure


def environment_order(environment: str) -> int:
    """Return the place of an environment: those of Table I first, in its order."""
    names = list(ENVIRONMENTS)
    return names.index(environment) if environment in names else len(names)


def seed_curves(runs: list[Run], metric: str) -> list[Curve]:
    """Return the curve of each run that has a finite value."""
    curves = []
    for run in runs:
        points = [(row["steps"], row[metric]) for row in run.rows if math.isfinite(row[metric])]
        if points:
            steps, values = np.array(points, dtype=float).T
            curves.append(Curve(steps, values, run.is_finished(run.steps)))
    return curves


def progress_note(seeds: list[Curve], num_planned: int) -> str:
    """Return what a label says of a task that is not complete; nothing if it is."""
    if all(curve.is_finished for curve in seeds):
        return "" if len(seeds) == num_planned else f" ({len(seeds)} of {num_planned} seeds)"
    ends = sorted(curve.steps[-1] / 1e6 for curve in seeds)
    texts = dict.fromkeys([f"{ends[0]:.3g}", f"{ends[-1]:.3g}"])
    return f" ({len(seeds)} of {num_planned} seeds, up to {'–'.join(texts)}e6 steps)"


def draw_curve(axis: Any, seeds: list[Curve], label: str, styles: tuple[str, Any, str]) -> None:
    """Draw mean and standard error over the seeds that have come so far, and a cross where a training has to go on."""
    color, line, _ = styles
    steps = np.unique(np.concatenate([curve.steps for curve in seeds]))
    values = np.array([np.interp(steps, curve.steps, curve.values, left=np.nan, right=np.nan) for curve in seeds])
    count = np.isfinite(values).sum(axis=0)
    mean = np.nansum(values, axis=0) / count
    axis.plot(steps / 1e6, mean, color=color, linestyle=line, linewidth=1.6, label=label)
    if len(seeds) > 1:
        error = np.sqrt(np.nansum((values - mean) ** 2, axis=0) / np.maximum(count - 1, 1) / count)
        error[count < 2] = np.nan
        axis.fill_between(steps / 1e6, mean - error, mean + error, color=color, alpha=BAND_ALPHA, linewidth=0)
    ends = np.array([curve.steps[-1] for curve in seeds if not curve.is_finished])
    axis.plot(ends / 1e6, np.interp(ends, steps, mean), "x", color=color, markersize=7, markeredgewidth=1.8)


def draw_bars(pyplot: Any, experiment: Experiment, table: Table, title: str, columns: tuple[str, ...]) -> Any:
    """Draw the metrics of Table I, a row per column of it; return None if there is nothing to draw."""
    columns = tuple(name for name in columns if any(table.get(name, {}).values()))
    if not columns:
        return None
    size = (15.0, 3.6 * len(columns) + 0.9)
    figure, axes = pyplot.subplots(len(columns), len(METRICS), figsize=size, squeeze=False, layout="constrained")
    for row, column in zip(axes, columns, strict=True):
        for axis, metric in zip(row, METRICS, strict=True):
            draw_panel(axis, experiment, table, column, metric)
        row[0].set_ylabel(ENVIRONMENTS[column])
    draw_legend(figure, experiment)
    text = "means over seeds with standard errors; tracking: high is good, forces and cost: low is good"
    figure.suptitle(f"{title}: {text}", fontsize=11)
    return figure


def draw_panel(axis: Any, experiment: Experiment, table: Table, column: str, metric: str) -> None:
    """Draw a metric in a column of Table I. What is far beyond all others is cut off, so that these can be read."""
    heights, papers, notes = [], [], []
    for place, task in enumerate(experiment.tasks):
        summary, paper = table[column].get(task, {}).get(metric), paper_value(task, column, metric)
        notes.append(progress_of_bar(summary, len(experiment.seeds)))
        heights.append(fmean(summary.values) if summary else 0.0)
        if summary:
            draw_bar(axis, summary, f"{heights[-1]:.{METRICS[metric].digits}f}", style(experiment, task), place)
        if paper is not None:  # beside the middle, where the error is
            marker = {"marker": "D", "color": "white", "markeredgecolor": "black", "markeredgewidth": 1.4}
            papers.append(paper)
            axis.plot(place + 0.26, paper, markersize=5.5, zorder=5, **marker)
    shown = [height for height in heights + papers if height > 0.0] or [1.0]
    top = min(1.12 * max(shown), CUT_AT * median(shown))
    notes = [f"{note}\ncut".strip() if height > top else note for note, height in zip(notes, heights, strict=True)]
    axis.set_xticks(range(len(notes)), notes, fontsize=8)
    axis.tick_params(axis="x", length=0)
    axis.set(title=METRICS[metric].label(), xlim=(-0.6, len(notes) - 0.4), ylim=(0, top))
    axis.grid(axis="y", alpha=0.3)


def progress_of_bar(summary: Summary | None, num_planned: int) -> str:
    """Return what is written below a bar that is not final; nothing below others."""
    if summary is None:
        return "no\ndata"
    return "" if summary.is_final else f"{len(summary.values)} of\n{num_planned} *"


def draw_bar(axis: Any, summary: Summary, text: str, styles: tuple[str, Any, str], place: int) -> None:
    """Draw a bar with its error and its number; pale if it is not final."""
    color, _, hatch = styles
    mean, alpha = fmean(summary.values), 1.0 if summary.is_final else UNFINISHED_ALPHA
    axis.bar(place, mean, width=0.8, color=color, hatch=hatch, edgecolor="black", linewidth=0.8, alpha=alpha)
    axis.errorbar(place, mean, yerr=summary.standard_error, color="black", capsize=5, linewidth=1.5, zorder=4)
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1.5}
    settings = {"rotation": 90, "ha": "center", "va": "bottom", "fontsize": 9, "bbox": box}
    axis.text(place, 0.04, text, transform=axis.get_xaxis_transform(), **settings)


def draw_legend(figure: Any, experiment: Experiment) -> None:
    """Draw the legend of a figure of bars below it."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = []
    for task in experiment.tasks:
        color, _, hatch = style(experiment, task)
        handles.append(Patch(facecolor=color, hatch=hatch, edgecolor="black", label=MODELS.get(task, task)))
    marker = {"marker": "D", "color": "none", "markerfacecolor": "white", "markeredgecolor": "black"}
    handles.append(Line2D([], [], label="paper", **marker))
    pale = f"pale, *: seeds are missing (n of {len(experiment.seeds)} are there) or trainings not finished"
    handles.append(Patch(facecolor="none", edgecolor="none", label=pale))
    handles.append(Patch(facecolor="none", edgecolor="none", label="cut: far beyond the others"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, handlelength=3, frameon=False)
