"""The numbers of robots other than the A1, recomputed from the raw data beside the documents."""

import pandas as pd
import pytest
from support.documents import DOCS, TASKS, rows_of, text_of

from legged_torque.paper.report.tables import welch

IDEAL = "ideal motors, no latency"
ROBOTS, TORQUE = ("Go1", "Go2", "ANYmal C", "G1"), ("default torque", "torque multi-head")
DIGITS = {"track_percentage": 3, "cost_of_transport": 2, "late": 2, "fell": 2}
"""Columns of the table, and how exact they are."""


@pytest.fixture(scope="module")
def runs():
    """Each training's means over the last two elevenths, and its sweeps: tracking 20 ms late, falls after pushes."""
    key = ["task", "trained", "seed"]
    runs = pd.read_csv(DOCS / "results" / "robots.csv.xz").drop(columns="commit")
    runs = runs[runs["steps"] >= 9 / 11 * runs.groupby(key)["steps"].transform("max")].groupby(key).mean()
    swept = pd.read_csv(DOCS / "results" / "robustness.csv.xz").set_index(["parameter", "metric", "from", *key])["mean"]
    runs["late"], runs["fell"] = swept["action_delay", "track_percentage", 4.0], swept["push_velocity", "fell", 3.5]
    assert len(runs) == 47
    return runs


@pytest.fixture(scope="module")
def learned(runs):
    """A function from a robot and a policy to the trainings that learned, and the number of all."""

    def get(robot, method):
        task = TASKS[method].replace("a1_", robot.lower().replace(" ", "_") + "_")
        part = runs.loc[task, IDEAL]
        return part[part["track_percentage"] > 0.6], len(part)

    return get


def test_table(learned):
    """Lowest and highest seed that learned, how many those are, and how many trainings of an approach."""
    count, text = {}, text_of("robots.md", "## Results")
    _, rows = rows_of("robots.md", "robot | policy | tracking")
    assert len(rows) == 12
    for robot, policy, *cells in rows:
        method, _, note = policy.partition(" (")
        part, total = learned(robot, method)
        seeds = f"{len(part)} of {total})" if len(part) < total else f"{total} seeds)"
        assert note == seeds or (not note and len(part) == 3), (robot, policy)
        ends = [[f"{end:.{digits}f}" for end in (part[n].min(), part[n].max())] for n, digits in DIGITS.items()]
        assert cells == ["–".join(dict.fromkeys(each)) for each in ends], (robot, policy)
        good, tried = count.get(method, (0, 0))
        count[method] = good + len(part), tried + total
    said = "Torque multi-head learned in {} of {} trainings, default torque control in {} of {}."
    assert said.format(*count["torque multi-head"], *count["default torque"]) in text


def test_torque_multi_head(learned):
    """How torque multi-head differs from PD in tracking, energy and falls after pushes, robot by robot."""
    text, pairs = text_of("robots.md", "## Results"), []
    for robot in ROBOTS:
        pairs.append([learned(robot, method)[0] for method in ("torque multi-head", "PD")])
    p = {name: [welch(own[name], position[name]) for own, position in pairs] for name in DIGITS}
    less = [position["track_percentage"].mean() - own["track_percentage"].mean() for own, position in pairs]
    assert "tracks {:.3f}, {:.3f} and {:.3f} less than PD on four legs and".format(*less) in text
    assert f"and {-less[3]:.3f} more on the G1, not significantly with three seeds" in text
    assert "(Welch's test, p = {:.2f}, {:.2f}, {:.2f} and {:.2f}, not".format(*p["track_percentage"]) in text
    costs = [[each["cost_of_transport"].mean() for each in pair] for pair in pairs[:3]]
    assert "is {:.0f}, {:.0f} and {:.0f}% lower than PD's".format(*(100 - 100 * a / b for a, b in costs)) in text
    assert "PD's (p = {:.2f}, {:.2f} and {:.2f}, not corrected)".format(*p["cost_of_transport"]) in text
    fell = [[each["fell"].mean() for each in pair] for pair in pairs]
    own, position = fell[0]
    said = f"over {own:.2f} of the Go1s under torque multi-head and {position:.2f} under PD (p = {p['fell'][0]:.2f})"
    assert said in text and min(fell[3]) > 0.9
    for (own, position), value, name in zip(fell[1:3], p["fell"][1:3], ("Go2s", "ANYmals"), strict=True):
        assert f"{own:.2f} and {position:.2f} of the {name} (p = {value:.2f}" in text


def test_doubled_scale(runs, learned):
    """How many trainings of default torque control learn with twice the scale, and what that changes."""
    doubled = runs["track_percentage"].xs(f"{IDEAL}, torque scale doubled", level="trained")
    good, text = doubled > 0.6, text_of("robots.md", "## Results")
    said = f"control learned in {good.sum()} of {len(good)}: three instead of two of three Go2s, two instead of three"
    assert said in text and good.groupby("task").sum()[["go2_torque", "go1_torque"]].tolist() == [3, 2]
    g1, before = doubled["g1_torque"], learned("G1", "default torque")[0]["track_percentage"]
    assert f"G1 tracks {g1.mean():.3f} instead of {before.mean():.3f} (p = {welch(g1, before):.2f})." in text


def test_late_actions(learned):
    """What is said of actions 20 ms late where the A1's are discussed: ends over robots, policies and seeds."""
    text = text_of("results.md", "[Other robots](robots.md")
    ends = []
    for robots, methods in ((ROBOTS[:3], ("PD",)), (ROBOTS[2:3], TORQUE), (ROBOTS[:2], TORQUE)):
        late = pd.concat([learned(robot, method)[0]["late"] for robot in robots for method in methods])
        ends.append(f"{late.min():.2f} to {late.max():.2f}")
    said = "PD tracks {} on four legs, torque policies {} on ANYmal C and {} on Go1 and Go2."
    assert said.format(*ends) in text


def test_g1():
    """The last 18% of four seeds."""
    data = pd.read_csv(DOCS / "results" / "g1.csv.gz").query("steps >= 0.82 * 2238 * 98304")
    numbers = data.groupby("seed")["track_percentage"].mean()
    text = text_of("robots.md", "## Results")
    assert "{:.3f}, {:.3f}, {:.3f} and {:.3f} in the last 18%".format(*numbers) in text and len(numbers) == 4
