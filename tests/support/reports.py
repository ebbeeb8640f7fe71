"""Shared by tests: reports."""

import json
import runpy
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
import yaml

from legged_torque.paper.report.curves import CURVE_METRICS
from legged_torque.paper.values import TABLE_I

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "report.py"


HEADER = (
    "steps,iteration,seconds,track_percentage,track_xy,track_angular,collision_force,cost_of_transport,height,speed,"
    "falls_per_minute,critic_gradient_norm"
)


ALL_METRICS = [metric.name for metric in CURVE_METRICS]


TASKS = ["a1_position", "a1_torque", "a1_multihead"]


SETTINGS = {
    "env": {"env": {"num_envs": 1000}},
    "train": {"runner": {"num_steps_per_env": 1000}},  # a million steps per iteration
    "max_iterations": 110,
    "device": "cuda:0",
    "versions": {"python": "3.11.0", "torch": "2.11.0"},
}


def line(million, tracking, **others):
    """A line of evaluations.csv: all metrics are 10 times the tracking, if they are not given."""
    values = dict.fromkeys(ALL_METRICS, 10.0 * tracking) | {"track_percentage": tracking} | others
    return f"{million * 1_000_000},{million},{million}.5," + ",".join(str(values[name]) for name in ALL_METRICS)


def write_part(folder, lines, end="\n", **settings):
    """Write the folder of a run, or of a part of one."""
    folder.mkdir(parents=True)
    task, _ = folder.parent.name.split("-")[:2]
    config = {"task": task, **SETTINGS, **settings}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    (folder / "evaluations.csv").write_text("\n".join([HEADER, *lines]) + end)


def write_result(cell, environment, tracking, steps=110_000_000):
    """Write what evaluate.py has measured in an environment."""
    metrics = {name: {"mean": tracking, "standard_error": 0.01} for name, _ in TABLE_I}
    result = {"task": "any", "steps": steps, "device": "NVIDIA H200", "metrics": metrics}
    (cell / f"result_{environment}.json").write_text(json.dumps(result))


def write_experiment(folder, environments=None, seeds=(1, 2), tasks=TASKS):
    """Write the plan of an experiment."""
    folder.mkdir(parents=True, exist_ok=True)
    environments = environments or {"low": ["low", "high"], "high_frequency": ["high_frequency", "doubled"]}
    plan = {"tasks": list(tasks), "environments": environments, "seeds": list(seeds)}
    (folder / "experiment.yaml").write_text(yaml.safe_dump(plan, sort_keys=False))


def whole_run(tracking):
    """Lines of a finished training: bad before step 90 million, then around the given value."""
    return [line(10, 0.1), line(80, 0.2), line(90, tracking - 0.05), line(100, tracking), line(110, tracking + 0.05)]


def run_script(*words):
    """Run the script in this process; return its exit status."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["report.py", *map(str, words)])
        try:
            runpy.run_path(str(SCRIPT), run_name="__main__")
        except SystemExit as stop:
            return stop.code
    return 0


def write_grounds(cell, crossed):
    """Write what evaluate.py has measured on tiles: shares of robots by kind and level; tracking is a tenth of it."""
    cell.mkdir(parents=True, exist_ok=True)
    estimates = {tile: {"mean": share, "standard_error": 0.1} for tile, share in crossed.items()}
    tenth = {tile: {"mean": share / 10} for tile, share in crossed.items()}
    entries = [
        {"kind": tile[0], "level": tile[1], "crossed": share, "fell": {"mean": 0.25}}
        | {"metrics": {"track_percentage": tenth[tile], "cost_of_transport": {"mean": None}}}
        for tile, share in estimates.items()
    ]
    (cell / "grounds.json").write_text(json.dumps({"grounds": entries}))


VOID = {"meta", "img", "br"}


SIGNS = {"✓": "better", "≈": "within", "✗": "worse"}


class Page(HTMLParser):
    """What a page holds: tags that are balanced, references, tables, and its text."""

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
        if tag not in VOID:
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
