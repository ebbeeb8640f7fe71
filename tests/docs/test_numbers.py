"""The tables of the documents, recomputed from the raw data beside them."""

from pathlib import Path

import pandas as pd
import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
TASKS = {
    "PD": "a1_position",
    "default torque": "a1_torque",
    "gravity pre-training": "a1_torque_gravity",
    "torque curriculum": "a1_torque_curriculum",
    "torque multi-head": "a1_torque_multihead",
    "multi-head": "a1_multihead",
    "curriculum, torque multi-head": "a1_torque_curriculum_multihead",
}
ROUGH = {name: task.replace("a1_", "a1_rough_") for name, task in TASKS.items()}
KINDS = {
    "slopes, waves, flat": ["flat", "smooth_slope_up", "smooth_slope_down", "rough_slope", "waves"],
    "stairs up": ["stairs_up"],
    "stairs down": ["stairs_down"],
    "obstacles": ["discrete_obstacles"],
    "stepping stones": ["stepping_stones"],
    "gaps": ["gaps"],
    "pits": ["pits"],
}


def rows_of(page, header):
    """Columns and rows of the table of a page that begins with a header, as lists of texts."""
    lines = (DOCS / page).read_text("utf-8").splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith(f"| {header} |"))
    end = next(i for i in range(start, len(lines)) if not lines[i].startswith("|"))
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[start:end]]
    return cells[0], cells[2:]


def means(file):
    """Means of the evaluations after step 90 million, over seeds, by task and environment."""
    data = pd.read_csv(DOCS / file)
    data = data[data["steps"] >= 90e6].drop(columns="steps")
    return data.groupby(["task", "environment", "seed"]).mean().groupby(["task", "environment"]).mean()


def same(text, value):
    """Whether a number is a value, rounded."""
    return abs(float(text) - value) <= 0.5 * 10.0 ** -len(text.partition(".")[2]) + 1e-9


def test_table_one():
    """Tracking of each method in each environment."""
    measured = means("results/evaluations.csv.gz")["track_percentage"]
    columns, rows = rows_of("results.md", "method | low | paper")
    assert len(rows) == 7
    for method, *numbers in rows:
        for environment, number in zip(columns[1::2], numbers[::2], strict=True):
            suffix = "_high" if environment == "high" and method in ("torque curriculum",) else ""
            value = measured.get((TASKS[method] + suffix, environment), measured.get((TASKS[method], environment)))
            assert same(number, value), (method, environment, number, value)


def test_hard_ranges():
    """Tracking, velocity error and cost of transport with hard ranges."""
    measured = means("results/hard/evaluations.csv.gz")
    _, rows = rows_of("results.md", "method | tracking, low")
    metrics = [name for name in ("track_percentage", "track_xy", "cost_of_transport") for _ in range(2)]
    for method, *numbers in rows:
        for number, metric, environment in zip(numbers, metrics, 3 * ["low", "high"], strict=True):
            task = TASKS[method]
            task = f"{task}_high" if (f"{task}_high", environment) in measured.index else task
            value = measured.loc[(task, environment), metric]
            assert same(number, value), (method, metric, environment, number, value)


def test_latency():
    """Lowest and highest seed by latency."""
    data = pd.read_csv(DOCS / "results" / "latency.csv")
    data = data[data["robot"] == "a1"].replace({"trained_with": {"real": "late"}})
    _, rows = rows_of("randomization.md", "policy, trained")
    methods = {"PD": "position", "torque multi-head": "torque_multihead"}
    for policy, *cells in rows:
        method, trained = policy.split(", ")
        chosen = data[(data["method"] == methods[method]) & (data["trained_with"] == trained)]
        for cell, latency in zip(cells, (0, 10, 20, 30, 20), strict=True):
            metric = "falls_per_minute" if cell is cells[-1] else "track_percentage"
            values = chosen[chosen["latency_ms"] == str(latency)][metric]
            for number, value in zip(cell.split(", "), (values.min(), values.max()), strict=True):
                assert same(number, value), (policy, latency, number, value)


@pytest.mark.parametrize("column", KINDS)
def test_rough_ground(column):
    """Shares of robots that cross tiles, tracking and cost of transport, over all difficulties."""
    data = pd.read_csv(DOCS / "results" / "rough" / "grounds.csv.gz")
    columns, rows = rows_of("results.md", "policy | slopes, waves, flat")
    for policy, *numbers in rows:
        method, _, sight = policy.rpartition(", ")
        task = ROUGH[method] + ("_scan" if sight == "scan" else "")
        chosen = data[(data["task"] == task) & (data["commit"] != "older")]
        crossed = chosen[chosen["kind"].isin(KINDS[column])]["crossed"].mean()
        cost = chosen[chosen["kind"] == "rough_slope"]["cost_of_transport"].mean()
        values = {column: crossed, columns[-2]: chosen["track_percentage"].mean(), columns[-1]: cost}
        for name, value in values.items():
            assert same(numbers[columns.index(name) - 1], value), (policy, name, value)


def test_sweeps():
    """What the sentences on latency, pushes and payloads say of the quadrupeds."""
    data = pd.read_csv(DOCS / "results" / "sweeps.csv.gz").set_index(["task", "parameter", "metric"]).sort_index()
    text = " ".join((DOCS / "results.md").read_text("utf-8").partition("## What policies bear")[2].split())

    def measured(approach, parameter, metric, place):
        tasks = [f"{robot}_{approach}" for robot in ("a1", "go1", "go2", "anymal_c")]
        return [data.loc[(task, parameter, metric)].sort_values("from")["mean"].iloc[place] for task in tasks]

    late = {name: measured(name, "action_delay", "track_percentage", 6) for name in ("position", "torque_multihead")}
    first, second, third, anymal = late["torque_multihead"]
    assert f"tracks {min(late['position']):.2f} to {max(late['position']):.2f}, torque multi-head" in text
    assert f"{second:.2f}, {third:.2f}, {first:.2f} and, the ANYmal's, {anymal:.2f}" in text
    for approach, words in (("torque_multihead", "of them"), ("position", "under PD")):
        fell = [f"{share:.2f}" for share in measured(approach, "push_velocity", "fell", 7)]
        assert f"{', '.join(fell[:3])} and {fell[3]} {words}" in text
    for approach, words in (("position", "of tracking with PD"), ("torque_multihead", "with torques")):
        ends = (measured(approach, "trunk_mass", "track_percentage", place) for place in (0, 7))
        costs = [light - heavy for light, heavy in zip(*ends, strict=True)]
        assert f"{min(costs):.2f} to {max(costs):.2f} {words}" in text
