"""The experiment against Table I of the paper: which numbers are as good, and the best torque methods."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from legged_torque.paper.report.blocks import BETTER, WITHIN, WORSE, Block, Grid, Paragraph
from legged_torque.paper.report.figures_style import method
from legged_torque.paper.report.results import Cells, Summary, Table
from legged_torque.paper.values import ENVIRONMENTS, MODELS, PAPER_METRICS, paper_column
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
    good = (
        f"**{better + within} of {len(signs)} numbers are at least as good as the paper's within one standard error**"
    )
    return f"{good} of ours: {better} are better, {within} within it, {worse} worse, {missing} missing."


def best_torque(table: Table) -> list[Block]:
    """Return the best torque method against the paper's best, by metric and environment of training."""
    trained = [name for name in ENVIRONMENTS if name != "doubled"]
    rows = [best_row(table.get(name, {}), metric, name) for metric, name in itertools.product(PAPER_METRICS, trained)]
    reached = sum(row[-1].startswith(BETTER) for row in rows)
    texts = (
        f"**In {reached} of {len(rows)} rows the best torque method is better than the paper's best by {TARGET:.0%} or",
        f"more** ({BETTER}; {WITHIN}: better by less, {WORSE}: not better). Torque methods are all but",
        f"{', '.join(map(method, POSITION_TASKS))}; the best has the best mean. Positive percentages",
        "are better, whichever direction that is.",
    )
    header = ["metric", "environment", "paper's best", "our best torque method", "ours", "better by"]
    return [Paragraph(" ".join(texts)), Grid(header, rows)]


def best_row(cells: Cells, metric: Metric, column: str) -> list[str]:
    """Return the row of :func:`best_torque` for a metric in a column of the table."""
    papers = paper_column(column, metric.name)
    model = max(papers, key=lambda task: metric.gain(papers[task], 0.0))
    row = [metric.label, column, f"{papers[model]:.{metric.digits}f} ({MODELS[model]})"]
    found = {task: cell[metric.name] for task, cell in cells.items() if metric.name in cell}
    torque = [task for task in found if task not in POSITION_TASKS]
    if not torque:
        return [*row, "no data", "", ""]
    task = max(torque, key=lambda task: metric.gain(found[task].mean, 0.0))
    share = judge(metric, found[task], papers[model]).share
    sign = BETTER if share >= TARGET else WITHIN if share > 0.0 else WORSE
    ours = marked(number_text(found[task], metric.digits), False, found[task])
    return [*row, method(task), ours, f"{sign} {share:+.1%}"]


def number_text(summary: Summary, digits: int, planned: int = 0) -> str:
    """Return mean and standard error with so many decimals, and the number of seeds if it is not the planned one."""
    error = "" if summary.standard_error is None else f" ± {summary.standard_error:.{digits}f}"
    count = "" if len(summary.values) == planned else f" ({len(summary.values)})"
    return f"{summary.mean:.{digits}f}{error}{count}"


def marked(text: str, is_significant: bool, *summaries: Summary) -> str:
    """Return an entry of a table: bold if it is significant, with a dagger if what it comes from is not final."""
    text = f"**{text}**" if is_significant else text
    return text if all(summary.is_final for summary in summaries) else f"{text} †"
