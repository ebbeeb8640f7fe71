"""What policies bear: tracking in other conditions, and sweeps of a parameter, compared with the baseline."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from legged_torque.paper.plotting import load_pyplot
from legged_torque.paper.report.experiment import Experiment
from legged_torque.paper.report.figures import Draw
from legged_torque.paper.report.style import in_words, method, name_of, style
from legged_torque.paper.report.tables import SIGNIFICANT, Rows, baseline_of, estimate, estimate_text, holm, welch

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def condition_table(experiment: Experiment, environment: str) -> Rows:
    """Return tracking in each condition, with what :func:`compare` says of its difference; nothing without data."""
    rows = [
        {"task": run.cell.task, "seed": run.cell.seed, "at": name, "value": value}
        for run in experiment.runs
        for name, value in run.conditions.items()
        if run.cell.environment == environment
    ]
    if not rows:
        return []
    values = pd.DataFrame(rows)
    names = [name for name in experiment.plan.conditions if name in set(values["at"])]
    compared = pd.concat([compare(experiment, part) for _, part in values.groupby("at")])
    planned, table = len(experiment.plan.seeds), [["method", *names]]
    for task in experiment.plan.tasks:
        cells = []
        for name in names:
            seeds = values.query("task == @task and at == @name")["value"].tolist()
            is_significant = (task, name) in compared.index and compared.loc[(task, name), "is_significant"]
            cells.append(estimate_text(estimate(seeds) | {"is_significant": is_significant}, ".3f", planned))
        table.append([method(task), *cells])
    return table


def sweep_values(experiment: Experiment, environment: str, name: str) -> pd.DataFrame:
    """Return what a sweep found: a row per task, seed and part, with the columns ``at`` and ``value``.

    A delay is a whole number, other parameters are in the middle of their part. The value is tracking, or the share of
    robots that fell after a push.
    """
    parts = [
        run.sweeps[name].assign(task=run.cell.task, seed=run.cell.seed)
        for run in experiment.runs
        if run.cell.environment == environment and name in run.sweeps
    ]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()


def compare(experiment: Experiment, values: pd.DataFrame) -> pd.DataFrame:
    """Return by how much tasks differ from the baseline, in each part of a sweep or in a condition.

    Returns:
        A row per task but the baseline and part (the index), with what :func:`estimate` returns and
        ``is_significant``: by Welch's test, with Holm's correction over all rows.
    """
    baseline = baseline_of(experiment.plan.tasks)
    of = {key: seeds.dropna().tolist() for key, seeds in values.groupby(["task", "at"])["value"]}
    keys = [key for key in of if key[0] != baseline and (baseline, key[1]) in of]
    rows = [estimate(of[key], of[baseline, key[1]]) for key in keys]
    p_values = holm([welch(of[key], of[baseline, key[1]]) for key in keys])
    index = pd.MultiIndex.from_tuples(keys, names=["task", "at"]) if keys else None
    return pd.DataFrame(rows, index).assign(is_significant=p_values < SIGNIFICANT)


def sweep_figures(experiment: Experiment) -> dict[str, Draw]:
    """Return the functions that draw the figures of sweeps, by title."""
    places = [(name, environment) for environment in experiment.plan.environments for name in experiment.plan.sweeps]
    return {sweep_title(*place): partial(draw_sweep, experiment, *place) for place in places}


def sweep_title(name: str, environment: str) -> str:
    """Return the title of the figure of a sweep."""
    return f"Sweep of {name} in {in_words(environment)}"


def draw_sweep(experiment: Experiment, name: str, environment: str) -> Figure | None:
    """Draw a line per task, and beside it the differences to the baseline; return None without data.

    Bars are 95% bootstrap intervals over seeds. A filled point is a significant difference.
    """
    values, tasks = sweep_values(experiment, environment, name), experiment.plan.tasks
    if values.empty:
        return None
    figure, (left, right) = load_pyplot().subplots(1, 2, figsize=(12.0, 4.6), layout="constrained")
    for task in tasks:
        own = values[values["task"] == task].groupby("at")["value"].agg(lambda seeds: estimate(seeds.dropna().tolist()))
        found, (color, line, _) = pd.DataFrame(own.tolist(), own.index), style(tasks, task)
        if len(found):
            left.plot(found["iqm"], color=color, linestyle=line, marker=".", label=name_of(task))
            left.vlines(found.index, found["low"], found["high"], color=color, linewidth=1.0)
    compared, width = compare(experiment, values), np.ptp(values["at"]) / max(values["at"].nunique() - 1, 1)
    others = [task for task in tasks if len(compared) and task in compared.index]
    for place, task in enumerate(others):
        cells, color = compared.loc[task], style(tasks, task)[0]
        at = cells.index + 0.6 * width * ((place + 0.5) / len(others) - 0.5)  # side by side
        right.vlines(at, cells["low"], cells["high"], color=color)
        faces = np.where(cells["is_significant"], color, "white")
        right.scatter(at, cells["iqm"], c=faces, edgecolors=color, s=22, zorder=5)
    right.axhline(0.0, color="black", linewidth=1.0)
    unit, is_push = values["unit"].iloc[0], values["is_push"].iloc[0]
    for axis in (left, right):
        axis.set_xlabel(f"{name} [{unit}]" if unit else name)
        axis.grid(alpha=0.3)
    left.set(ylabel="share that falls" if is_push else "tracking", ylim=(0.0, 1.0))
    right.set_ylabel(f"minus {name_of(baseline_of(tasks))}")
    figure.legend(loc="outside lower center", ncols=4, handlelength=3, frameon=False)
    return figure


def findings(experiment: Experiment, name: str, environment: str) -> str:
    """Return in words which tasks a sweep separates from the baseline and where most, and which not; it has data."""
    compared, apart, same = compare(experiment, values := sweep_values(experiment, environment, name)), [], []
    for task in experiment.plan.tasks:
        cells = compared.loc[task] if len(compared) and task in compared.index else compared[:0]
        significant, is_tested = cells[cells["is_significant"]], len(cells) and cells["seeds"].max() > 1
        if len(significant):
            most = significant["iqm"].abs().idxmax()
            at, cell = f"{most:.4g} {values['unit'].iloc[0]}".strip(), estimate_text(significant.loc[most], "+.3f")
            apart.append(f"{method(task)} in {len(significant)} of {len(cells)} parts, most at {at}: {cell}")
        elif is_tested:
            same.append(method(task))
    sentences = [f"Different from {method(baseline_of(experiment.plan.tasks))}: {'; '.join(apart)}."] if apart else []
    sentences += [f"No significant difference: {', '.join(same)}."] if same else []
    return " ".join(sentences) or "With one seed each, nothing is tested."
