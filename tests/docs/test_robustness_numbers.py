"""The numbers of the study of what policies bear, recomputed from the raw data beside the documents."""

import re

import pandas as pd
import pytest
from scipy import stats
from support.documents import DOCS, TASKS, rows_of, same, text_of

from legged_torque.paper.report.tables import holm, welch


@pytest.fixture(scope="module")
def swept():
    """Sweeps of newly trained A1s."""
    data = pd.read_csv(DOCS / "results" / "robustness.csv.gz")
    return data.set_index(["trained", "parameter", "metric", "from", "task"]).sort_index(kind="stable")["mean"]


def trained_as(policy):
    """How a policy of a table was trained, as the data have it, and its task."""
    tasks = TASKS | {"variable stiffness": "a1_variable_stiffness", "decaying PD bias": "a1_decap"}
    more = {"tuned": "tuned gains", "damping": "damping on the drive", "history": "history of 3"}
    method, late, how = re.fullmatch(r"(.+), (\d+ ms)((?:, \w+)*)", policy.strip("*")).groups()
    trained = ", ".join([f"late by 0 to {late}", *(more[each] for each in how.split(", ")[1:])])
    return {"late by 0 to 10 ms, damping on the drive": "damping on the drive"}.get(trained, trained), tasks[method]


def test_cures_of_latency(swept):
    """Lowest and highest seed by latency and training, and of falls after pushes; the best against tuned PD."""
    columns = [("action_delay", "track_percentage", steps) for steps in (0.0, 4.0, 6.0)]
    columns += [("push_velocity", "fell", 3.5)]
    _, rows = rows_of("results.md", "policy, latest actions in training")
    assert len(rows) == 16
    for policy, seeds, *cells in rows:
        trained, task = trained_as(policy)
        for cell, column in zip(cells, columns, strict=True):
            values = swept.loc[(trained, *column, task)]
            low, high = cell.split(", ")
            assert len(values) == int(seeds) and same(low, values.min()) and same(high, values.max()), (policy, column)
    text = text_of("results.md", "- **Default torque control can")
    recipe, tuned = "late by 0 to 20 ms, damping on the drive, history of 3", "late by 0 to 20 ms, tuned gains"
    _, torque, later, fell = (swept.loc[(recipe, *column, "a1_torque")] for column in columns)
    _, position, later_pd, fell_pd = (swept.loc[(tuned, *column, "a1_position")] for column in columns)
    test = stats.ttest_ind(torque, position, equal_var=False)
    (low, high), change = test.confidence_interval(), torque.mean() - position.mean()
    more = ("damping on the drive", "history of 3")
    assert f"tracks {torque.mean():.3f}, PD, tuned and trained with it, {position.mean():.3f}" in text
    assert f"(difference {change:.3f}, 95% interval {low:.3f} to {high:.3f})" in text
    assert f"over {fell.mean():.2f} instead of {fell_pd.mean():.2f} (p = {welch(fell, fell_pd):.3f};" in text
    assert f"tracks {later_pd.mean() - later.mean():.3f} less" in text
    assert f"alone give {torque.iloc[3:].mean():.3f} and {fell.iloc[3:].mean():.2f}" in text
    damped, past = (swept.loc[(f"late by 0 to 20 ms, {how}", *columns[1], "a1_torque")] for how in more)
    assert f"tracks {damped.mean():.3f} (p = {welch(damped, torque):.2f}, three seeds against seven)" in text
    assert "history alone {0:.3f}, {2:.3f} and {1:.3f}".format(*past) in text
    fast = swept.loc["policy at 200 Hz", "action_delay", "track_percentage", 0.0, "a1_torque_multihead"]
    assert f"track {fast.min():.2f} to {fast.max():.2f} without latency after" in text


@pytest.fixture(scope="module")
def conditions():
    """What was measured in other conditions."""
    data = pd.read_csv(DOCS / "results" / "robustness.csv.gz").sort_values("seed")
    data = data[data["parameter"].str.startswith("condition ")]
    return data.assign(condition=data["parameter"].str.removeprefix("condition ").str.replace("_", " "))


def test_table_of_conditions(conditions):
    """Tracking of each seed, and of the undisturbed its range and that of how fast torques change."""
    columns, rows = rows_of("results.md", "policy | undisturbed")
    assert len(rows) == 8
    for policy, *cells in rows:
        trained, task = trained_as(policy)
        own = conditions[(conditions["trained"] == trained) & (conditions["task"] == task)]
        tracking = own[own["metric"] == "track_percentage"].set_index("condition")
        found = [
            tracking["mean"]["as trained"],
            own[own["metric"] == "torque_rate"].set_index("condition")["mean"]["as trained"],
        ]
        found = [f"{found[0].min():.3f} to {found[0].max():.3f}", f"{found[1].min():.0f} to {found[1].max():.0f}"]
        for column in columns[3:]:
            marks = tracking["commit"].eq("e45a78f") & (column == "off centre")
            texts = tracking["mean"].map("{:.3f}".format) + marks.map({True: "†", False: ""})
            found.append(", ".join(texts.loc[[column.replace("x 4", "4 times")]]))
        assert cells == found, policy


def test_other_conditions(conditions):
    """What is said of smoothness, of a trunk off centre, of drops and of a leg without torques."""
    text, late = text_of("results.md", "**Other conditions**"), "late by 0 to 10 ms"
    of = conditions.set_index(["condition", "metric", "trained", "task"]).sort_index(kind="stable")["mean"]
    rates = dict(list(of["as trained", "torque_rate", late].groupby("task")))
    own = rates.pop("a1_position")
    p = dict(zip(rates, holm([welch(rate, own) for rate in rates.values()]), strict=True))
    assert {task for task in p if p[task] < 0.05} == {"a1_torque_multihead", "a1_torque", "a1_decap"} and len(p) == 6
    recipe = of["as trained", "torque_rate", f"{late[:-5]}20 ms, damping on the drive, history of 3", "a1_torque"]
    assert f"{recipe.mean():.0f} against {own.mean():.0f}." in text and recipe.min() > own.mean()
    tracking = of.xs("track_percentage", level="metric").xs(late, level="trained")
    names = ["a1_torque_curriculum", "a1_position", "a1_torque"]
    lost = [
        tracking.loc[[("as trained", name)]].iloc[0] - tracking.loc[[("off centre", name)]].iloc[0] for name in names
    ]
    said = "curriculum loses {:.3f} of tracking, PD {:.3f}, default torque {:.3f}."
    assert said.format(*lost) in text
    drops, lame = (of[name, "falls_per_minute"] for name in ("drop 50 cm", "dead leg"))
    assert f"more than {drops.max():.2f} times a minute; without the torques of a leg, all fell " in text
    assert f"all fell {lame.min():.0f} to {lame.max():.0f} times." in text


def test_repeated_trainings():
    """The same settings and seed on another machine, by commits that train alike, give the same sweeps."""
    again, key = pd.read_csv(DOCS / "results" / "repeated.csv.gz"), ["task", "trained", "seed", "parameter", "from"]
    data = pd.read_csv(DOCS / "results" / "robustness.csv.gz").query("metric == 'track_percentage'")
    for each in (again, data):
        each["from"] = each["from"].round(3)
    both = again.merge(data, on=key)
    apart = (both["track_percentage"] - both["mean"].round(4)).abs()
    latency = both["parameter"].str.endswith("_delay")
    assert len(both) == len(again) and (both["commit_x"] != both["commit_y"]).all()
    assert len(both[latency].groupby(key[:3])) == 28 and apart[latency].max() < 1e-6
    text, voltage = text_of("results.md", "## What policies bear"), apart[~latency]
    assert f"28 trainings, repeated with {again['commit'].unique().item()}" in text
    assert f"seed 1 of five approaches tracks the same to {voltage.max():.3f}." in text
    assert again[again["parameter"] == "trunk_mass"]["task"].nunique() == 5


def test_what_policies_bear(swept):
    """What the sentences say: latency of seven approaches, pushes and payload of five, energy of two."""
    text, base = text_of("results.md", "## What policies bear"), swept.loc["late by 0 to 10 ms"]
    pushed = base.loc["push_velocity", "fell", 3.5].groupby("task").mean()
    names = ("position", "torque", "torque_multihead", "torque_curriculum_multihead", "torque_curriculum")
    words = "{:.2f} of the robots under PD, {:.2f} under default torque, {:.2f} under torque multi-head, {:.2f} under "
    words += "the combination and {:.2f} under the curriculum"
    assert words.format(*pushed[[f"a1_{name}" for name in names]]) in text
    late = base.loc["action_delay", "track_percentage", 6.0]
    others = [f"a1_{name}" for name in names[1:]]
    position, torque, decap = late["a1_position"], late[others], late["a1_decap"]
    assert f"PD tracks {position.min():.2f} to {position.max():.2f}, variable stiffness as much" in text
    assert abs(late["a1_variable_stiffness"].mean() - position.mean()) < 0.01
    assert f"PD bias {decap.min():.2f} to {decap.max():.2f}, and the other four" in text
    assert f"approaches {torque.min():.2f} to {torque.max():.2f}. - **Pushes**" in text
    masses = base.loc["trunk_mass", "track_percentage"].groupby(["from", "task"]).mean().unstack()
    costs = masses.iloc[0] - masses.iloc[-1]
    low, high = costs[others].min(), costs[others].max()
    assert f"costs PD {costs['a1_position']:.3f}" in text and f"these four {low:.3f} to {high:.3f}. From" in text
    for steps in (0.0, 2.0):
        for task in ("a1_torque_multihead", "a1_position"):
            energy = base.loc["action_delay", "cost_of_transport", steps, task]
            assert f"{energy.min():.3f} to {energy.max():.3f}" in text
