"""Numbers in the documents of rough ground, learning rates and the entropy of actions, against the data."""

import json
import re

import numpy as np
import pandas as pd
import pytest
from scipy.stats import ttest_rel
from support.documents import DOCS, TASKS, rows_of, same, text_of

from legged_torque.paper.report.tables import welch

ROUGH = {name: task.replace("a1_", "a1_rough_") for name, task in TASKS.items()}
KINDS = {name: [name.replace(" ", "_")] for name in ("stairs up", "stairs down", "stepping stones", "gaps", "pits")}
KINDS |= {"obstacles": ["discrete_obstacles"]}
KINDS |= {"slopes, waves, flat": ["flat", "smooth_slope_up", "smooth_slope_down", "rough_slope", "waves"]}


@pytest.mark.parametrize("column", KINDS)
def test_rough_ground(column):
    """Shares of robots that cross tiles, tracking and cost of transport, over all difficulties."""
    data = pd.read_csv(DOCS / "results" / "rough" / "grounds.csv.xz")
    columns, rows = rows_of("results.md", "policy | slopes, waves, flat")
    for policy, *numbers in rows:
        method, sight, seeds = re.fullmatch(r"(.+), (blind|scan)(?:, (\d) seeds)?", policy).groups()
        task = ROUGH[method] + ("_scan" if sight == "scan" else "")
        chosen = data[(data["task"] == task) & (data["environment"] == "low")]
        assert chosen["seed"].nunique() == int(seeds or 1)
        crossed = chosen[chosen["kind"].isin(KINDS[column])]["crossed"].mean()
        cost = chosen[chosen["kind"] == "rough_slope"]["cost_of_transport"].mean()
        values = {column: crossed, columns[-2]: chosen["track_percentage"].mean(), columns[-1]: cost}
        assert all(same(numbers[columns.index(name) - 1], value) for name, value in values.items()), (policy, values)


def test_stairs():
    """How many of the stairs up policies climb, by seed."""
    data = pd.read_csv(DOCS / "results" / "rough" / "grounds.csv.xz").query("environment == 'low'")
    climbed = data[data["kind"] == "stairs_up"].groupby(["commit", "task", "seed"])["crossed"].mean()
    text, of_task = text_of("results.md", "- In crossing"), climbed.groupby("task")
    low, *others = sorted(of_task.get_group("a1_rough_position"))
    said = f"blind PD climbs {others[0]:.2f} to {others[-1]:.2f} of them in four seeds and {low:.2f} in one, the torque"
    assert said in text and len(others) == 4
    assert round(3 * of_task.min()["a1_rough_torque_curriculum_scan"], 1) == 2 and "with the scan two thirds." in text
    own = climbed[climbed.index.get_level_values("task").str.match("a1_rough_torque_multihead")]
    assert own.min() >= 0.93 and "Torque multi-head climbed at least 0.93." in text.replace("\n ", "")


def test_which_seeds_learn_on_rough_ground():
    """Tracking and stairs by seed, of today's defaults and of those before."""
    text = text_of("results.md", "- **With today's defaults**").replace("\n ", "")
    evaluations = pd.read_csv(DOCS / "results" / "rough" / "evaluations.csv.gz").query("steps > 246e6")
    tiles = pd.read_csv(DOCS / "results" / "rough" / "grounds.csv.xz").query("kind == 'stairs_up'")
    keys = ["environment", "task", "seed"]
    ends, stairs = evaluations.groupby(keys)["track_percentage"].mean(), tiles.groupby(keys)["crossed"].mean()
    own = "low, b0f0f7e", "a1_rough_torque_multihead"
    said = f"tracks {ends[own].min():.3f} to {ends[own].max():.3f} after step 246 million and climbs at least"
    assert f"{said} {stairs[own].min():.2f} of the stairs (five seeds)" in text and len(ends[own]) == 5
    go2 = ends["low, b0f0f7e", "go2_rough_torque_multihead"]
    assert "Go2s track {:.3f} and {:.3f}.".format(*sorted(go2)) in text
    stands, *learned = sorted(ends["low, equivariant networks", "a1_rough_torque_multihead"])
    assert f"one of five stood still ({stands:.3f}), the others tracked {learned[0]:.3f} to {learned[-1]:.3f}," in text
    low, _, high = sorted(ends["low, equivariant networks", "a1_rough_position"])
    assert f"PD {low:.3f} to {high:.3f}." in text


def test_highest_learning_rates():
    """How many seeds failed early on rough ground, and mean tracking then, by changed setting."""
    runs = pd.read_csv(DOCS / "tried.csv.xz").query("12e6 < steps < 17e6")
    early = runs.groupby(["run", "task", "seed"])["track_percentage"].mean()
    whole = pd.read_csv(DOCS / "results" / "rough" / "evaluations.csv.gz").query("environment.str.contains('b0f0f7e')")
    whole = whole.query("12e6 < steps < 18.1e6").groupby(["task", "seed", "environment"])["track_percentage"].mean()
    kept = {robot: [*early["rates/new", f"{robot}_rough_torque_multihead"]] for robot in ("a1", "go2")}
    kept["a1"] += [*whole["a1_rough_torque_multihead"]]
    names = ["base", "", "lr3", "lr1", "kl", "gam", "alive", "ent", "fade", "std"]
    _, rows = rows_of("tried.md", "changed")
    for name, (_, failed, mean) in zip(names, rows, strict=True):
        tracked = pd.Series(early[f"rates/{name}"].to_numpy() if name else kept["a1"])
        assert (failed, mean) == (f"{tracked.lt(0.25).sum()} of {len(tracked)}", f"{tracked.mean():.2f}"), name
    assert (early["rates/old"].lt(0.25).sum(), len(early["rates/old"]), len(kept["go2"])) == (2, 6, 6)
    assert min(kept["go2"]) > 0.25
    text = text_of("tried.md", "Of Go2s, two of six failed with 1e-2, none with 2e-3.").replace("\n", " ")
    laptop = pd.read_csv(DOCS / "results" / "laptop_settings.csv.xz").query("other.str.startswith('rate ', na=False)")
    walks = [laptop[laptop["track_percentage"] >= share] for share in (0.7, 0.8)]
    by_rate = [np.log(rows.groupby(["other", "task", "seed"])["steps"].min()) for rows in walks]
    pairs = [(steps["rate 0.002 20M"] - steps["rate 0.01 20M"]).dropna() for steps in by_rate]
    said = "takes {:.2f} and {:.2f} times the steps to 70 and 80% with 2e-3 ({} pairs)"
    assert said.format(*(np.exp(pair.mean()) for pair in pairs), *{len(pair) for pair in pairs}) in text
    ends = laptop[laptop["steps"] > 0.82 * 20e6].query("other == 'rate 0.004 20M'")
    ends = ends.groupby(["task", "seed"])["track_percentage"].mean()["go2_torque_multihead"]
    assert f"with 4e-3, one Go2 of four ended at {ends.min():.2f}." in text and sorted(ends)[1] > 0.84


def test_actions_without_effect():
    """Tracking at the end with and without their entropy, lowest and highest of the seeds."""
    runs = pd.read_csv(DOCS / "tried.csv.xz").query("run.str.match('weights/|equivariant/')")
    runs["run"] = runs["run"].str.replace("equivariant/.*", "before", regex=True)
    robots = pd.read_csv(DOCS / "results" / "robots.csv.xz").query("trained == 'ideal motors, no latency'")
    runs = pd.concat([runs, robots.assign(run="images")])
    runs = runs[runs["steps"] > 0.82 * runs.groupby(["run", "task", "seed"])["steps"].transform("max")]
    ends = runs.groupby(["run", "task", "seed"])["track_percentage"].mean()
    rough = pd.read_csv(DOCS / "results" / "rough" / "evaluations.csv.gz").query("steps > 246e6")
    rough = rough.groupby(["environment", "seed", "task"])["track_percentage"].mean()

    def said(tracked, images=""):
        ends = dict.fromkeys((f"{tracked.min():.3f}", f"{tracked.max():.3f}"))
        return f"{'–'.join(ends)} ({len(tracked)}{images})"

    _, rows = rows_of("tried.md", "task | 1e-2, all actions")
    for task, *cells in rows:
        name = task.strip("`")
        if name.startswith("a1_rough"):
            kinds = ("low, b0f0f7e, entropy of all actions", "low, b0f0f7e")
            assert cells == ["", *(said(rough[kind].xs(name, level="task")) for kind in kinds)]
            continue
        first = "weights/old" if name == "a1_torque_multihead" else "before"
        images = "" if (first, name) in ends.index.droplevel("seed") else ", mirrored"
        assert cells[0] == said(ends["images" if images else first, name], images), name
        assert cells[1] == (said(ends["weights/none", name]) if name == "a1_torque_multihead" else "")
        assert cells[2] == said(ends["weights/new", name]), name
    measurements = json.loads((DOCS / "performance" / "h200.json").read_text())["measurements"]
    noise = next(each for each in measurements if "highest mean standard deviation" in each["what"])
    low, high = min(noise["all_actions"]), max(noise["all_actions"])
    assert f"deviation rose to {low:.0f} to {high:.0f}." in text_of("tried.md", "**Actions").replace("\n", " ")
    assert max(noise["by_weights"]) < 0.8 and max(noise["iterations_to_1e-2"]) == 10
    own = ends["weights/new", "a1_torque_multihead"]
    text = text_of("tried.md", "In brackets: seeds; some").replace("\n", " ")
    assert f"last columns, p = {welch(own, ends['weights/none', 'a1_torque_multihead']):.3f}." in text
    pd_control = pd.concat([ends[run, "a1_position"] for run in ("before", "weights/new")])
    more, chance = pd_control.mean() - own.mean(), welch(own, pd_control)
    assert f"PD of eight seeds tracks {more:.3f} more than torque multi-head (p = {chance:.3f})." in text
    old = ends["weights/old", "a1_torque_multihead"]
    text = text_of("results.md", "- **Torque multi-head** tracks").replace("\n ", "")
    assert f"A1s {own.min():.3f} to {own.max():.3f} (five seeds)" in text and len(own) == 5
    assert f"{old.min():.3f} to {old.max():.3f} (six, same machine and hour, p = {welch(own, old):.3f})" in text


def test_rough_ground_with_latency():
    """Tracking at the end of training, by seed, and shares of tiles."""
    data = pd.read_csv(DOCS / "results" / "rough" / "evaluations.csv.gz").query("steps > 246e6")
    late = data[data["environment"].str.contains("late")].groupby(["task", "seed"])
    tracking = late["track_percentage"].mean()
    own, position = tracking["a1_rough_torque_damped"], tracking["a1_rough_position"]
    text, three = text_of("results.md", "- **With latency**"), "{:.3f}, {:.3f} and {:.3f}"
    said = f"{three.format(*own)} after step 246 million, more than tuned PD with {three.format(*position)} (p = "
    assert f"{said}{welch(own, position):.3f};" in text and own.min() > position.max()
    falls = late["falls_per_minute"].mean().groupby("task").agg(["min", "max"])
    (low, high), (low_pd, high_pd) = falls.loc["a1_rough_torque_damped"], falls.loc["a1_rough_position"]
    assert f"It falls {low:.2f} to {high:.2f} times a minute, PD {low_pd:.2f} to {high_pd:.2f}." in text
    grounds = pd.read_csv(DOCS / "results" / "rough" / "grounds.csv.xz").query("environment.str.contains('late')")
    for tiles, words in (
        (grounds, "Both cross {:.2f} of the"),
        (grounds.query("kind == 'stairs_up'"), "stairs up {:.2f}."),
    ):
        assert all(words.format(crossed) in text for crossed in tiles.groupby("task")["crossed"].mean())


def test_rough_ground_without_damping():
    """Tracking with latency of torque multi-head and PD at the end, today and before, by robot."""
    data = pd.read_csv(DOCS / "results" / "rough" / "evaluations.csv.gz").query("steps > 164e6")
    ends = data.groupby(["environment", "task", "seed"])["track_percentage"].mean()
    text, own = text_of("results.md", "- **Without damping**").replace("\n ", ""), ends["low, up to 15 ms, d7f7557"]
    robots = {"a1": "A1", "go1": "Go1", "go2": "Go2", "anymal_c": "ANYmal C (ideal motors)"}
    torque, position = (
        [own[f"{robot}_rough_{approach}", 1] for robot in robots] for approach in ("torque_multihead", "position")
    )
    pairs = zip(robots.values(), torque, position, strict=True)
    said = ", ".join(f"{robot} {one:.3f} and {other:.3f}" for robot, one, other in pairs)
    assert f"more than PD: {said} after step 164 of 200 million (p = {ttest_rel(torque, position).pvalue:.3f}," in text
    others = ends["low, up to 15 ms, 70d6345"]
    assert f"Four others tracked {others.min():.3f} to {others.max():.3f} (70d6345)." in text
    assert len(others) == 4 and len(own) == 8
    before = pd.read_csv(DOCS / "tried.csv.xz").query("run.str.match('policies/pol-(a1|go1|go2|anymal_c)')")
    before = before.sort_values("steps").groupby("task")["track_percentage"].last()
    failed, pd_control = before.filter(regex="^(a1|go).*multihead"), before.filter(regex="^(a1|go).*position")
    assert f"ended at {failed.min():.2f} to {failed.max():.2f}, PD at {pd_control.min():.2f}" in text
    anymal = " and ".join(f"{before[f'anymal_c_rough_{each}']:.2f}" for each in ("torque_multihead", "position"))
    assert f"to {pd_control.max():.2f}, ANYmal C's at {anymal} (" in text
