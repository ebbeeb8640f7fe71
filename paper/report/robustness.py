"""What policies bear: tracking in other conditions, and sweeps of a parameter, compared with the baseline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from legged_torque.paper.plotting import load_pyplot
from legged_torque.paper.report.experiment import Experiment
from legged_torque.paper.report.style import in_words, method, name_of, style
from legged_torque.paper.report.tables import SIGNIFICANT, Rows, baseline_of, estimate, estimate_text, holm, welch

if TYPE_CHECKING:
    from matplotlib.figure import Figure

VALUES = ["task", "seed", "at", "value"]


@dataclass(frozen=True)
class Sweep:
    """What a sweep found in the trainings of an environment.

    Attributes:
        parameter: Its name, with the unit in brackets.
        is_push: Whether values are shares of robots that fell after a push; else they are tracking.
        values: A row per task, seed and part, with at least the columns :data:`VALUES`.
        compared: What :func:`compare` says of them.
    """

    parameter: str
    is_push: bool
    values: pd.DataFrame
    compared: pd.DataFrame


def condition_table(experiment: Experiment, environment: str) -> Rows:
    """Return tracking in each condition, bold where it differs from the baseline; nothing without data."""
    runs = [run for run in experiment.runs if run.cell.environment == environment]
    rows = [(run.cell.task, run.cell.seed, *item) for run in runs for item in run.conditions.items()]
    values = pd.DataFrame(rows, columns=VALUES).dropna()
    if values.empty:
        return []
    apart = [compare(experiment.plan.tasks, part) for _, part in values.groupby("at")]  # a family of tests each
    significant = {key for found in apart for key in found[found["is_significant"]].index}
    seeds = values.groupby(["task", "at"])["value"].agg(list)
    names = [name for name in experiment.plan.conditions if name in set(values["at"])]
    table = [["method", *names]]
    for task in experiment.plan.tasks:
        keys = [(task, name) for name in names]
        found = [estimate(seeds.get(key, [])) | {"is_significant": key in significant} for key in keys]
        table.append([method(task), *(estimate_text(cell, ".3f", len(experiment.plan.seeds)) for cell in found)])
    return table


def find_sweeps(experiment: Experiment) -> dict[str, Sweep]:
    """Return the sweeps for which there are data, by the titles of their figures."""
    found = {}
    for environment in experiment.plan.environments:
        for name in experiment.plan.sweeps:
            runs = [run for run in experiment.runs if run.cell.environment == environment and name in run.sweeps]
            if runs:
                parts = [run.sweeps[name].assign(task=run.cell.task, seed=run.cell.seed) for run in runs]
                values, unit = pd.concat(parts, ignore_index=True), parts[0]["unit"].iloc[0]
                where = f" trained in {in_words(environment)}" if len(experiment.plan.environments) > 1 else ""
                compared = compare(experiment.plan.tasks, values)
                parameter = f"{name} [{unit}]" if unit else name
                found[f"Sweep of {name}{where}"] = Sweep(parameter, bool(values["is_push"].iloc[0]), values, compared)
    return found


def compare(tasks: list[str], values: pd.DataFrame) -> pd.DataFrame:
    """Return by how much tasks differ from the baseline, in each part of a sweep or in a condition.

    Returns:
        A row per task but the baseline and part (the index) that both have, with what :func:`estimate` returns and
        ``is_significant``: by Welch's test, with Holm's correction over all rows.
    """
    baseline = baseline_of(tasks)
    of = {key: seeds.tolist() for key, seeds in values.dropna(subset="value").groupby(["task", "at"])["value"]}
    keys = [key for key in of if key[0] != baseline and (baseline, key[1]) in of]
    rows = [estimate(of[key], of[baseline, key[1]]) for key in keys]
    index = pd.MultiIndex.from_arrays([[key[0] for key in keys], [key[1] for key in keys]], names=["task", "at"])
    p_values = holm([welch(of[key], of[baseline, key[1]]) for key in keys])
    columns = ["values", "iqm", "low", "high", "seeds"]
    return pd.DataFrame(rows, index, columns).assign(is_significant=p_values < SIGNIFICANT)


def draw_sweep(tasks: list[str], sweep: Sweep) -> Figure:
    """Draw a line per task, and beside it the differences to the baseline.

    Bars are 95% bootstrap intervals over seeds. A filled point is a significant difference.
    """
    figure, (left, right) = load_pyplot().subplots(1, 2, figsize=(12.0, 4.6), layout="constrained")
    seeds = sweep.values.dropna(subset="value").groupby(["task", "at"])["value"].agg(list)
    for task in (task for task in tasks if task in seeds.index):
        found = pd.DataFrame({at: estimate(own) for at, own in seeds[task].items()}).T
        color, line, _ = style(tasks, task)
        left.plot(found["iqm"], color=color, linestyle=line, marker=".", label=name_of(task))
        left.vlines(found.index, found["low"], found["high"], color=color, linewidth=1.0)
    places = np.unique(sweep.values["at"])
    width, others = np.ptp(places) / max(len(places) - 1, 1), [task for task in tasks if task in sweep.compared.index]
    for place, task in enumerate(others):
        cells, color = sweep.compared.loc[task], style(tasks, task)[0]
        at = cells.index + 0.6 * width * ((place + 0.5) / len(others) - 0.5)  # side by side
        right.vlines(at, cells["low"], cells["high"], color=color)
        faces = np.where(cells["is_significant"], color, "white")
        right.scatter(at, cells["iqm"], c=faces, edgecolors=color, s=22, zorder=5)
    right.axhline(0.0, color="black", linewidth=1.0)
    for axis in (left, right):
        axis.set_xlabel(sweep.parameter)
        axis.grid(alpha=0.3)
    left.set(ylabel="share that falls" if sweep.is_push else "tracking", ylim=(0.0, 1.0))
    right.set_ylabel(f"minus {name_of(baseline_of(tasks))}")
    figure.legend(loc="outside lower center", ncols=4, handlelength=3, frameon=False)
    return figure


def findings(tasks: list[str], sweep: Sweep) -> str:
    """Return in words which tasks a sweep separates from the baseline and where most, which not, what is not tested."""
    apart, same, untested = list[str](), list[str](), list[str]()
    for task in (task for task in tasks if task != baseline_of(tasks) and task in set(sweep.values["task"])):
        cells = sweep.compared[sweep.compared.index.get_level_values("task") == task].droplevel("task")
        significant = cells[cells["is_significant"]]
        if len(significant):
            most = significant["iqm"].astype(float).abs().idxmax()
            cell = estimate_text(significant.loc[most], "+.3f")
            apart.append(f"{method(task)} in {len(significant)} of {len(cells)} parts, most at {most:.4g}: {cell}")
        else:
            (same if cells["seeds"].max() > 1 else untested).append(method(task))
    sentences = [f"Different from {method(baseline_of(tasks))}: {'; '.join(apart)}."] if apart else []
    sentences += [f"No significant difference: {', '.join(same)}."] if same else []
    sentences += [f"Not tested, for want of two seeds each: {', '.join(untested)}."] if untested else []
    return " ".join(sentences)
