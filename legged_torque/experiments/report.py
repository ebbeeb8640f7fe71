"""The report of an experiment, as Markdown."""

from __future__ import annotations

import math
from itertools import combinations
from pathlib import Path

from legged_torque.experiments.curves import MILLION
from legged_torque.experiments.figures import FIGURES, file_name
from legged_torque.experiments.matrix import SETTINGS_FILE
from legged_torque.experiments.paper_values import MODELS, PAPER_METRICS, paper_value
from legged_torque.experiments.results import (
    EVALUATIONS_FILE,
    LAST_SHARE,
    TABLE_FILE,
    CellResult,
    Cells,
    Experiment,
    Summary,
    Table,
    compare,
    is_of_paper,
)
from legged_torque.utils.metrics import Metric
from legged_torque.utils.paths import portable_path

SIGNIFICANT = 0.05
BASELINES = ("a1_position", "a1_torque")


def report(experiment: Experiment, table: Table, from_step: float, figures: list[str], out: Path) -> str:
    """Return the report that ``out`` is to hold, beside the figures with the given titles."""
    missing = missing_lines(experiment, from_step)
    sections = {
        "What is missing": missing or ["Nothing: all trainings and evaluations are complete."],
        "Table I": table_one(experiment, table, from_step),
        "In other environments than those of training": other_table(table),
        "Differences": differences(table),
        "Figures": figure_lines(figures),
        "How it was made": setup_lines(experiment, from_step, out),
    }
    lines = [f"# Results of {experiment.folder.resolve().name}"]
    for title, section in sections.items():
        lines += ["", f"## {title}", "", *section]
    return "\n".join(lines) + "\n"


def markdown_table(header: list[str], rows: list[list[str]]) -> list[str]:
    """Return the lines of a table."""
    return [f"| {' | '.join(row)} |" for row in [header, ["---"] * len(header), *rows]]


def missing_lines(experiment: Experiment, from_step: float) -> list[str]:
    """Return a line for everything planned that is missing, unfinished or unreadable."""
    lines, plan = [], experiment.plan
    for task, environment in ((task, environment) for environment in plan.environments for task in plan.tasks):
        place, runs = f"- `{task}` in {environment}", experiment.runs_of(task, environment)
        begun = [run.cell.seed for run in runs]
        if not runs:
            lines.append(f"{place}: no data, no training has begun.")
        elif len(begun) < len(plan.seeds):
            absent = ", ".join(str(seed) for seed in plan.seeds if seed not in begun)
            lines.append(f"{place}: no training has begun with seed {absent}.")
        problems = {run.cell.seed: "; ".join(run_problems(run, from_step)) for run in runs}
        lines += [f"{place}, seed {seed}: {text}." for seed, text in problems.items() if text]
    if experiment.unplanned:
        lines.append(f"- Left out, as experiment.yaml does not name them: {', '.join(experiment.unplanned)}.")
    return lines


def run_problems(run: CellResult, from_step: float) -> list[str]:
    """Return the problems of a training: missing, unfinished or unreadable parts."""
    problems, total = list(run.notes), f"{run.total_steps / MILLION:.4g} million steps"
    if not run.rows:
        problems.append("no evaluation during training yet")
    elif not run.is_finished(run.steps):
        problems.append(f"not finished, {run.steps / MILLION:.4g} of {total} ({run.steps / run.total_steps:.0%})")
    if run.rows and run.steps < from_step:
        end = f"ends before {from_step / MILLION:g} million steps"
        problems.append(f"{end}; its number is the mean of its last {LAST_SHARE:.0%}")
    rows = run.counted_rows(run.cell.environment, from_step)
    for metric in PAPER_METRICS:
        count = sum(not math.isfinite(row[metric.name]) for row in rows)
        if count:
            problems.append(f"{count} of the {len(rows)} evaluations that count have no {metric.name}")
    for name in run.cell.evaluated_in:
        counted = run.counted_rows(name, from_step)
        if name == run.cell.environment:
            continue
        if not counted:
            problems.append(f"not evaluated in {name}")
        elif not run.is_finished(counted[-1]["steps"]):
            problems.append(f"evaluated in {name} after {counted[-1]['steps'] / MILLION:.4g} of {total}")
    return problems


def marked(text: str, is_significant: bool, *summaries: Summary) -> str:
    """Return an entry of a table: bold if it is significant, with a dagger if what it comes from is not final."""
    text = f"**{text}**" if is_significant else text
    return text if all(summary.is_final for summary in summaries) else f"{text} †"


def number(cells: Cells, task: str, metric: Metric) -> str:
    """Return an entry of Table I: mean, standard error, number of seeds; bold if significantly the best."""
    summary, digits = cells[task].get(metric.name), metric.digits
    if summary is None:
        return "–"
    error = "" if summary.standard_error is None else f" ± {summary.standard_error:.{digits}f}"
    text = f"{summary.mean:.{digits}f}{error} ({len(summary.values)})"
    return marked(text, is_best(cells, task, metric), summary)


def is_best(cells: Cells, task: str, metric: Metric) -> bool:
    """Return whether a task is significantly better than every other task that has a value."""
    means = {name: cell[metric.name].mean for name, cell in cells.items() if metric.name in cell}
    pairs = list(combinations(means, 2))
    own = [p for pair, p in zip(pairs, compare(cells, metric.name, pairs), strict=True) if task in pair]
    best = (min if metric.lower_is_better else max)(means.values())
    return means[task] == best and bool(own) and all(p is not None and p < SIGNIFICANT for p in own)


def metric_table(table: Table, columns: list[str]) -> list[str]:
    """Return the lines of a table with a row per metric and task, and the paper's values beside ours if it has any."""
    header = ["metric", "task"]
    for column in columns:
        header += [column, "paper"] if is_of_paper(column) else [column]
    rows = []
    for metric, task in ((metric, task) for metric in PAPER_METRICS for task in table[columns[0]]):
        row = [metric.label, f"`{task}` ({MODELS[task]})" if task in MODELS else f"`{task}`"]
        for column in columns:
            row.append(number(table[column], task, metric))
            if is_of_paper(column):
                paper = paper_value(task, column, metric.name)
                row.append("–" if paper is None else f"{paper:.{metric.digits}f}")
        rows.append(row)
    return markdown_table(header, rows)


def table_one(experiment: Experiment, table: Table, from_step: float) -> list[str]:
    """Return Table I next to the paper's."""
    num_planned = len(experiment.plan.seeds)
    return [
        f"Mean ± standard error over seeds (number of seeds, of {num_planned} that were planned). A seed's",
        "number is the mean of its evaluations during training, in the environment of training, from step",
        f"{from_step / MILLION:g} million on, or of the last {LAST_SHARE:.0%} if training has not come that far.",
        "`doubled` is trained in `high_frequency` and evaluated in `doubled` as well while it trains, or else has the",
        "number of the last checkpoint. The paper's numbers are means of all evaluations after step 90 million.",
        "**Bold**: significantly better than every other task of the column (see Differences). †: seeds are missing",
        "or trainings are not finished, so the number will change. Tracking % is better when higher, all else when",
        "lower. The paper's means are of four seeds; it prints no errors, and no numbers of default torque control.",
        "",
        *metric_table(table, [name for name in table if is_of_paper(name)]),
    ]


def other_table(table: Table) -> list[str]:
    """Return the metrics in environments other than those of training, which the paper does not have."""
    columns = [name for name in table if not is_of_paper(name)]
    if not columns:
        return ["None were planned."]
    text = "Trained -> evaluated, over seeds and evaluations as above. The paper has no such numbers."
    return [text, "", *metric_table(table, columns)]


def differences(table: Table) -> list[str]:
    """Return tests of all pairs of tasks in each column of Table I, and of each task against the baselines."""
    lines = [
        "First minus second task, and the p value of a two-sided Welch's t-test over seeds with Holm's correction.",
        "The tests of one metric in one table are one family.",
        f"**Bold**: p < {SIGNIFICANT}. †: seeds are missing or trainings are not finished. With so few seeds, a",
        "difference may be real without being significant. Tasks without data are left out.",
    ]
    for column in filter(is_of_paper, table):
        cells = table[column]
        lines += ["", f"### {column}"]
        tasks = [task for task in cells if cells[task]]
        families = {"All pairs": list(combinations(tasks, 2))}
        for baseline in (task for task in BASELINES if task in tasks):
            families[f"Against `{baseline}`"] = [(task, baseline) for task in tasks if task != baseline]
        for title, pairs in families.items():
            if all(p is None for metric in PAPER_METRICS for p in compare(cells, metric.name, pairs)):
                lines += ["", f"{title}: no test is possible; it takes at least two seeds of two tasks."]
            else:
                lines += ["", f"{title}:", "", *difference_table(cells, pairs)]
    return lines


def difference_table(cells: Cells, pairs: list[tuple[str, str]]) -> list[str]:
    """Return the differences of pairs of tasks in all metrics, with their p values."""
    rows = [[f"`{first}` - `{second}`"] for first, second in pairs]
    for metric in PAPER_METRICS:
        p_values = compare(cells, metric.name, pairs)
        for row, (first, second), p in zip(rows, pairs, p_values, strict=True):
            one, other = cells[first].get(metric.name), cells[second].get(metric.name)
            if one is None or other is None:
                row.append("no data")
                continue
            p_text = "no p value" if p is None else f"p = {p:.2g}"
            text = f"{one.mean - other.mean:+.{metric.digits}f}, {p_text}"
            row.append(marked(text, p is not None and p < SIGNIFICANT, one, other))
    return markdown_table(["pair", *(metric.label for metric in PAPER_METRICS)], rows)


def figure_lines(figures: list[str]) -> list[str]:
    """Return the figures, and which of the paper's are absent."""
    lines = [f"![{title}]({file_name(title)})\n" for title in figures]
    absent = [title for title in FIGURES if title not in figures]
    if absent:
        lines.append(f"No {', '.join(absent)}: there are no data for it.")
    return [*lines, f"The numbers are in `{TABLE_FILE}`, all evaluations in `{EVALUATIONS_FILE}`."]


def setup_lines(experiment: Experiment, from_step: float, out: Path) -> list[str]:
    """Return machines, versions, the plan and the commands that repeat the experiment."""
    devices = sorted({device for run in experiment.runs for device in run.devices})
    configs = [config for run in experiment.runs for config in run.configs]
    packages = [config["versions"] for config in configs if isinstance(config.get("versions"), dict)]
    versions = {", ".join(f"{name} {version}" for name, version in entry.items()) for entry in packages}
    plan = (experiment.folder / SETTINGS_FILE).read_text(encoding="utf-8", errors="replace")
    folder, report_folder = portable_path(experiment.folder), portable_path(out)
    return [
        f"- Devices, as named in settings and results: {', '.join(devices) or 'unknown'}",
        *(f"- Versions: {text}" for text in sorted(versions) or ["unknown"]),
        "- Plan (`experiment.yaml`); all settings of a training are in its `config.yaml`:",
        f"\n```yaml\n{plan.rstrip()}\n```\n",
        "To repeat it:",
        "",
        "```bash",
        f"python scripts/experiment.py {folder}/experiment.yaml --out {folder}_again",
        f"python scripts/report.py {folder}_again --out {report_folder}_again --from_step {from_step:.0f}",
        "```",
    ]
