"""The figure of ``plot.py sweeps``: what policies bear, by the value of a parameter."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from typing import TYPE_CHECKING, Any

import numpy as np

from legged_torque.paper.plotting import load_pyplot, parse_figure, save_figure
from legged_torque.paper.report import check_extra
from legged_torque.utils.errors import UserError
from legged_torque.utils.files import read_data

if TYPE_CHECKING:
    from matplotlib.axes import Axes

APPROACH = r"_(?=rough_|position|torque|multihead|variable_stiffness|decap|sata)"
"""Where the name of a task's approach begins; what is before is its robot."""


def plot_sweeps() -> None:
    """Draw a row per robot, a column per parameter, and a line per approach.

    Bands are 95% intervals, over worlds if there is one file, else over the files of different seeds.
    """
    text = "Draw what policies bear: ``python scripts/plot.py sweeps sweeps/*.json --out sweeps.png``."
    args = parse_figure(text, "files", "JSON of evaluate.py --sweep", nargs="+")
    check_extra()
    pyplot = load_pyplot()
    script, lines = "evaluate.py --sweep", defaultdict[tuple[str, str, str], list[dict[str, Any]]](list)
    for file in args.files:
        content = read_data(file, {"task", "sweep"}, script)
        try:
            robot, *rest = re.split(APPROACH, content["task"], maxsplit=1)
            lines[robot, (rest or [robot])[0], content["sweep"]["parameter"]].append(content["sweep"])
        except (LookupError, TypeError):
            raise UserError(f"'{file}' is not a file that {script} has written") from None
    robots, approaches, parameters = (list(dict.fromkeys(names)) for names in zip(*lines, strict=True))
    size = (3.0 * len(parameters), 2.2 * len(robots) + 0.4)
    figure, axes = pyplot.subplots(len(robots), len(parameters), figsize=size, layout="constrained", squeeze=False)
    for (robot, approach, parameter), of_seeds in lines.items():
        axis = axes[robots.index(robot), parameters.index(parameter)]
        try:
            _draw(axis, of_seeds, approach, f"C{approaches.index(approach)}")
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise UserError(f"a sweep of {parameter} for {robot}_{approach} is not whole: {error!r}") from None
    for row, robot in zip(axes, robots, strict=True):
        row[0].annotate(robot, (-0.42, 0.5), xycoords="axes fraction", rotation=90, va="center", weight="bold")
    axes[0, 0].legend(fontsize=8)
    save_figure(figure, args.out)


def _draw(axis: Axes, sweeps: list[dict[str, Any]], label: str, colour: str) -> None:
    """Draw tracking, or the share that falls after a push, in the middle of each part; a delay is a whole number."""
    from scipy.stats import t

    from legged_torque.paper.report.experiment import read_sweep  # needs the extra plots

    sweep, tables = sweeps[0], [read_sweep(each) for each in sweeps]
    if any(not table["at"].equals(tables[0]["at"]) for table in tables):
        raise ValueError("its files have different ranges")
    x, means = tables[0]["at"], np.array([table["value"] for table in tables])
    mean, count = means.mean(axis=0), len(sweeps)
    if count == 1:
        half = 1.96 * tables[0]["standard_error"]
    else:
        half = t.ppf(0.975, count - 1) * means.std(axis=0, ddof=1) / math.sqrt(count)
    axis.fill_between(x, mean - half, mean + half, color=colour, alpha=0.25, linewidth=0)
    axis.plot(x, mean, color=colour, marker=".", label=label)
    axis.set(ylim=(0.0, 1.0), xlabel=f"{sweep['parameter']} [{sweep['unit']}]" if sweep["unit"] else sweep["parameter"])
    axis.set_ylabel("share that falls" if tables[0]["is_push"].iloc[0] else "tracking")
