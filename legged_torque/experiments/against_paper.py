"""The experiment against Table I of the paper: which numbers are as good, and the best torque methods."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from legged_torque.experiments.blocks import BETTER, WITHIN, WORSE, Block, Grid, Paragraph
from legged_torque.experiments.paper_values import ENVIRONMENTS, MODELS, PAPER_METRICS, paper_column
from legged_torque.experiments.results import Cells, Summary, Table
from legged_torque.utils.metrics import Metric

TARGET = 0.05
"""By how much the best torque method shall be better than the paper's best, as a share of that."""
MEANINGS = {BETTER: "better than the paper", WITHIN: "within one standard error of ours", WORSE: "worse than the paper"}
POSITION_TASKS = ("a1_position",)  # all others are torque methods


@dataclass(frozen=True)
class Verdict:
    """A number of ours next to the paper's."""

    sign: str  # BETTER or WORSE by more than our standard error, else WITHIN; that of one seed counts as 0
    share: float  # by how much ours is better, as a share of the paper's


def judge(metric: Metric, summary: Summary, paper: float) -> Verdict:
    """Compare a mean of ours with a number of the paper."""
    gain, error = metric.gain(summary.mean, paper), summary.standard_error or 0.0
    sign = BETTER if gain > error else WORSE if gain < -error else WITHIN
    return Verdict(sign, gain / paper)


def count(table: Table) -> str:
    """Return how many of all numbers of Table I are at least as good as the paper's, in a sentence."""
    signs = []
    for metric, column in itertools.product(PAPER_METRICS, ENVIRONMENTS):
        for task, paper in paper_column(column, metric.name).items():
            summary = table.get(column, {}).get(task, {}).get(metric.name)
            signs.append(judge(metric, summary, paper).sign if summary else "")
    better, within, worse, missing = (signs.count(sign) for sign in (BETTER, WITHIN, WORSE, ""))
    text = (
        f"**{better + within} of {len(signs)} numbers are at least as good as the paper's within one standard error**"
    )
    return f"{text} of ours: {better} are better, {within} within it, {worse} worse, {missing} missing."


def best_torque(table: Table) -> list[Block]:
    """Return the best torque method against the paper's best, by metric and environment of training."""
    rows, reached = [], 0
    columns = [name for name in ENVIRONMENTS if name != "doubled"]
    for metric, column in itertools.product(PAPER_METRICS, columns):
        papers = paper_column(column, metric.name)
        model = max(papers, key=lambda task: metric.gain(papers[task], 0.0))
        row = [metric.label, column, f"{papers[model]:.{metric.digits}f} ({MODELS[model]})"]
        cells = table.get(column, {})
        task = best_task(cells, metric)
        if task is None:
            rows.append([*row, "no data", "", ""])
            continue
        summary = cells[task][metric.name]
        share = judge(metric, summary, papers[model]).share
        sign = BETTER if share >= TARGET else WITHIN if share > 0.0 else WORSE
        reached += sign == BETTER
        rows.append([*row, f"`{task}`", number_text(metric, summary), f"{sign} {share:+.1%}"])
    text = (
        f"**In {reached} of {len(rows)} rows the best torque method is better than the paper's best by {TARGET:.0%} or "
    )
    text += f"more** ({BETTER}; {WITHIN}: better by less, {WORSE}: not better). Torque methods are all tasks but "
    text += f"{', '.join(f'`{task}`' for task in POSITION_TASKS)}; the best is the one with the best mean. Positive "
    header = ["metric", "environment", "paper's best", "our best torque method", "ours", "better by"]
    return [Paragraph(text + "percentages are better, whichever direction that is."), Grid(header, rows)]


def number_text(metric: Metric, summary: Summary) -> str:
    """Return mean, standard error and number of seeds."""
    error = "" if summary.standard_error is None else f" ± {summary.standard_error:.{metric.digits}f}"
    return f"{summary.mean:.{metric.digits}f}{error} ({len(summary.values)})"


def best_task(cells: Cells, metric: Metric) -> str | None:
    """Return the torque method with the best mean; None without any."""
    means = {task: cell[metric.name].mean for task, cell in cells.items() if metric.name in cell}
    torque = [task for task in means if task not in POSITION_TASKS]
    return max(torque, key=lambda task: metric.gain(means[task], 0.0), default=None)
