"""The report of an experiment, as Markdown."""

from __future__ import annotations

import math
from itertools import combinations
from pathlib import Path
from statistics import fmean

from legged_torque.experiments.figures import BARS, CURVES
from legged_torque.experiments.paper_values import METRICS, MODELS, paper_value
from legged_torque.experiments.report import LAST_SHARE, Experiment, Run, Table, compare

SIGNIFICANT = 0.05
BASELINES = ("a1_position", "a1_torque")


def report(
    experiment: Experiment, table: Table, from_step: float, figures: list[str], no_figures: str, out: Path
) -> str:
    """Return the report.

    Args:
        experiment: What was run.
        table: Its summaries.
        from_step: Where the evaluations begin that count.
        figures: Names of the figures that were drawn.
        no_figures: Why others were not; empty if there was nothing to draw.
        out: The report's folder.
    """
    missing = missing_lines(experiment, from_step)
    sections = [
        f"# Results of {experiment.folder.resolve().name}",
        section("What is missing", missing or ["Nothing: all trainings and evaluations are complete."]),
        section("Table I", table_one(experiment, table, from_step)),
        section("In other environments than those of training", other_table(experiment, table)),
        section("Differences", differences(experiment, table)),
        section("Figures", figure_lines(figures, no_figures)),
        section("How it was made", setup_lines(experiment, from_step, out)),
    ]
    return "\n\n".join(sections) + "\n"


def section(title: str, lines: list[str]) -> str:
    """Return a section of the report; one without lines is empty."""
    return "\n".join([f"## {title}", "", *lines])


def markdown_table(header: list[str], rows: list[list[str]]) -> list[str]:
    """Return the lines of a table."""
    return [f"| {' | '.join(row)} |" for row in [header, ["---"] * len(header), *rows]]


def name_of(task: str) -> str:
    """Return a task's name and that of the paper."""
    return f"`{task}` ({MODELS[task]})" if task in MODELS else f"`{task}`"


def missing_lines(experiment: Experiment, from_step: float) -> list[str]:
    """Return a line for everything that was planned and is not there, not finished or not readable."""
    lines = []
    for environment, evaluated in experiment.environments.items():
        for task in experiment.tasks:
            runs = experiment.runs_of(task, environment)
            absent = [str(seed) for seed in experiment.seeds if (task, environment, seed) not in experiment.runs]
            if not runs:
                lines.append(f"- `{task}` in {environment}: no data, no training has begun.")
            elif absent:
                lines.append(f"- `{task}` in {environment}: no training has begun with seed {', '.join(absent)}.")
            for run in runs:
                problems = run_problems(run, evaluated, from_step)
                lines += [f"- `{task}` in {environment}, seed {run.seed}: {'; '.join(problems)}."] if problems else []
    if experiment.unplanned:
        lines.append(f"- Left out, as experiment.yaml does not name them: {', '.join(experiment.unplanned)}.")
    return lines


def run_problems(run: Run, evaluated: list[str], from_step: float) -> list[str]:
    """Return what is missing, not finished or not readable of a run."""
    problems = list(run.notes)
    if not run.rows:
        problems.append("no evaluation during training yet")
    elif not run.is_finished(run.steps):
        text = f"not finished, {run.steps / 1e6:.4g} of {run.total_steps / 1e6:.4g} million steps"
        problems.append(f"{text} ({run.steps / run.total_steps:.0%})")
    if run.rows and run.steps < from_step:
        problems.append(
            f"ends before {from_step / 1e6:g} million steps; its number is the mean of its last {LAST_SHARE:.0%}"
        )
    rows = run.counted_rows(run.environment, from_step)
    for metric in METRICS:
        count = sum(not math.isfinite(row[metric]) for row in rows)
        if count:
            problems.append(f"{count} of the {len(rows)} evaluations that count have no {metric}")
    for name in evaluated:
        if name == run.environment:
            continue
        if name not in run.results:
            problems.append(f"not evaluated in {name}")
        elif not run.is_finished(run.results[name]["steps"]):
            steps = run.results[name]["steps"] / 1e6
            problems.append(f"evaluated in {name} after {steps:.4g} of {run.total_steps / 1e6:.4g} million steps")
    return problems


def number(table: Table, experiment: Experiment, column: str, task: str, metric: str) -> str:
    """Return a number of Table I: mean, standard error, seeds; bold if better than each other task, significantly."""
    summary, digits = table[column][task].get(metric), METRICS[metric].digits
    if summary is None:
        return "–"
    error = "" if summary.standard_error is None else f" ± {summary.standard_error:.{digits}f}"
    text = f"{fmean(summary.values):.{digits}f}{error} ({len(summary.values)})"
    if is_best(table[column], task, metric):
        text = f"**{text}**"
    return text if summary.is_final else f"{text} †"


def is_best(cells: dict, task: str, metric: str) -> bool:
    """Return whether a task is significantly better than each other one that has a value."""
    tasks = [name for name in cells if metric in cells[name]]
    pairs = list(combinations(tasks, 2))
    p_values = dict(zip(pairs, compare(cells, metric, pairs), strict=True))
    means = {name: fmean(cells[name][metric].values) for name in tasks}
    best = (max if METRICS[metric].higher_is_better else min)(means, key=means.get)
    own = [p for pair, p in p_values.items() if task in pair]
    return task == best and bool(own) and all(p is not None and p < SIGNIFICANT for p in own)


def table_one(experiment: Experiment, table: Table, from_step: float) -> list[str]:
    """Return Table I next to the paper's."""
    columns = [name for name in table if " -> " not in name]
    header = ["metric", "task", *(cell for name in columns for cell in (name, "paper"))]
    rows = []
    for metric, meaning in METRICS.items():
        for task in experiment.tasks:
            row = [meaning.label(), name_of(task)]
            for column in columns:
                paper = paper_value(task, column, metric)
                own = number(table, experiment, column, task, metric)
                row += [own, "–" if paper is None else f"{paper:.{meaning.digits}f}"]
            rows.append(row)
    return [
        f"Mean ± standard error over seeds (number of seeds, of {len(experiment.seeds)} that were planned). A seed's",
        "number is the mean of its evaluations during training, in the environment of training, from step",
        f"{from_step / 1e6:g} million on, or of the last {LAST_SHARE:.0%} if it has not come so far. Only `doubled` is",
        "different: trained in `high_frequency`, and the last checkpoint evaluated in `doubled`, while the paper's",
        "column is the mean of all evaluations after step 90 million.",
        "**Bold**: significantly better than each other task of the column (see Differences). †: seeds are missing or",
        "trainings are not finished; this will change. Tracking % is better when higher, all else when lower. The",
        "paper's means are of four seeds; it prints no errors, and no numbers of default torque control.",
        "",
        *markdown_table(header, rows),
    ]


def other_table(experiment: Experiment, table: Table) -> list[str]:
    """Return the metrics where the environments of training and evaluation differ, which the paper does not have."""
    columns = [name for name in table if " -> " in name]
    if not columns:
        return ["None were planned."]
    rows = []
    for metric, meaning in METRICS.items():
        for task in experiment.tasks:
            numbers = [number(table, experiment, column, task, metric) for column in columns]
            rows.append([meaning.label(), name_of(task), *numbers])
    text = "Trained -> evaluated: metrics of the last checkpoint, over seeds as above. The paper has no such numbers."
    return [text, "", *markdown_table(["metric", "task", *columns], rows)]


def differences(experiment: Experiment, table: Table) -> list[str]:
    """Return tests of all pairs of tasks in each column of Table I, and of each task against the baselines."""
    lines = [
        "First minus second task, and the p value of a two-sided Welch's t-test over seeds (own implementation,",
        "without scipy) with Holm's correction; the tests of one metric in one table are one family.",
        f"**Bold**: p < {SIGNIFICANT}. †: of tasks with seeds or steps missing. With so few seeds, a difference",
        "that is not significant can still be there. Tasks without data are left out.",
    ]
    for column, cells in table.items():
        if " -> " in column:
            continue
        lines += ["", f"### {column}"]
        tasks = [task for task in experiment.tasks if cells[task]]
        families = {"All pairs": list(combinations(tasks, 2))}
        for baseline in BASELINES:
            if baseline in tasks:
                others = [task for task in tasks if task != baseline]
                families[f"Against `{baseline}`"] = [(task, baseline) for task in others]
        for title, pairs in families.items():
            if all(p is None for metric in METRICS for p in compare(cells, metric, pairs)):
                lines += ["", f"{title}: cannot be told, which takes two seeds at least of two tasks."]
            else:
                lines += ["", f"{title}:", "", *difference_table(cells, pairs)]
    return lines


def difference_table(cells: dict, pairs: list[tuple[str, str]]) -> list[str]:
    """Return the differences of pairs of tasks in all metrics."""
    rows = [[f"`{first}` - `{second}`"] for first, second in pairs]
    for metric, meaning in METRICS.items():
        for row, pair, p in zip(rows, pairs, compare(cells, metric, pairs), strict=True):
            both = [cells[task].get(metric) for task in pair]
            if None in both:
                row.append("no data")
                continue
            difference = fmean(both[0].values) - fmean(both[1].values)
            text = f"{difference:+.{meaning.digits}f}, " + ("p cannot be told" if p is None else f"p = {p:.2g}")
            text = f"**{text}**" if p is not None and p < SIGNIFICANT else text
            row.append(text if all(summary.is_final for summary in both) else f"{text} †")
    return markdown_table(["pair", *(metric.label() for metric in METRICS.values())], rows)


def figure_lines(figures: list[str], problem: str) -> list[str]:
    """Return the figures, and which ones there are none of."""
    titles = {name: settings[0] for name, settings in {**CURVES, **BARS}.items()}
    lines = [f"![{titles[name]}]({name}.png)\n" for name in figures]
    absent = [title for name, title in titles.items() if name not in figures]
    if absent:
        lines.append(f"No {', '.join(absent)}: {problem or 'there are no data for it'}.")
    return [*lines, "Each is there as SVG too. The numbers are in `table.csv`, all evaluations in `evaluations.csv`."]


def setup_lines(experiment: Experiment, from_step: float, out: Path) -> list[str]:
    """Return machines, versions, the plan and the commands that repeat the experiment."""
    devices = sorted({device for run in experiment.runs.values() for device in run.devices})
    configs = [config for run in experiment.runs.values() for config in run.configs]
    versions = {", ".join(f"{k} {v}" for k, v in (config.get("versions") or {}).items()) for config in configs}
    return [
        f"- Devices, as settings and results name them: {', '.join(devices) or 'not told'}",
        *(f"- Versions: {text or 'not told'}" for text in sorted(versions)),
        "- Plan (`experiment.yaml`); all settings of a training are in its `config.yaml`:",
        "",
        "```yaml",
        experiment.plan.rstrip(),
        "```",
        "",
        "To repeat it:",
        "",
        "```bash",
        f"python scripts/experiment.py {experiment.folder}/experiment.yaml --out {experiment.folder}_again",
        f"python scripts/report.py {experiment.folder}_again --out {out}_again --from_step {from_step:.0f}",
        "```",
    ]
