"""Interquartile means over seeds with their intervals, and the tables of a report: rows of texts, the header first."""

from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from legged_torque.paper.metrics import COMPARED, PAPER_METRICS, Metric
from legged_torque.paper.report.evaluations import CURVE_METRICS, METRIC_NAMES
from legged_torque.paper.report.experiment import MEASURES, PAPER_STEPS, Experiment, is_of_paper
from legged_torque.paper.report.style import in_words, method
from legged_torque.paper.values import PAPER_TASKS, paper_value, task_on_plane
from legged_torque.utils.config import flat

Rows = list[list[str]]
SIGNIFICANT = 0.05
BETTER, WITHIN, WORSE = "✓", "≈", "✗"
MIN_TRACKING, MIN_STEPS = 0.5, PAPER_STEPS // 10
"""Tracking and steps of training from which on a task is compared with the paper: who stands has a low cost, too."""
NOTHING = "–"


def summarize(experiment: Experiment, from_step: float) -> pd.DataFrame:
    """Return all metrics over seeds. The value of a seed is the mean of its finite evaluations that count.

    Returns:
        A row for each column of the report's tables, task and metric (the index), with what :func:`estimate` returns,
        ``is_final`` (whether all seeds are there and finished), ``paper`` (the mean in Table I, or NaN; also where
        nothing is compared, since they do not walk) and ``sign`` (the :func:`verdict`, or nothing).
    """
    rows = []
    for (column, (trained, evaluated)), task in product(experiment.columns().items(), experiment.plan.tasks):
        counted = [(run, run.counted(evaluated, from_step)) for run in experiment.runs_of(task, trained)]
        is_finished = all(run.is_finished(part["steps"].iloc[-1]) for run, part in counted if len(part))
        seeds = pd.DataFrame([part[METRIC_NAMES].mean() for _, part in counted], columns=METRIC_NAMES)
        steps = min((part["steps"].iloc[-1] for _, part in counted if len(part)), default=0)
        estimates = {name: estimate(seeds[name].dropna().tolist()) for name in METRIC_NAMES}
        is_compared = bool(estimates["track_percentage"]["iqm"] >= MIN_TRACKING and steps >= MIN_STEPS)
        for metric in CURVE_METRICS:
            found = estimates[metric.name]
            is_final = is_finished and found["seeds"] == experiment.num_expected(task, trained)
            paper = paper_value(task, column, metric.name) if is_compared or not found["seeds"] else None
            sign = verdict(metric, found, paper) if metric in COMPARED and found["seeds"] and paper is not None else ""
            row = {"column": column, "task": task, "metric": metric.name, **found, "is_final": is_final}
            rows.append(row | {"paper": paper, "sign": sign})
    return pd.DataFrame(rows).astype({"paper": float}).set_index(["column", "task", "metric"])


def interquartile_mean(*samples: Any, axis: int = -1) -> Any:
    """Return the mean without a quarter of the values, rounded down, at each end; of two samples, the difference."""
    means = [stats.trim_mean(values, 0.25, axis=axis) for values in samples]  # as rliable computes it
    return means[0] - means[1] if len(means) == 2 else means[0]


def estimate(*samples: list[float]) -> dict[str, Any]:
    """Return the interquartile mean of seeds, or by how much it is more than that of others.

    Returns:
        ``values``, the first sample; ``iqm``, NaN without values; ``low`` and ``high``, its 95% percentile bootstrap
        interval with the same random numbers in every call, NaN without two values; ``seeds``, of the smaller sample.
    """
    seeds, low, high = min(map(len, samples)), np.nan, np.nan
    if seeds > 1:
        options: dict[str, Any] = {"n_resamples": 2000, "random_state": np.random.default_rng(0)}
        result = stats.bootstrap(samples, interquartile_mean, vectorized=True, method="percentile", **options)
        low, high = result.confidence_interval
    iqm = interquartile_mean(*samples) if seeds else np.nan
    return {"values": samples[0], "iqm": iqm, "low": low, "high": high, "seeds": seeds}


def verdict(metric: Metric, found: dict[str, Any], paper: float) -> str:
    """Return the sign of an interval that is better or worse than the paper's as a whole; of the number without one."""
    gains = [metric.gain(np.nan_to_num(found[end], nan=found["iqm"]), paper) for end in ("low", "high")]
    return BETTER if min(gains) > 0.0 else WORSE if max(gains) < 0.0 else WITHIN


def welch(first: list[float], second: list[float]) -> float:
    """Return the two-sided p value of Welch's t-test; NaN with fewer than two values on a side, or if all are equal."""
    if min(len(first), len(second)) < 2 or np.ptp([*first, *second]) == 0.0:
        return np.nan
    if np.ptp(first) == np.ptp(second) == 0.0:
        return 0.0  # its limit
    return float(stats.ttest_ind(first, second, equal_var=False).pvalue)


def holm(p_values: list[float]) -> np.ndarray:
    """Return the p values with Holm's correction for as many tests as there are; NaN stays NaN."""
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p)  # NaN last
    remaining = np.isfinite(p).sum() - np.arange(len(p))
    corrected = np.empty_like(p)
    corrected[order] = np.maximum.accumulate(np.minimum(p[order] * remaining, 1.0))
    return corrected


def find_differences(experiment: Experiment, table: pd.DataFrame) -> pd.DataFrame:
    """Return the differences to the baseline in all metrics that are compared, in columns like those of Table I.

    Returns:
        A row for each column, task but the baseline, and metric (the index), with the columns of :func:`estimate`,
        ``is_significant`` (with Holm's correction over tasks) and ``is_final`` (as both numbers are).
    """
    baseline, rows = baseline_of(experiment.plan.tasks), []
    for column, metric in product(filter(is_of_paper, experiment.columns()), COMPARED):
        cells = table.loc[column].xs(metric.name, level="metric")
        base, cells = cells.loc[baseline], cells.drop(baseline)
        p_values = holm([welch(values, base["values"]) for values in cells["values"]])
        for (task, cell), p in zip(cells.iterrows(), p_values, strict=True):
            row = {"column": column, "task": task, "metric": metric.name, **estimate(cell["values"], base["values"])}
            rows.append(row | {"is_significant": p < SIGNIFICANT, "is_final": cell["is_final"] and base["is_final"]})
    return pd.DataFrame(rows).set_index(["column", "task", "metric"]) if rows else pd.DataFrame()


def baseline_of(tasks: list[str]) -> str:
    """Return the baseline: the first task with position control, or else the first one. Settings follow a space."""
    return next((task for task in tasks if task_on_plane(f"_{task.partition(' ')[0]}").endswith("_position")), tasks[0])


def estimate_text(found: Any, form: str, planned: int | None = None) -> str:
    """Return an estimate as text, and how many seeds it has if others are planned; bold: significant, †: not final."""
    if not found["seeds"]:
        return NOTHING
    text = f"{found['iqm']:{form}}"
    text += "" if np.isnan(found["low"]) else f" [{found['low']:{form}}, {found['high']:{form}}]"
    text += "" if planned in (None, found["seeds"]) else f" ({found['seeds']})"
    text = f"**{text}**" if found.get("is_significant") else text
    return text if found.get("is_final", True) else f"{text} †"


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
                row.append(f"{cell['sign']} {estimate_text(cell, f'.{metric.digits}f', planned)}".strip())
                if column in papers:
                    row.append(NOTHING if np.isnan(cell["paper"]) else f"{cell['paper']:.{metric.digits}f}")
            rows.append(row)
    return rows


def difference_table(differences: pd.DataFrame) -> Rows:
    """Return the differences as a table: a group of rows per column, whose name is in the first of them."""
    rows, above = [["environment", "method", *(metric.label for metric in COMPARED)]], ""
    for column, task in differences.index.droplevel("metric").unique():
        cells = [(differences.loc[column, task, metric.name], f"+.{metric.digits}f") for metric in COMPARED]
        name = "" if column == above else in_words(column)
        rows.append([name, method(task), *(estimate_text(cell, form) for cell, form in cells)])
        above = column
    return rows


def rough_tables(experiment: Experiment, environment: str) -> dict[str, Rows]:
    """Return what seeds reach on rough ground, mean over difficulties, by meaning of the measure, in an environment."""
    tiles = experiment.crossings().query("environment == @environment")
    kinds, planned = [*tiles["kind"].unique(), "all"], len(experiment.plan.seeds)
    seeds = pd.concat([tiles, tiles.assign(kind="all")]).groupby(["task", "kind", "seed"])[list(MEASURES)].mean()
    tasks = [task for task in experiment.plan.tasks if experiment.num_expected(task, environment)]
    result: dict[str, Rows] = {}
    for measure, meaning in MEASURES.items() if len(tiles) else []:
        values = seeds[measure].dropna().groupby(level=["task", "kind"]).agg(list)
        result[meaning] = [["task", *kinds]]
        for task in tasks:
            found = [estimate(values.get((task, kind), [])) for kind in kinds]
            result[meaning].append([method(task), *(estimate_text(cell, ".2f", planned) for cell in found)])
    return result


def settings_table(configs: dict[str, dict[str, Any]]) -> Rows:
    """Return the settings in which tasks differ, from a run's settings by task; nothing if there are none."""
    columns = {f"`{task}`": flat({key: config[key] for key in ("env", "train")}) for task, config in configs.items()}
    paths = dict.fromkeys(path for values in columns.values() for path in values)
    paths.pop("train.runner.experiment_name", None)  # a folder of each training
    rows = [[f"`{path}`", *(str(values.get(path, NOTHING)) for values in columns.values())] for path in paths]
    different = [row for row in rows if len(set(row[1:])) > 1]
    return [["setting", *columns], *different] if different else []
