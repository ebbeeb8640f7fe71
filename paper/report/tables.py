"""Table I as the paper prints it: methods as rows within a metric, environments as columns, the paper's beside ours."""

from __future__ import annotations

from itertools import combinations

from legged_torque.paper.report.against_paper import judge, marked, number_text
from legged_torque.paper.report.blocks import Grid
from legged_torque.paper.report.figures_style import method
from legged_torque.paper.report.results import Cells, Experiment, Table, compare
from legged_torque.paper.values import PAPER_METRICS, PAPER_TASKS, paper_value
from legged_torque.utils.metrics import Metric

SIGNIFICANT = 0.05


def metric_table(experiment: Experiment, table: Table, columns: list[str]) -> Grid:
    """Return a table with a group of rows per metric, in whose first row only its name stands.

    The paper's methods come first, and its values stand beside ours where it has any.
    """
    tasks = sorted(table[columns[0]], key=lambda task: [*PAPER_TASKS, *experiment.plan.tasks].index(task))
    has_paper = {c: any(paper_value(task, c, PAPER_METRICS[0].name) for task in tasks) for c in columns}
    header = ["metric", "method", *(name for c in columns for name in ([c, "paper"] if has_paper[c] else [c]))]
    planned = len(experiment.plan.seeds) if experiment.is_planned else 0  # 0: every entry tells its number of seeds
    rows = []
    for metric in PAPER_METRICS:
        for place, task in enumerate(tasks):
            row = [metric.label if place == 0 else "", method(task)]
            for column in columns:
                paper = paper_value(task, column, metric.name)
                row.append(number(table[column], task, metric, paper, planned))
                if has_paper[column]:
                    row.append("–" if paper is None else f"{paper:.{metric.digits}f}")
            rows.append(row)
    return Grid(header, rows)


def number(cells: Cells, task: str, metric: Metric, paper: float | None, planned: int) -> str:
    """Return an entry: sign against the paper's value, mean, standard error, and number of seeds if not all."""
    summary = cells[task].get(metric.name)
    if summary is None:
        return "–"
    text = marked(number_text(summary, metric.digits, planned), is_best(cells, task, metric), summary)
    return text if paper is None else f"{judge(metric, summary, paper).sign} {text}"


def is_best(cells: Cells, task: str, metric: Metric) -> bool:
    """Return whether a task is significantly better than every other task that has a value."""
    means = {name: cell[metric.name].mean for name, cell in cells.items() if metric.name in cell}
    pairs = list(combinations(means, 2))
    own = [p for pair, p in zip(pairs, compare(cells, metric.name, pairs), strict=True) if task in pair]
    best = max(means.values(), key=lambda mean: metric.gain(mean, 0.0))
    return means[task] == best and bool(own) and all(p is not None and p < SIGNIFICANT for p in own)
