"""The figures of a report: the paper's Figures 3, 5, 6 and 7 or the same with other titles, and rough ground."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from legged_torque.paper.metrics import COMPARED, PAPER_METRICS, Metric
from legged_torque.paper.plotting import load_pyplot
from legged_torque.paper.report.evaluations import LEVEL
from legged_torque.paper.report.experiment import Experiment
from legged_torque.paper.report.figures_curves import SEED_MARK, draw_curves
from legged_torque.paper.report.style import in_words, name_of, style
from legged_torque.paper.report.tables import baseline_of
from legged_torque.paper.values import ENVIRONMENTS, task_on_plane
from legged_torque.utils.files import write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Draw = Callable[[], "Figure | None"]
"""Draws a figure; returns None without data."""
CURVES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "Tracking": ("Figure 3", "track_percentage", {}),
    "Height": ("Figure 5a", "height", {}),
    "Critic": ("Figure 5b", "critic_gradient_norm", {"scale": "log", "window": 0.03}),
}
"""By title in a report on an experiment of the user's own: the title in one like the paper's, metric, and options."""
BARS = {"Figure 6": ["low", "high"], "Figure 7": ["high_frequency", "doubled"]}
"""Columns of Table I by title."""
SETTINGS = {
    "font.size": 10,
    "hatch.linewidth": 0.6,
    "axes.axisbelow": True,
    "savefig.dpi": 150,
    "text.parse_math": False,  # a "$" in a name is a "$"
}
COLOURS = 96  # of a PNG, which makes it a third of the usual size
UNFINISHED_ALPHA = 0.45
CUT_AT = 3.0  # largest height of a panel of bars, in medians of the values that it shows
PAPER_MARK: dict[str, Any] = {"marker": "D", "color": "none", "markerfacecolor": "white", "markeredgecolor": "black"}
SPREAD = 0.09  # distance between the points of two seeds, in distances of bars
NOTES = {"*": "pale, *: seeds are missing or not finished", "cut": "cut: far beyond others"}
"""Marks below bars, and their meanings in the legend."""
POINT = {"s": 55, "linewidths": 1.6, "zorder": 5}  # of a difference
MARKERS = ("o", "s", "^", "D", "v", "P")  # of approaches on rough ground


def file_name(title: str) -> str:
    """Return the name of a figure's file."""
    return f"{title.lower().replace(' ', '')}.png"


def planned_figures(experiment: Experiment, table: pd.DataFrame, differences: pd.DataFrame) -> dict[str, Draw]:
    """Return the functions that draw the figures of a report, by title: the paper's if the experiment is like it."""
    like_paper = experiment.is_like_paper()
    figures: dict[str, Draw] = {}
    if len(differences):
        figures["Differences"] = partial(draw_differences, experiment.plan.tasks, differences)
    for title, (paper_title, metric, options) in CURVES.items():
        figures[paper_title if like_paper else title] = partial(draw_curves, experiment, metric, **options)
    own = [name for name, (trained, evaluated) in experiment.columns().items() if trained == evaluated]
    bars = BARS | {"Metrics": [name for name in own if name not in ENVIRONMENTS]} if like_paper else {"Metrics": own}
    return figures | {title: partial(draw_bars, experiment, table, names) for title, names in bars.items() if names}


def rough_figures(experiment: Experiment) -> dict[str, Draw]:
    """Return the functions that draw figures on rough ground: levels, and success by environment of training."""
    if not experiment.has_rough_ground():
        return {}
    figures: dict[str, Draw] = {"Levels": partial(draw_curves, experiment, LEVEL.name)}
    names = experiment.plan.environments
    return figures | {f"Success in {in_words(name)}": partial(draw_success, experiment, name) for name in names}


def draw_all(experiment: Experiment, figures: dict[str, Draw], out: Path) -> list[str]:
    """Draw every figure that there are data for, as PNG, and return their titles."""
    from PIL import Image  # matplotlib needs it too

    counts = {len(experiment.runs_of(run.cell.task, run.cell.environment)) for run in experiment.runs} or {0}
    seeds = "–".join(map(str, sorted({min(counts), max(counts)})))
    conditions = f"{experiment.ranges()} ranges, {seeds} seed{'' if seeds == '1' else 's'}"
    pyplot, drawn = load_pyplot(), []
    with pyplot.rc_context(SETTINGS):
        for title, draw in figures.items():
            if (figure := draw()) is not None:
                figure.suptitle(f"{title} ({conditions})", fontsize=11)
                figure.savefig(stream := io.BytesIO(), format="png")
                image = Image.open(stream).convert("RGB").quantize(COLOURS, Image.Quantize.MAXCOVERAGE)
                image.save(stream := io.BytesIO(), format="png", optimize=True)
                write_whole(out / file_name(title), stream.getvalue())
                pyplot.close(figure)
                drawn.append(title)
    return drawn


def draw_differences(tasks: list[str], differences: pd.DataFrame) -> Figure | None:
    """Draw the differences to the baseline, a row of panels per column of the table; return None without data."""
    columns, shown = differences["iqm"].dropna().index.unique("column"), differences.index.unique("task")
    if columns.empty:
        return None
    places, colors = np.arange(len(shown)), np.array([style(tasks, task)[0] for task in shown])
    baseline, size = name_of(baseline_of(tasks)), (15.0, len(columns) * (0.7 + 0.25 * len(shown)) + 0.8)
    grid = {"figsize": size, "sharey": True, "squeeze": False, "layout": "constrained"}
    figure, axes = load_pyplot().subplots(len(columns), len(COMPARED), **grid)
    for axis, (column, metric) in zip(axes.flat, product(columns, COMPARED), strict=True):
        cells = differences.loc[column].xs(metric.name, level="metric")
        axis.axvline(0.0, color="black", linewidth=1.0)
        axis.hlines(places, cells["low"], cells["high"], colors=colors, linewidth=2.5)
        faces = np.where(cells["is_significant"], colors, "white")
        axis.scatter(cells["iqm"], places, c=faces, edgecolors=colors, **POINT)
        side = "left" if metric.lower_is_better else "right"
        axis.set_xlabel(f"{metric.label}\n" + fill(f"method minus {baseline}; better to the {side}", 44))
        axis.locator_params(axis="x", nbins=5)
        axis.grid(axis="x", alpha=0.3)
    for row, column in zip(axes, columns, strict=True):
        row[0].set_ylabel(in_words(column))
    axes[0, 0].set(yticks=places, yticklabels=map(name_of, shown), ylim=(len(shown) - 0.5, -0.5))
    for color, meaning in (("black", "significant (Welch's test, Holm's correction)"), ("white", "not significant")):
        axes[0, 0].scatter([], [], c=color, edgecolors="black", label=meaning, **POINT)
    axes[0, 0].plot([], [], color="black", linewidth=2.5, label="95% bootstrap interval over seeds")
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    return figure


def draw_bars(experiment: Experiment, table: pd.DataFrame, names: Sequence[str]) -> Figure | None:
    """Draw the metrics of Table I, a row of panels for each of these columns of the table; return None without data."""
    present = table["iqm"].dropna().index.unique("column")
    columns = [name for name in names if name in present]
    if not columns:
        return None
    grid = {"figsize": (15.0, 3.4 * len(columns) + 0.9), "squeeze": False, "layout": "constrained"}
    figure, axes = load_pyplot().subplots(len(columns), len(PAPER_METRICS), **grid)
    for row, column in zip(axes, columns, strict=True):
        for axis, metric in zip(row, PAPER_METRICS, strict=True):
            draw_metric(axis, experiment, table.loc[column].xs(metric.name, level="metric"), column, metric)
        row[0].set_ylabel(ENVIRONMENTS.get(column, in_words(column)))
    draw_legend(figure, experiment.plan.tasks, table.loc[columns]["paper"].notna().any())
    return figure


def draw_metric(axis: Axes, experiment: Experiment, cells: pd.DataFrame, column: str, metric: Metric) -> None:
    """Draw a metric, by task, in a column of Table I. Bars far beyond the others are cut off."""
    tops = [max(cell["values"], default=np.nan) for _, cell in cells.iterrows()]  # of the highest seeds
    values = np.array([*tops, *cells["paper"]])
    shown = values[values > 0.0]
    highest = min(1.12 * shown.max(), CUT_AT * np.median(shown)) if len(shown) else 1.0
    notes = []
    for place, ((task, cell), top) in enumerate(zip(cells.iterrows(), tops, strict=True)):
        planned = experiment.num_expected(str(task), experiment.columns()[column][0])
        note = "" if cell["is_final"] else f"{cell['seeds']} of\n{planned} *" if cell["seeds"] else "no\ndata"
        notes.append(f"{note}\ncut".strip() if top > highest else note)
        axis.plot(place + 0.3, cell["paper"], markersize=5.5, markeredgewidth=1.4, zorder=6, **PAPER_MARK)
        if cell["seeds"]:
            color, _, hatch = style(experiment.plan.tasks, str(task))
            draw_bar(axis, cell, place, f"{cell['iqm']:.{metric.digits}f}", color, hatch)
    axis.set_xticks(range(len(notes)), notes, fontsize=8)
    axis.tick_params(axis="x", length=0)
    axis.set(title=metric.label, xlim=(-0.6, len(notes) - 0.4), ylim=(0, highest))
    axis.grid(axis="y", alpha=0.3)


def draw_bar(axis: Axes, cell: pd.Series, place: int, label: str, color: str, hatch: str) -> None:
    """Draw a bar with its interval, its number and a point per seed; pale if it is not final."""
    alpha = 1.0 if cell["is_final"] else UNFINISHED_ALPHA
    axis.bar(place, cell["iqm"], width=0.8, color=color, hatch=hatch, edgecolor="black", linewidth=0.8, alpha=alpha)
    axis.plot([place, place], cell[["low", "high"]], "_-", color="black", markersize=10, linewidth=1.5, zorder=4)
    places = place + SPREAD * (np.arange(cell["seeds"]) - (cell["seeds"] - 1) / 2)
    axis.plot(places, cell["values"], color="black", linestyle="none", zorder=5, **SEED_MARK)
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1.5}
    layout: dict[str, Any] = {"rotation": 90, "ha": "center", "va": "bottom", "fontsize": 9, "bbox": box}
    axis.text(place, 0.04, label, transform=axis.get_xaxis_transform(), **layout)


def draw_legend(figure: Figure, tasks: Sequence[str], has_paper: bool) -> None:
    """Draw the legend of a figure of bars below it."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = []
    for task in tasks:
        color, _, hatch = style(tasks, task)
        handles.append(Patch(facecolor=color, hatch=hatch, edgecolor="black", label=name_of(task)))
    handles.append(Line2D([], [], color="black", linestyle="none", label="single seeds", **SEED_MARK))
    handles += [Line2D([], [], label="paper", **PAPER_MARK)] if has_paper else []
    notes = " ".join(tick.get_text() for axis in figure.axes for tick in axis.get_xticklabels())
    handles += [Patch(color="none", label=meaning) for mark, meaning in NOTES.items() if mark in notes]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, handlelength=3, frameon=False)


def draw_success(experiment: Experiment, environment: str) -> Figure | None:
    """Draw the share of robots that cross tiles over difficulty, for each kind and all; return None without data."""
    tiles = experiment.crossings().query("environment == @environment")
    if tiles.empty:
        return None
    kinds = [*tiles["kind"].unique(), "all"]
    columns = min(4, len(kinds))
    rows = math.ceil(len(kinds) / columns)
    grid = {"figsize": (3.1 * columns, 2.3 * rows + 1.2), "sharex": True, "sharey": True, "squeeze": False}
    figure, axes = load_pyplot().subplots(rows, columns, layout="constrained", **grid)
    for axis, kind in zip(axes.flat, kinds, strict=False):
        draw_tiles(axis, experiment, environment, tiles if kind == "all" else tiles[tiles["kind"] == kind])
        axis.set_title("mean of all kinds" if kind == "all" else kind.replace("_", " "))
        axis.set(xlabel="difficulty", ylabel="share that crosses", ylim=(-0.04, 1.04))
        axis.label_outer()
        axis.grid(alpha=0.3)
    for axis in axes.flat[len(kinds) :]:
        axis.set_axis_off()
    shown = axes.flat[len(kinds) - 1].get_legend_handles_labels()
    figure.legend(*shown, loc="outside lower center", ncols=columns, handlelength=4, frameon=False)
    return figure


def draw_tiles(axis: Axes, experiment: Experiment, environment: str, tiles: pd.DataFrame) -> None:
    """Draw the success of all tasks on some tiles, approach by approach: the mean, the range and single seeds."""
    approaches = list(dict.fromkeys(map(task_on_plane, experiment.plan.tasks)))
    for task in sorted(experiment.plan.tasks, key=lambda name: approaches.index(task_on_plane(name))):
        seeds = tiles[tiles["task"] == task].pivot_table(index="level", columns="seed", values="crossed")
        if seeds.empty:
            continue
        planned = experiment.num_expected(task, environment)
        label = name_of(task) + ("" if seeds.shape[1] == planned else f" ({seeds.shape[1]} of {planned} seeds)")
        color, line, _ = style(experiment.plan.tasks, task)
        marker = MARKERS[approaches.index(task_on_plane(task)) % len(MARKERS)]
        face = "white" if line == "--" else color
        marks: dict[str, Any] = {"marker": marker, "markersize": 3.5, "markerfacecolor": face}
        axis.plot(seeds.mean(axis=1), color=color, linestyle=line, linewidth=1.5, label=label, **marks)
        axis.fill_between(seeds.index, seeds.min(axis=1), seeds.max(axis=1), color=color, alpha=0.12, linewidth=0)
        if seeds.shape[1] > 1:
            axis.plot(seeds, ".", color=color, markersize=2.5, alpha=0.7)
