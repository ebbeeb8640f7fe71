"""The figures of a report: the paper's Figures 3, 5, 6 and 7, or the same with other titles."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from legged_torque.paper.report.curves import LEVEL
from legged_torque.paper.report.figures_bars import draw_bars
from legged_torque.paper.report.figures_curves import CurveFigure, draw_curves
from legged_torque.paper.report.figures_rough import draw_success
from legged_torque.paper.report.figures_style import SETTINGS, seeds_text
from legged_torque.paper.report.results import Experiment, Table
from legged_torque.paper.values import ENVIRONMENTS
from legged_torque.utils.plotting import load_pyplot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CURVES = {
    "Tracking": ("Figure 3", CurveFigure("track_percentage")),
    "Tracking over seconds": ("Figure 3 over seconds", CurveFigure("track_percentage", over="seconds")),
    "Height": ("Figure 5a", CurveFigure("height")),
    "Critic": ("Figure 5b", CurveFigure("critic_gradient_norm", scale="log", window=0.03)),
}
"""Title in the report on an experiment of your own, that in one like the paper's, and what it shows."""
BARS: dict[str, tuple[str, ...]] = {
    "Figure 6": ("low", "high"),
    "Figure 7": ("high_frequency", "doubled"),
}  # columns of Table I, by title
OWN_BARS = "Metrics"  # of all other columns
LEVELS = "Levels"  # on rough ground
COLOURS = 96  # of a PNG

Draw = Callable[[str], "Figure | None"]
"""Draws a figure with a title; None without data."""


def file_name(title: str) -> str:
    """Return the name of a figure's file."""
    return f"{title.lower().replace(' ', '')}.png"


def draw_all(experiment: Experiment, table: Table, out: Path) -> list[str]:
    """Draw every figure that there are data for, as PNG, and return their titles; UserError without matplotlib."""
    pyplot, drawn = load_pyplot(), []
    with pyplot.rc_context(SETTINGS):
        for title, draw in (planned_figures(experiment, table) | rough_figures(experiment)).items():
            figure = draw(f"{title} ({conditions(experiment)})")
            if figure is not None:
                save_small(figure, out / file_name(title))
                pyplot.close(figure)
                drawn.append(title)
    return drawn


def conditions(experiment: Experiment) -> str:
    """Return what holds for a whole figure: the ranges of random parameters, and how many seeds there are."""
    counts = sorted({experiment.num_expected(run.cell.task, run.cell.environment) for run in experiment.runs})
    seeds = seeds_text(counts[0]) if len(counts) == 1 else "–".join(map(str, [*counts[:1], *counts[-1:]])) + " seeds"
    return f"{experiment.ranges()} ranges, {seeds}"


def planned_figures(experiment: Experiment, table: Table) -> dict[str, Draw]:
    """Return what draws the figures of a report, by title: the paper's, if the experiment is like it."""
    like_paper = experiment.is_like_paper()
    curves: dict[str, Draw] = {
        paper if like_paper else own: partial(draw_curves, experiment, what) for own, (paper, what) in CURVES.items()
    }
    columns = [name for name, (trained, evaluated) in experiment.columns().items() if trained == evaluated]
    bars = dict(BARS) if like_paper else {}
    own = tuple(name for name in columns if not like_paper or name not in ENVIRONMENTS)
    bars |= {OWN_BARS: own} if own else {}
    return curves | {title: partial(draw_bars, experiment, table, names) for title, names in bars.items()}


def rough_figures(experiment: Experiment) -> dict[str, Draw]:
    """Return what draws figures on rough ground: levels, and success for each environment of training."""
    if not experiment.has_grounds():
        return {}
    figures: dict[str, Draw] = {LEVELS: partial(draw_curves, experiment, CurveFigure(LEVEL.name))}
    names = experiment.plan.environments
    return figures | {f"Success in {name}": partial(draw_success, experiment, name) for name in names}


def save_small(figure: Figure, file: Path) -> None:
    """Write a figure as a PNG of few colours, a third of the usual size."""
    from PIL import Image  # matplotlib needs it too

    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    Image.open(stream).convert("RGB").quantize(COLOURS).save(file, optimize=True)
