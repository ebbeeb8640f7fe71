"""The report of an experiment, in blocks that become Markdown and HTML."""

from __future__ import annotations

import math
from datetime import timedelta
from itertools import combinations
from pathlib import Path

import yaml

from legged_torque.experiments.matrix import ROUGH_GROUND, SETTINGS_FILE, Matrix
from legged_torque.experiments.times import add_up, describe, read_times
from legged_torque.paper.report.against_paper import MEANINGS, best_torque, count, marked, number_text
from legged_torque.paper.report.blocks import VIDEO_TYPES, Block, Bullets, Code, Grid, Heading, Paragraph, Picture
from legged_torque.paper.report.curves import MILLION
from legged_torque.paper.report.figures import file_name, planned_figures, rough_figures
from legged_torque.paper.report.figures_style import method, name_of, seeds_text
from legged_torque.paper.report.grounds import MEASURES, kinds_of, over_levels
from legged_torque.paper.report.results import (
    EVALUATIONS_FILE,
    GROUNDS_FILE,
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
from legged_torque.paper.report.tables import SIGNIFICANT, metric_table
from legged_torque.paper.values import PAPER_METRICS
from legged_torque.utils.config import flat
from legged_torque.utils.errors import UserError
from legged_torque.utils.paths import portable_path, without_machine

BASELINES = ("a1_position", "a1_torque")


def report(
    experiment: Experiment, table: Table, from_step: float, figures: list[str], out: Path, videos: dict[str, Path]
) -> list[Block]:
    """Return the report that ``out`` is to hold, beside the figures with the given titles.

    ``videos`` are files by task; only the HTML page has them.
    """
    missing = missing_lines(experiment, from_step)
    complete = Paragraph("Nothing: all trainings and evaluations are complete.")
    walking: dict[str, list[Block]]
    if experiment.is_like_paper():
        walking = {
            "Table I": table_one(experiment, table, from_step),
            "Best torque method against the paper's best": best_torque(table),
        }
    else:
        walking = {"While training": own_table(experiment, table, from_step)}
    sections: dict[str, list[Block]] = {
        "Rough ground": rough_blocks(experiment, figures, out),
        **walking,
        "What is missing": [Bullets(missing) if missing else complete],
        "In other environments than those of training": other_table(experiment, table),
        "Differences": differences(table),
        "Figures": figure_blocks(experiment, table, figures, out),
        "Videos": [Picture(name_of(task), file) for task, file in videos.items()],
        "How it was made": setup_blocks(experiment, from_step, out),
    }
    return [block for title, section in sections.items() if section for block in (Heading(title), *section)]


def missing_lines(experiment: Experiment, from_step: float) -> list[str]:
    """Return a line for everything planned that is missing, unfinished or unreadable."""
    lines, plan = list(experiment.notes), experiment.plan
    for task, environment in ((task, environment) for environment in plan.environments for task in plan.tasks):
        place, runs = f"`{task}` in {environment}", experiment.runs_of(task, environment)
        begun = [run.cell.seed for run in runs]
        if not runs and experiment.is_planned:
            lines.append(f"{place}: no data, no training has begun.")
        elif len(begun) < experiment.num_expected(task, environment):
            absent = ", ".join(str(seed) for seed in plan.seeds if seed not in begun)
            lines.append(f"{place}: no training has begun with seed {absent}.")
        problems = {run.cell.seed: "; ".join(run_problems(run, from_step)) for run in runs}
        lines += [f"{place}, seed {seed}: {text}." for seed, text in problems.items() if text]
    if experiment.unplanned:
        lines.append(f"Left out, as experiment.yaml does not name them: {', '.join(experiment.unplanned)}.")
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
    if run.cell.crosses and not run.crossings:
        problems.append(f"not evaluated on {ROUGH_GROUND}")
    return problems


def table_one(experiment: Experiment, table: Table, from_step: float) -> list[Block]:
    """Return Table I next to the paper's."""
    texts = (
        count(table),
        f"Mean ± standard error over {seeds_text(len(experiment.plan.seeds))} (how many, if not all), "
        f"{experiment.ranges()} ranges. {what_counts(from_step)} `doubled` is trained in `high_frequency` and "
        "evaluated in `doubled` as well while it trains, or else has the number of the last checkpoint. The "
        "paper's numbers are means of four seeds and of all evaluations after step 90 million; it prints no errors, "
        "and no numbers of default torque control.",
        "**Bold**: significantly better than every other task of the column (see Differences). †: seeds are missing or "
        "trainings are not finished, so the number will change. With one seed, the standard error counts as 0.",
        methods_text(experiment),
        *(
            ["With other ranges than `default`, it is not the paper's task."]
            if experiment.ranges() != "default"
            else []
        ),
    )
    legend = Grid(["sign", "meaning"], list(MEANINGS.items()))
    columns = [name for name in table if is_of_paper(name)]
    return [*map(Paragraph, texts), legend, metric_table(experiment, table, columns)]


def own_table(experiment: Experiment, table: Table, from_step: float) -> list[Block]:
    """Return the metrics of an experiment of the user's own; nothing if all are in :func:`other_table`."""
    columns = [name for name in table if is_of_paper(name)]
    if not columns:
        return []
    planned = f"{seeds_text(len(experiment.plan.seeds))} (how many, if not all)"
    seeds = planned if experiment.is_planned else "seeds (how many)"
    text = (
        f"Mean ± standard error over {seeds}, {experiment.ranges()} ranges. {what_counts(from_step)} **Bold**: "
        "significantly better than every other task of the column. †: seeds are missing or trainings are not finished."
    )
    grid = metric_table(experiment, table, columns)
    beside = " The paper's numbers, beside ours, are means of four seeds after step 90 million."
    return [Paragraph(text + (beside if "paper" in grid.header else "")), Paragraph(methods_text(experiment)), grid]


def methods_text(experiment: Experiment) -> str:
    """Return which task each method is."""
    named = [task for task in experiment.plan.tasks if name_of(task) != task]
    return f"Methods: {', '.join(f'{name_of(task)} is `{task}`' for task in named)}." if named else ""


def what_counts(from_step: float) -> str:
    """Return in words what the number of a seed is."""
    return (
        "Tracking % is better when higher, all else when lower. A seed's number is the mean of its evaluations during "
        f"training from step {from_step / MILLION:.4g} million on, or of the last {LAST_SHARE:.0%} if training has not "
        "come that far."
    )


def rough_blocks(experiment: Experiment, figures: list[str], out: Path) -> list[Block]:
    """Return what came out on rough ground; nothing if there is no plan for it nor a result."""
    plan = experiment.plan
    if not experiment.has_grounds():
        return []
    text = (
        f"On each kind and difficulty, {plan.grounds.get('num_envs', 'some')} robots start in the middle of a tile, "
        "are told to walk straight on, and cross it if the trunk gets over its edge in time, see docs/terrain.md. "
        "In tables are means over all difficulties, ± standard errors over seeds, in brackets how many if not all. "
        f"All tiles are in `{GROUNDS_FILE}`."
    )
    titles = [title for title in rough_figures(experiment) if title in figures]
    blocks: list[Block] = [Paragraph(text), *(Picture(title, out / file_name(title)) for title in titles)]
    for environment in plan.environments:
        runs = {task: experiment.runs_of(task, environment) for task in plan.tasks}
        seeds = {task: [run.crossings for run in some] for task, some in runs.items() if some or experiment.is_planned}
        kinds = kinds_of([each for some in seeds.values() for each in some])
        blocks += [Heading(environment, 3)] if kinds or experiment.is_planned else []
        for measure, (meaning, digits) in MEASURES.items() if kinds else []:
            rows = []
            for task, some in seeds.items():
                means = [[over_levels(each, measure, kind) for each in some] for kind in [*kinds, None]]
                rows.append([method(task), *(mean_text(part, digits, plan) for part in means)])
            blocks += [Paragraph(f"{meaning}:"), Grid(["task", *kinds, "all"], rows)]
    return blocks


def mean_text(values: list[float], digits: int, plan: Matrix) -> str:
    """Return mean and standard error of the finite values of seeds, and how many they are if not all."""
    finite = [value for value in values if math.isfinite(value)]
    return number_text(Summary(finite), digits, len(plan.seeds)) if finite else "–"


def other_table(experiment: Experiment, table: Table) -> list[Block]:
    """Return the metrics in environments other than those of training, which the paper does not have."""
    columns = [name for name in table if not is_of_paper(name)]
    text = "Trained -> evaluated, over seeds and evaluations as above. The paper has no such numbers."
    if not columns:
        return [Paragraph("None were planned.")] if experiment.is_planned else []
    return [Paragraph(text), metric_table(experiment, table, columns)]


def differences(table: Table) -> list[Block]:
    """Return tests of all pairs of tasks in each column of Table I, and of each task against the baselines."""
    text = (
        "First minus second task, and the p value of a two-sided Welch's t-test over seeds with Holm's correction. The "
        f"tests of one metric in one table are one family. **Bold**: p < {SIGNIFICANT}. †: seeds are missing or "
        "trainings are not finished. With so few seeds, a difference may be real without being significant. Tasks "
        "without data are left out."
    )
    blocks: list[Block] = [Paragraph(text)]
    for column in filter(is_of_paper, table):
        cells = table[column]
        blocks.append(Heading(column, 3))
        tasks = [task for task in cells if cells[task]]
        families = {"All pairs": list(combinations(tasks, 2))}
        for baseline in (task for task in BASELINES if task in tasks):
            families[f"Against {method(baseline)}"] = [(task, baseline) for task in tasks if task != baseline]
        for title, pairs in families.items():
            if all(p is None for metric in PAPER_METRICS for p in compare(cells, metric.name, pairs)):
                blocks.append(Paragraph(f"{title}: no test is possible; it takes at least two seeds of two tasks."))
            else:
                blocks += [Paragraph(f"{title}:"), difference_table(cells, pairs)]
    return blocks


def difference_table(cells: Cells, pairs: list[tuple[str, str]]) -> Grid:
    """Return the differences of pairs of tasks in all metrics, with their p values."""
    rows = [[f"{method(first)} − {method(second)}"] for first, second in pairs]
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
    return Grid(["pair", *(metric.label for metric in PAPER_METRICS)], rows)


def figure_blocks(experiment: Experiment, table: Table, figures: list[str], out: Path) -> list[Block]:
    """Return the figures, and which of them are absent."""
    titles = list(planned_figures(experiment, table))
    blocks: list[Block] = [Picture(title, out / file_name(title)) for title in titles if title in figures]
    absent = [title for title in titles if title not in figures]
    if absent:
        blocks.append(Paragraph(f"No {', '.join(absent)}: there are no data for it."))
    return [*blocks, Paragraph(f"The numbers are in `{TABLE_FILE}`, all evaluations in `{EVALUATIONS_FILE}`.")]


def find_videos(folder: Path, tasks: list[str]) -> dict[str, Path]:
    """Return the videos in a folder by their tasks, after which they are named; a UserError if there are none."""
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    videos = {file.stem: file for file in files if file.stem in tasks and file.suffix in VIDEO_TYPES}
    if not videos:
        raise UserError(f"there is no video in '{folder}' that is named <task>{', <task>'.join(VIDEO_TYPES)}")
    return {task: videos[task] for task in tasks if task in videos}


def setup_blocks(experiment: Experiment, from_step: float, out: Path) -> list[Block]:
    """Return machines, times, versions, settings, the plan and the commands that repeat the experiment."""
    devices = sorted({device for run in experiment.runs for device in run.devices})
    configs = [config for run in experiment.runs for config in run.configs]
    packages = [config["versions"] for config in configs if isinstance(config.get("versions"), dict)]
    versions = {", ".join(f"{name} {version}" for name, version in entry.items()) for entry in packages}
    items = [f"Devices, as named in settings and results: {', '.join(devices) or 'unknown'}"]
    items += [f"Versions: {text}" for text in sorted(versions) or ["unknown"]]
    items += time_texts(experiment)
    origin = plan_blocks(experiment, from_step, out) if experiment.is_planned else run_blocks(experiment)
    return [Bullets(items), *origin, *settings_blocks(experiment)]


def plan_blocks(experiment: Experiment, from_step: float, out: Path) -> list[Block]:
    """Return the plan, and the commands that repeat it."""
    plan = (experiment.folder / SETTINGS_FILE).read_text(encoding="utf-8", errors="replace")
    folder, report_folder = portable_path(experiment.folder), portable_path(out)
    commands = f"python scripts/experiment.py {folder}/experiment.yaml --out {folder}_again\n"
    commands += f"python scripts/report.py {folder}_again --out {report_folder}_again --from_step {from_step:.0f}"
    blocks: list[Block] = [Paragraph("Plan (`experiment.yaml`):"), Code(plan, "yaml")]
    return [*blocks, Paragraph("To repeat it:"), Code(commands, "bash")]


def run_blocks(experiment: Experiment) -> list[Block]:
    """Return what the trainings without a plan are, and what counts as one of them."""
    text = (
        "There is no `experiment.yaml`, so these are the trainings that the folder holds. Runs of the same "
        "task, `--run_name`, settings, random events and seed are one training that was resumed; of two that both "
        "begin at 0, the later counts. Settings that differ between runs of a task stand behind its name."
    )
    steps = [f"{run.steps / MILLION:.4g} of {run.total_steps / MILLION:.4g}" for run in experiment.runs]
    rows = [
        [f"`{run.cell.task}`", run.cell.environment, str(run.cell.seed), run.cell.name, done]
        for run, done in zip(experiment.runs, steps, strict=True)
    ]
    return [Paragraph(text), Grid(["task", "environment", "seed", "last run", "million steps"], rows)]


def time_texts(experiment: Experiment) -> list[str]:
    """Return how long training took, and how much time of devices the experiment, as far as it is known."""
    ends = [run.rows[-1] for run in experiment.runs if run.rows and run.rows[-1]["seconds"] > 0.0]
    texts = [describe(add_up(read_times(run.cell.folder) for run in experiment.runs))]
    if ends:
        seconds, steps = (sum(row[name] for row in ends) for name in ("seconds", "steps"))
        text = f"{len(ends)} trainings took {timedelta(seconds=round(seconds))} in all, with their evaluations: "
        text += f"{seconds / len(ends):.4g} s and {steps / seconds / MILLION:.3g} million steps/s each on average"
        texts.append(f"{text}; those that shared a device were slower for it")
    return [text for text in texts if text]


def settings_blocks(experiment: Experiment) -> list[Block]:
    """Return the settings of a training of each task in the first environment, and in which of them tasks differ."""
    environment = next(iter(experiment.plan.environments))
    runs = {task: experiment.runs_of(task, environment) for task in experiment.plan.tasks}
    configs = {task: without_machine(some[0].configs[-1]) for task, some in runs.items() if some and some[0].configs}
    settings = {task: flat({key: config[key] for key in ("env", "train")}) for task, config in configs.items()}
    paths = dict.fromkeys(path for values in settings.values() for path in values)
    rows = [[f"`{path}`", *(str(values.get(path, "–")) for values in settings.values())] for path in paths]
    different = [row for row in rows if len(set(row[1:])) > 1]
    grid = Grid(["setting", *(f"`{task}`" for task in settings)], different)
    text = f"Settings of trainings in `{environment}` that differ between tasks; the `config.yaml` of each run has all."
    texts = {f"All settings of `{task}`": yaml.safe_dump(config, sort_keys=False) for task, config in configs.items()}
    blocks: list[Block] = [Paragraph(text), grid] if different else []
    return blocks + [Code(text, "yaml", title) for title, text in texts.items()]
