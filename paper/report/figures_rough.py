"""What came out on rough ground, as a figure: shares of robots that cross tiles."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from legged_torque.paper.report.figures_style import MARKERS, name_of, style
from legged_torque.paper.report.grounds import by_level, kinds_of
from legged_torque.paper.report.results import Experiment
from legged_torque.paper.values import ENVIRONMENTS, task_on_plane
from legged_torque.utils.plotting import load_pyplot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_success(experiment: Experiment, environment: str, title: str) -> Figure | None:
    """Draw the share of robots that cross tiles over difficulty, for each kind and all; return None without data."""
    plan = experiment.plan
    approaches = list(dict.fromkeys(map(task_on_plane, plan.tasks)))
    by_task = {}
    for task in sorted(plan.tasks, key=lambda name: approaches.index(task_on_plane(name))):
        by_task[task] = [run.crossings for run in experiment.runs_of(task, environment) if run.crossings]
    kinds = kinds_of([each for seeds in by_task.values() for each in seeds])
    if not kinds:
        return None
    labels = {}
    for task, seeds in by_task.items():
        planned = experiment.num_expected(task, environment)
        labels[task] = name_of(task) + ("" if len(seeds) == planned else f" ({len(seeds)} of {planned} seeds)")
    columns = min(4, len(kinds) + 1)
    rows = math.ceil((len(kinds) + 1) / columns)
    grid = {"figsize": (3.1 * columns, 2.3 * rows + 1.2), "sharex": True, "sharey": True, "squeeze": False}
    figure, axes = load_pyplot().subplots(rows, columns, layout="constrained", **grid)
    for axis, kind in zip(axes.flat, [*kinds, None], strict=False):
        for task, seeds in by_task.items():
            color, line, _ = style(plan.tasks, task)
            marker = MARKERS[approaches.index(task_on_plane(task)) % len(MARKERS)]
            look = {"color": color, "linestyle": line, "marker": marker, "markersize": 3.5}
            draw_success_line(axis, labels[task], [by_level(each, "crossed", kind) for each in seeds], look)
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
    text = f"{title}, {ENVIRONMENTS.get(environment, environment)}: robots that cross a tile in time, mean over seeds "
    text += "with a band from the lowest to the highest; small points: single seeds"
    figure.suptitle(textwrap.fill(text, 40 * columns), fontsize=11)
    return figure


def draw_success_line(axis: Axes, label: str, seeds: list[dict[float, float]], look: dict[str, Any]) -> None:
    """Draw the success of a task, given by difficulty for each seed; nothing without seeds."""
    levels = sorted(set[float]().union(*seeds))
    if not levels:
        return
    values = np.array([[seed.get(level, math.nan) for level in levels] for seed in seeds])
    face = "white" if look["linestyle"] == "--" else look["color"]
    axis.plot(levels, values.mean(axis=0), label=label, linewidth=1.5, markerfacecolor=face, **look)
    axis.fill_between(levels, values.min(axis=0), values.max(axis=0), color=look["color"], alpha=0.12, linewidth=0)
    for each in values if len(values) > 1 else []:
        axis.plot(levels, each, ".", color=look["color"], markersize=2.5, alpha=0.7)
