"""Means over seeds and tests of their differences, and the tables of a report: rows of texts, the header first."""

from itertools import combinations, product
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from legged_torque.paper.metrics import COMPARED, PAPER_METRICS, Metric
from legged_torque.paper.report.evaluations import CURVE_METRICS, METRIC_NAMES
from legged_torque.paper.report.experiment import MEASURES, PAPER_STEPS, Experiment
from legged_torque.paper.report.style import in_words, method
from legged_torque.paper.values import PAPER_TASKS, paper_value
from legged_torque.utils.config import flat

Rows = list[list[str]]
SIGNIFICANT = 0.05
BETTER, WITHIN, WORSE = "✓", "≈", "✗"
MIN_TRACKING, MIN_STEPS = 0.5, PAPER_STEPS // 10
"""Tracking and steps of training from which on a task is compared with the paper: who stands has a low cost, too."""
BASELINES = ["a1_position", "a1_torque"]
NOTHING = "–"


def summarize(experiment: Experiment, from_step: float) -> pd.DataFrame:
    """Return all metrics over seeds. The value of a seed is the mean of its finite evaluations that count.

    Returns:
        A row for each column of the report's tables, task and metric (the index), with the columns ``values`` (a list,
        one number per seed), ``mean``, ``standard_error`` (NaN with one seed), ``seeds`` (how many), ``is_final``
        (whether all seeds are there and finished), ``is_compared`` (whether they walk), ``paper`` (the mean in Table I,
        or NaN; also where nothing is compared) and ``sign`` (the :func:`verdict`, or nothing).
    """
    rows = []
    for (column, (trained, evaluated)), task in product(experiment.columns().items(), experiment.plan.tasks):
        counted = [(run, run.counted(evaluated, from_step)) for run in experiment.runs_of(task, trained)]
        is_finished = all(run.is_finished(part["steps"].iloc[-1]) for run, part in counted if len(part))
        seeds = pd.DataFrame([part[METRIC_NAMES].mean() for _, part in counted], columns=METRIC_NAMES)
        steps = min((part["steps"].iloc[-1] for _, part in counted if len(part)), default=0)
        is_compared = bool(seeds["track_percentage"].mean() >= MIN_TRACKING and steps >= MIN_STEPS)
        for metric in CURVE_METRICS:
            values = seeds[metric.name].dropna()
            paper = paper_value(task, column, metric.name) if is_compared or values.empty else None
            is_final = is_finished and len(values) == experiment.num_expected(task, trained)
            numbers = values.mean(), values.sem(), len(values)
            sign = ""
            if metric in COMPARED and paper is not None and len(values):
                sign = verdict(metric, values.mean(), values.sem(), paper)
            rows.append([column, task, metric.name, values.tolist(), *numbers, is_final, is_compared, paper, sign])
    names = ["column", "task", "metric", "values", "mean", "standard_error", "seeds", "is_final", "is_compared"]
    return pd.DataFrame(rows, columns=[*names, "paper", "sign"]).astype({"paper": float}).set_index(names[:3])


def verdict(metric: Metric, mean: float, standard_error: float, paper: float) -> str:
    """Return the sign of a mean that is better or worse than the paper's by more than its error, which may be NaN."""
    gain, error = metric.gain(mean, paper), np.nan_to_num(standard_error)
    return BETTER if gain > error else WORSE if gain < -error else WITHIN


def cells_of(table: pd.DataFrame, column: str, metric: Metric) -> pd.DataFrame:
    """Return the rows of :func:`summarize` for a metric in a column, by task; without those that have no data."""
    chosen = table.index.isin([column], level="column") & table.index.isin([metric.name], level="metric")
    return table[chosen].dropna(subset="mean").droplevel(["column", "metric"])


def compare(cells: pd.DataFrame, pairs: list[tuple[str, str]]) -> np.ndarray:
    """Return the corrected p value of each pair of tasks, NaN where no test is possible; the tests are one family."""
    values = cells["values"]
    return holm([welch(values.get(first, []), values.get(second, [])) for first, second in pairs])


def welch(first: list[float], second: list[float]) -> float:
    """Return the two-sided p value of Welch's t-test; NaN with fewer than two values on a side, or no variance."""
    if min(len(first), len(second)) < 2 or np.ptp(first) == np.ptp(second) == 0.0:
        return np.nan
    return float(stats.ttest_ind(first, second, equal_var=False).pvalue)


def holm(p_values: list[float]) -> np.ndarray:
    """Return the p values with Holm's correction for as many tests as there are; NaN stays NaN."""
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p)  # NaN last
    remaining = np.isfinite(p).sum() - np.arange(len(p))
    corrected = np.empty_like(p)
    corrected[order] = np.maximum.accumulate(np.minimum(p[order] * remaining, 1.0))
    return corrected


def mean_text(cell: pd.Series, digits: int, planned: int = 0) -> str:
    """Return mean and standard error with so many decimals, and the number of seeds if it is not the planned one."""
    if np.isnan(cell["mean"]):
        return NOTHING
    error = "" if np.isnan(cell["standard_error"]) else f" ± {cell['standard_error']:.{digits}f}"
    return f"{cell['mean']:.{digits}f}{error}" + ("" if cell["seeds"] == planned else f" ({cell['seeds']:.0f})")


def marked(text: str, is_significant: bool, *cells: pd.Series) -> str:
    """Return a text in bold if it is significant, with a dagger if a number that it comes from is not final."""
    text = f"**{text}**" if is_significant else text
    return text if all(cell["is_final"] for cell in cells) else f"{text} †"


def metric_table(experiment: Experiment, table: pd.DataFrame, columns: list[str]) -> Rows:
    """Return Table I, or the same for other columns: a group of rows per metric, whose name is in the first of them.

    The paper's methods come first; its values follow ours in columns for which it has any.
    """
    tasks = sorted(experiment.plan.tasks, key=[*PAPER_TASKS, *experiment.plan.tasks].index)
    planned = len(experiment.plan.seeds) if experiment.is_planned else 0  # 0: every entry has its number of seeds
    papers = table["paper"].dropna().index.unique("column")
    names = [name for column in columns for name in ([column, "paper"] if column in papers else [column])]
    rows = [["metric", "method", *map(in_words, names)]]
    for metric in PAPER_METRICS:
        for task in tasks:
            row = [metric.label if task == tasks[0] else "", method(task)]
            for column in columns:
                cell = table.loc[column, task, metric.name]
                text = mean_text(cell, metric.digits, planned)
                text = marked(text, False, cell) if cell["seeds"] else text
                row.append(f"{cell['sign']} {text}".strip())
                if column in papers:
                    row.append(NOTHING if np.isnan(cell["paper"]) else f"{cell['paper']:.{metric.digits}f}")
            rows.append(row)
    return rows


def differences(table: pd.DataFrame, column: str) -> dict[str, Rows]:
    """Return tests of all pairs of tasks, and of each task against the baselines, in a column.

    A family of tests has no rows if no test is possible.
    """
    tasks = table.loc[[column]].dropna(subset="mean").index.unique("task")
    families = {"All pairs": list(combinations(tasks, 2))}
    for baseline in tasks.intersection(BASELINES):
        families[f"Against {method(baseline)}"] = [(task, baseline) for task in tasks if task != baseline]
    return {title: difference_table(table, column, pairs) for title, pairs in families.items()}


def difference_table(table: pd.DataFrame, column: str, pairs: list[tuple[str, str]]) -> Rows:
    """Return the differences of pairs of tasks in all metrics, with their p values; nothing if there are none."""
    rows = [["pair", *(metric.label for metric in PAPER_METRICS)]]
    rows += [[f"{method(first)} − {method(second)}"] for first, second in pairs]
    p_values = [compare(cells_of(table, column, metric), pairs) for metric in PAPER_METRICS]
    for metric, p_of_pairs in zip(PAPER_METRICS, p_values, strict=True):
        for row, pair, p in zip(rows[1:], pairs, p_of_pairs, strict=True):
            one, other = (table.loc[column, task, metric.name] for task in pair)
            p_text = "no p value" if np.isnan(p) else f"p = {p:.2g}"
            text = f"{one['mean'] - other['mean']:+.{metric.digits}f}, {p_text}"
            row.append(marked(text, p < SIGNIFICANT, one, other) if one["seeds"] and other["seeds"] else "no data")
    return [] if np.isnan(p_values).all() else rows


def rough_tables(experiment: Experiment, environment: str) -> dict[str, Rows]:
    """Return the means over difficulties on rough ground, by meaning of the measure, of an environment of training."""
    tiles = experiment.crossings().query("environment == @environment")
    kinds, planned = [*tiles["kind"].unique(), "all"], len(experiment.plan.seeds)
    seeds = pd.concat([tiles, tiles.assign(kind="all")]).groupby(["task", "kind", "seed"])[list(MEASURES)].mean()
    tasks = [task for task in experiment.plan.tasks if experiment.num_expected(task, environment)]
    result: dict[str, Rows] = {}
    for measure, meaning in MEASURES.items() if len(tiles) else []:
        means = seeds[measure].groupby(level=["task", "kind"]).agg(mean="mean", standard_error="sem", seeds="count")
        cells = means.reindex(pd.MultiIndex.from_product([tasks, kinds]))
        rows = [[method(task), *(mean_text(cells.loc[task, kind], 2, planned) for kind in kinds)] for task in tasks]
        result[meaning] = [["task", *kinds], *rows]
    return result


def settings_table(configs: dict[str, dict[str, Any]]) -> Rows:
    """Return the settings in which tasks differ, from a run's settings by task; nothing if there are none."""
    columns = {f"`{task}`": flat({key: config[key] for key in ("env", "train")}) for task, config in configs.items()}
    paths = dict.fromkeys(path for values in columns.values() for path in values)
    rows = [[f"`{path}`", *(str(values.get(path, NOTHING)) for values in columns.values())] for path in paths]
    different = [row for row in rows if len(set(row[1:])) > 1]
    return [["setting", *columns], *different] if different else []
