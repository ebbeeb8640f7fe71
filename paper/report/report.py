"""The report on an experiment: tables, figures, Markdown, and one HTML page that refers to nothing outside of it."""

import base64
import gzip
import re
from datetime import timedelta
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd
import yaml
from markdown_it import MarkdownIt
from markupsafe import Markup

from legged_torque.experiments.matrix import SETTINGS_FILE
from legged_torque.experiments.times import describe, read_times
from legged_torque.paper.metrics import COMPARED, PAPER_METRICS
from legged_torque.paper.report import tables
from legged_torque.paper.report.evaluations import MILLION
from legged_torque.paper.report.experiment import LAST_SHARE, Experiment, Training, is_of_paper
from legged_torque.paper.report.figures import draw_all, file_name, planned_figures, rough_figures
from legged_torque.paper.report.figures_curves import FEW
from legged_torque.paper.report.robustness import condition_table, draw_sweep, find_sweeps, findings
from legged_torque.paper.report.style import in_words, method, name_of
from legged_torque.paper.report.tables import BETTER, WITHIN, WORSE, summarize
from legged_torque.paper.report.unplanned import differing
from legged_torque.paper.values import ENVIRONMENTS, PAPER_TASKS
from legged_torque.utils.config import flat
from legged_torque.utils.errors import UserError, counted
from legged_torque.utils.files import portable_path, without_machine, write_whole

MEDIA_TYPES = {".png": "image/png", ".gif": "image/gif", ".mp4": "video/mp4", ".webm": "video/webm"}
VIDEOS = [".gif", ".mp4", ".webm"]
CLASSES = {BETTER: "better", WITHIN: "within", WORSE: "worse"}
"""Classes of cells of the page's tables by their first character, which have colours."""


def write_report(experiment: Experiment, from_step: float, out: Path, videos: dict[str, Path]) -> tuple[int, int]:
    """Write tables, figures, ``report.md`` and ``report.html`` to a folder.

    Args:
        experiment: The results.
        from_step: Step of training from which evaluations count.
        out: The folder, created if it is missing.
        videos: Files by task; only the page shows them.

    Returns:
        How many figures there are, and how many lines on what is missing.
    """
    table = summarize(experiment, from_step)
    differences, environment = tables.find_differences(experiment, table), next(iter(experiment.plan.environments))
    first = {task: experiment.runs_of(task, environment) for task in experiment.plan.tasks}
    configs = {task: without_machine(some[0].configs[-1]) for task, some in first.items() if some and some[0].configs}
    planned, rough = planned_figures(experiment, table, differences), rough_figures(experiment)
    sweeps = find_sweeps(experiment)
    swept = {title: partial(draw_sweep, experiment.plan.tasks, sweep) for title, sweep in sweeps.items()}
    drawn = draw_all(experiment, planned | rough | swept, out)
    signs = {name: int((table["sign"] == sign).sum()) for sign, name in CLASSES.items()}
    values = {
        "title": f"Results of {experiment.folder.resolve().name}",
        "experiment": experiment,
        "table": table,
        "tables": tables,
        "from_step": from_step,
        "columns": list(filter(is_of_paper, experiment.columns())),
        "other_columns": [name for name in experiment.columns() if not is_of_paper(name)],
        "signs": signs | {"missing": len(COMPARED) * len(PAPER_TASKS) * len(ENVIRONMENTS) - sum(signs.values())},
        "baseline": method(tables.baseline_of(experiment.plan.tasks)),
        "differences": differences,
        "missing": missing_lines(experiment, from_step),
        "figures": [title for title in planned if title in drawn],
        "absent_figures": [title for title in planned if title not in drawn],
        "rough_figures": [title for title in rough if title in drawn],
        "conditions": {name: condition_table(experiment, name) for name in experiment.plan.environments},
        "sweeps": {title: findings(experiment.plan.tasks, sweep) for title, sweep in sweeps.items()},
        "setup": setup_lines(experiment),
        "plan": (experiment.folder / SETTINGS_FILE).read_text("utf-8", "replace") if experiment.is_planned else "",
        "folders": [portable_path(experiment.folder), portable_path(out)],
        "configs": configs,
    }
    filters = {"table": markdown_table, "fenced": fenced, "cell": cell, "one_line": one_line, "file_name": file_name}
    filters |= {"name_of": name_of, "in_words": in_words, "steps": steps_text}
    markdown = render("report.md.jinja", values, filters)
    body, headings = to_html(markdown, {file_name(title): out / file_name(title) for title in drawn})
    sources = {name_of(task): data_uri(file) for task, file in videos.items()}
    texts = {task: yaml.safe_dump(config, sort_keys=False) for task, config in configs.items()}
    page = {"title": values["title"], "body": body, "headings": headings, "videos": sources, "configs": texts}
    write_whole(out / "report.md", markdown)
    write_whole(out / "report.html", render("page.html.jinja", page, {}))
    write_tables(experiment, table, out)
    return len(drawn), len(values["missing"])


def render(template: str, values: dict[str, Any], filters: dict[str, Any]) -> str:
    """Return a template of this folder with its values, which HTML escapes."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=template.endswith(".html.jinja"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= filters
    return environment.get_template(template).render(values)


def missing_lines(experiment: Experiment, from_step: float) -> list[str]:
    """Return a line for everything planned that is missing, unfinished, unreadable, or of several settings."""
    lines, plan = list(experiment.problems), experiment.plan
    for environment, task in product(plan.environments, plan.tasks):
        where, runs = f"`{task}` in {in_words(environment)}", experiment.runs_of(task, environment)
        absent = sorted(set(plan.seeds if experiment.is_planned else ()) - {run.cell.seed for run in runs})
        if absent and runs:
            lines.append(f"{where}: no training has begun with seed {', '.join(map(str, absent))}.")
        elif absent:
            lines.append(f"{where}: no data, no training has begun.")
        problems = {run.cell.seed: "; ".join(run_problems(run, from_step)) for run in runs}
        lines += [f"{where}, seed {seed}: {text}." for seed, text in problems.items() if text]
        configs = [without_machine(config) for run in runs for config in run.configs]
        settings = [flat(config["env"]) | flat(config["train"]) for config in configs]
        settings = [{path: each[path] for path in each if all(path in one for one in settings)} for each in settings]
        if changes := sorted({change for each in settings for change in differing(each, settings)}):
            lines.append(f"{where}: its trainings have different settings: {', '.join(changes)}.")
    if experiment.unplanned:
        lines.append(f"Left out, as experiment.yaml does not name them: {', '.join(experiment.unplanned)}.")
    return lines


def run_problems(run: Training, from_step: float) -> list[str]:
    """Return the problems of a training: missing, unfinished or unreadable parts."""
    problems, total = list(run.problems), f"{run.total_steps / MILLION:.4g} million steps"
    if run.rows.empty:
        problems.append("no evaluation during training yet")
    elif not run.is_finished(run.steps):
        problems.append(f"not finished, {run.steps / MILLION:.4g} of {total} ({run.steps / run.total_steps:.0%})")
    if len(run.rows) and run.steps < from_step:
        end = f"ends before {from_step / MILLION:g} million steps"
        problems.append(f"{end}; its number is the mean of its last {LAST_SHARE:.0%}")
    rows = run.counted(run.cell.environment, from_step)
    for name, count in rows[[metric.name for metric in PAPER_METRICS]].isna().sum().items():
        problems += [f"{count} of the {len(rows)} evaluations that count have no {name}"] if count else []
    for name in (name for name in run.cell.evaluated_in if name != run.cell.environment):
        rows = run.counted(name, from_step)
        if rows.empty:
            problems.append(f"not evaluated in {in_words(name)}")
        elif not run.is_finished(steps := rows["steps"].iloc[-1]):
            problems.append(f"evaluated in {in_words(name)} after {steps / MILLION:.4g} of {total}")
    absent = [name for name in run.cell.further if name not in run.measured()]
    return problems + ([f"not evaluated: {', '.join(absent)}"] if absent else [])


def setup_lines(experiment: Experiment) -> list[str]:
    """Return devices, versions and times of an experiment, as far as they are known."""
    devices = sorted({device for run in experiment.runs for device in run.devices})
    packages = [config.get("versions") for run in experiment.runs for config in run.configs]
    versions = {
        ", ".join(f"{name} {text}" for name, text in entry.items()) for entry in packages if isinstance(entry, dict)
    }
    lines = [f"Devices, as named in settings and results: {', '.join(devices) or 'unknown'}"]
    lines += [f"Versions: {text}" for text in sorted(versions) or ["unknown"]]
    times = list(filter(None, (read_times(run.cell.folder) for run in experiment.runs)))
    lines += [f"{len(times)} of {counted(len(experiment.runs), 'training')}: {describe(times)}"] if times else []
    ends = pd.DataFrame([run.rows.iloc[-1] for run in experiment.runs if len(run.rows)])
    ends = ends[ends["seconds"] > 0.0] if len(ends) else ends
    if len(ends):
        total, speed = ends["seconds"].sum(), ends["steps"].sum() / ends["seconds"].sum()
        lines.append(
            f"{counted(len(ends), 'training')} took {timedelta(seconds=round(total))} in all, with their evaluations: "
            f"{total / len(ends):.4g} s and {steps_text(speed)} steps/s each on average; those that shared a device "
            "were slower for it"
        )
    return lines


def find_videos(folder: Path, tasks: list[str]) -> dict[str, Path]:
    """Return the videos in a folder by their tasks, after which they are named; a UserError if there are none."""
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    videos = {file.stem: file for file in files if file.stem in tasks and file.suffix in VIDEOS}
    if not videos:
        raise UserError(f"there is no video in '{folder}' that is named <task>{', <task>'.join(VIDEOS)}")
    return {task: videos[task] for task in tasks if task in videos}


def write_tables(experiment: Experiment, table: pd.DataFrame, out: Path) -> None:
    """Write all summaries as CSV, and every evaluation during training as compressed CSV, with four digits.

    With rough ground, its results are a third file.
    """
    summary = table.rename(columns={"paper": "paper_mean"}).reset_index(names=["environment", "task", "metric"])
    names = ["task", "environment", "metric", "iqm", "low", "high", "seeds", "paper_mean"]
    write_whole(out / "table.csv", summary[names].to_csv(index=False, lineterminator="\n"))
    text = experiment.evaluations().to_csv(index=False, float_format="%.4g", lineterminator="\n")
    write_whole(out / "evaluations.csv.gz", gzip.compress(text.encode(), mtime=0))  # the same bytes every time
    if experiment.has_rough_ground():
        write_whole(out / "grounds.csv", experiment.crossings().to_csv(index=False, lineterminator="\n"))


def steps_text(steps: float) -> str:
    """Return a number of steps in words: in millions, unless it is small."""
    return f"{steps / MILLION:.4g} million" if steps >= FEW * MILLION else f"{steps:,.0f}"


def one_line(text: str) -> str:
    """Return a text without line breaks, as an item of a Markdown list."""
    return " ".join(text.split())


def cell(text: str) -> str:
    """Return a text as a cell of a Markdown table."""
    return one_line(text.replace("|", "\\|"))


def markdown_table(rows: tables.Rows) -> str:
    """Return rows, of which the first one is the header, as a Markdown table."""
    lines = [" | ".join(map(cell, row)) for row in rows]
    return "\n".join(f"| {line} |" for line in [lines[0], " | ".join(["---"] * len(rows[0])), *lines[1:]])


def fenced(text: str, language: str) -> str:
    """Return a text as a code block of Markdown, between fences that it does not contain."""
    fence = "`" * max(3, *(len(ticks) + 1 for ticks in re.findall("`+", text)), 3)
    return f"{fence}{language}\n{text.rstrip()}\n{fence}"


def to_html(markdown: str, pictures: dict[str, Path]) -> tuple[Markup, dict[str, str]]:
    """Return Markdown as HTML that holds its pictures, files by name, and the headings of level 2 by anchor.

    It refers to nothing outside of the page: links, other pictures and HTML stay text.
    """
    parser = MarkdownIt("zero").enable(["backticks", "emphasis", "fence", "heading", "image", "list", "table"])
    parser.validateLink = pictures.__contains__  # type: ignore[assignment, method-assign]
    tokens, headings = parser.parse(markdown), {}
    for token, inner, text in zip(tokens, tokens[1:], tokens[2:], strict=False):
        if token.type == "heading_open" and token.tag == "h2":
            anchor = re.sub(r"\W+", "-", inner.content.lower()).strip("-")
            token.attrSet("id", anchor)
            headings[anchor] = inner.content
        elif token.type == "td_open" and inner.content[:1] in CLASSES:
            token.attrSet("class", CLASSES[inner.content[:1]])
        elif token.type == "tr_open" and text.content == "":  # of the group of the row above
            token.attrSet("class", "more")
        for picture in (child for child in token.children or [] if child.type == "image"):
            picture.attrSet("src", data_uri(pictures[str(picture.attrs["src"])]))
    return Markup(parser.renderer.render(tokens, parser.options, {})), headings


def data_uri(file: Path) -> str:
    """Return the contents of a picture or video as an address that can stand in a page."""
    return f"data:{MEDIA_TYPES[file.suffix]};base64,{base64.b64encode(file.read_bytes()).decode()}"
