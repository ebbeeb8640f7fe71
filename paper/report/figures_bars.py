"""The metrics of Table I as bars with a point per seed: the paper's Figures 6 and 7, and those of your own."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import TYPE_CHECKING, Any

from legged_torque.paper.report.figures_style import SEED_MARK, Style, draw_seeds, name_of, style
from legged_torque.paper.report.results import Experiment, Summary, Table
from legged_torque.paper.values import ENVIRONMENTS, PAPER_METRICS, paper_value
from legged_torque.utils.metrics import Metric
from legged_torque.utils.plotting import load_pyplot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

UNFINISHED_ALPHA = 0.45
CUT_AT = 3.0  # largest height of a panel of bars, in medians of the values that it shows
PAPER_MARK: dict[str, Any] = {"marker": "D", "color": "none", "markerfacecolor": "white", "markeredgecolor": "black"}
SPREAD = 0.09  # distance between the points of two seeds, in distances of bars


def draw_bars(experiment: Experiment, table: Table, names: Sequence[str], title: str) -> Figure | None:
    """Draw the metrics of Table I, a row of panels for each of these columns of the table; return None without data."""
    columns = [name for name in names if any(table.get(name, {}).values())]
    if not columns:
        return None
    grid = {"figsize": (15.0, 3.4 * len(columns) + 0.9), "squeeze": False, "layout": "constrained"}
    figure, axes = load_pyplot().subplots(len(columns), len(PAPER_METRICS), **grid)
    for row, column in zip(axes, columns, strict=True):
        for axis, metric in zip(row, PAPER_METRICS, strict=True):
            draw_panel(axis, experiment, table, column, metric)
        row[0].set_ylabel(ENVIRONMENTS.get(column, column))
    draw_legend(figure, experiment, columns)
    text = "bars: means over seeds with standard errors; tracking %: high is good, all else: low is good"
    figure.suptitle(f"{title}: {text}", fontsize=11)
    return figure


def draw_panel(axis: Axes, experiment: Experiment, table: Table, column: str, metric: Metric) -> None:
    """Draw a metric in a column of Table I. Bars far beyond the others are cut off, so that the others stay legible."""
    heights, papers, notes, tasks = [], [], [], experiment.plan.tasks  # heights: of the highest seeds
    for place, task in enumerate(tasks):
        summary, paper = table[column][task].get(metric.name), paper_value(task, column, metric.name)
        if summary is None:
            heights.append(0.0)
            notes.append("no\ndata")
        else:
            heights.append(max(summary.values))
            planned = experiment.num_expected(task, experiment.columns()[column][0])
            notes.append("" if summary.is_final else f"{len(summary.values)} of\n{planned} *")
            draw_bar(axis, summary, metric.digits, style(tasks, task), place)
        if paper is not None:  # beside the middle, where the error bar is
            papers.append(paper)
            axis.plot(place + 0.3, paper, markersize=5.5, markeredgewidth=1.4, zorder=6, **PAPER_MARK)
    shown = [height for height in heights + papers if height > 0.0] or [1.0]
    top = min(1.12 * max(shown), CUT_AT * median(shown))
    notes = [f"{note}\ncut".strip() if height > top else note for note, height in zip(notes, heights, strict=True)]
    axis.set_xticks(range(len(notes)), notes, fontsize=8)
    axis.tick_params(axis="x", length=0)
    axis.set(title=metric.label, xlim=(-0.6, len(notes) - 0.4), ylim=(0, top))
    axis.grid(axis="y", alpha=0.3)


def draw_bar(axis: Axes, summary: Summary, digits: int, styles: Style, place: int) -> None:
    """Draw a bar with its error, its number and a point per seed; pale if it is not final."""
    color, _, hatch = styles
    mean, alpha = summary.mean, 1.0 if summary.is_final else UNFINISHED_ALPHA
    axis.bar(place, mean, width=0.8, color=color, hatch=hatch, edgecolor="black", linewidth=0.8, alpha=alpha)
    axis.errorbar(place, mean, yerr=summary.standard_error, color="black", capsize=5, linewidth=1.5, zorder=4)
    middle = place - SPREAD * (len(summary.values) - 1) / 2
    draw_seeds(axis, [middle + SPREAD * i for i in range(len(summary.values))], summary.values, "black")
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1.5}
    layout: dict[str, Any] = {"rotation": 90, "ha": "center", "va": "bottom", "fontsize": 9, "bbox": box}
    axis.text(place, 0.04, f"{mean:.{digits}f}", transform=axis.get_xaxis_transform(), **layout)


def draw_legend(figure: Figure, experiment: Experiment, columns: Sequence[str]) -> None:
    """Draw the legend of a figure of bars below it."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    tasks = experiment.plan.tasks
    bars = [(name_of(task), *style(tasks, task)) for task in tasks]
    handles: list[Any] = [Patch(facecolor=c, hatch=h, edgecolor="black", label=label) for label, c, _, h in bars]
    handles.append(Line2D([], [], color="black", linestyle="none", label="single seeds", **SEED_MARK))
    if any(paper_value(task, column, PAPER_METRICS[0].name) is not None for task in tasks for column in columns):
        handles.append(Line2D([], [], label="paper", **PAPER_MARK))
    notes = {tick.get_text() for axis in figure.axes for tick in axis.get_xticklabels()}
    for sign, meaning in {"*": "pale, *: seeds are missing or not finished", "cut": "cut: far beyond others"}.items():
        handles += [Patch(color="none", label=meaning)] if any(sign in note for note in notes) else []
    figure.legend(handles=handles, loc="outside lower center", ncols=5, handlelength=3, frameon=False)
