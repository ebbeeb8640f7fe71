"""Made-up results of experiments and runs, and a reader of HTML pages."""

import json
from html.parser import HTMLParser

import yaml
from support.scripts import run_here

from legged_torque.paper.report.evaluations import METRIC_NAMES
from legged_torque.paper.values import TABLE_I

HEADER = ",".join(["steps,iteration,seconds", *METRIC_NAMES])
SETTINGS = {
    "env": {"env": {"num_envs": 1000}},
    "train": {"runner": {"num_steps_per_env": 1000}},  # a million steps per iteration
    "max_iterations": 110,
    "device": "cuda:0",
    "versions": {"python": "3.11.0", "torch": "2.11.0"},
}
SIGNS = {"✓": "better", "≈": "within", "✗": "worse"}


def line(million, tracking, **others):
    """A line of evaluations.csv: all metrics are 10 times the tracking, if they are not given."""
    values = dict.fromkeys(METRIC_NAMES, 10.0 * tracking) | {"track_percentage": tracking} | others
    return f"{million * 1_000_000},{million},{million}.5," + ",".join(str(values[name]) for name in METRIC_NAMES)


def whole_run(tracking, **others):
    """Lines of a finished training: bad before step 90 million, then around the given value."""
    values = {10: 0.1, 80: 0.2, 90: tracking - 0.05, 100: tracking, 110: tracking + 0.05}
    return [line(million, value, **others) for million, value in values.items()]


def write_rows(file, lines):
    """Write a table of evaluations."""
    file.write_text("\n".join([HEADER, *lines]) + "\n")


def write_run(folder, lines, config):
    """Write the folder of a run."""
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    write_rows(folder / "evaluations.csv", lines)


def write_part(folder, lines, **settings):
    """Write the folder of a run of an experiment."""
    write_run(folder, lines, {"task": folder.parent.name.split("-")[0], **SETTINGS, **settings})


def write_result(cell, environment, tracking, steps=110_000_000):
    """Write the evaluation of a last checkpoint in an environment."""
    metrics = {name: {"mean": tracking, "standard_error": 0.01} for name, _ in TABLE_I}
    result = {"task": "any", "steps": steps, "device": "NVIDIA H200", "metrics": metrics}
    (cell / f"result_{environment}.json").write_text(json.dumps(result))


def write_experiment(folder, environments=None, seeds=(1, 2), tasks=("a1_position", "a1_torque", "a1_multihead")):
    """Write the plan of an experiment."""
    folder.mkdir(parents=True, exist_ok=True)
    environments = environments or {"low": ["low", "high"], "high_frequency": ["high_frequency", "doubled"]}
    plan = {"tasks": list(tasks), "environments": environments, "seeds": list(seeds)}
    (folder / "experiment.yaml").write_text(yaml.safe_dump(plan, sort_keys=False))


def write_grounds(cell, crossed):
    """Write an evaluation on tiles: shares of robots by kind and level; tracking is a tenth of it."""
    cell.mkdir(parents=True, exist_ok=True)
    entries = []
    for (kind, level), share in crossed.items():
        metrics = {"track_percentage": {"mean": share / 10}, "cost_of_transport": {"mean": None}}
        tile = {"kind": kind, "level": level, "crossed": {"mean": share}, "fell": {"mean": 0.25}}
        entries.append(tile | {"metrics": metrics})
    (cell / "grounds.json").write_text(json.dumps({"grounds": entries}))


def run_report(*words, root):
    """Run the script in a folder; return its status, output and errors."""
    return run_here("report.py", *map(str, words), root=root)


class Page(HTMLParser):
    """The contents of a page: balanced tags, references, tables, and its text."""

    def __init__(self, text):
        super().__init__()
        self.open, self.references, self.tables, self.kinds, self.text = [], [], [], [], ""
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        assert tag not in ("script", "link", "iframe", "object", "form")
        self.references += [value for name, value in attrs if name in ("src", "href", "srcset", "poster", "data")]
        assert not any(name.startswith("on") for name, _ in attrs)
        if tag not in {"meta", "img", "br"}:
            self.open.append(tag)
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th"):
            self.tables[-1][-1].append("")
            self.kinds.append(dict(attrs).get("class"))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag
        if tag in ("td", "th"):
            cell = self.tables[-1][-1][-1]
            assert self.kinds[-1] == (SIGNS.get(cell[:1]) if tag == "td" else None), cell

    def handle_data(self, data):
        self.text += data
        if {"td", "th"} & set(self.open):
            self.tables[-1][-1][-1] += data
