"""The numbers of the study of what policies bear, recomputed from the raw data beside the documents."""

import re

import pandas as pd
import pytest
from scipy import stats
from support.documents import DOCS, TASKS, rows_of, same, text_of

from legged_torque.paper.report.tables import holm, welch

BASE = "late by 0 to 10 ms"


@pytest.fixture(scope="module")
def swept():
    """Sweeps of all trainings, by how they were trained."""
    data = pd.read_csv(DOCS / "results" / "robustness.csv.xz")
    return data.set_index(["trained", "parameter", "metric", "from", "task"]).sort_index(kind="stable")["mean"]


def trained_as(policy):
    """How a policy of a table was trained, as the data have it, and its task."""
    tasks = TASKS | {"variable stiffness": "a1_variable_stiffness", "decaying PD bias": "a1_decap"}
    tasks["combination"] = "a1_torque_curriculum_multihead"
    more = {"tuned": "tuned gains", "damping": "damping on the drive", "history": "history of 3"}
    robot, method, late, how = re.fullmatch(r"(?:(Go2): )?(.+), (\d+ ms)((?:, \w+)*)", policy.strip("*")).groups()
    trained = ", ".join([f"late by 0 to {late}", *(more[each] for each in how.split(", ")[1:])])
    task = tasks[method].replace("a1_", f"{(robot or 'a1').lower()}_")
    return {"late by 0 to 10 ms, damping on the drive": "damping on the drive"}.get(trained, trained), task


def test_cures_of_latency(swept):
    """Lowest and highest seed by latency and training, and of falls after pushes; the best against tuned PD."""
    columns = [("action_delay", "track_percentage", steps) for steps in (0.0, 4.0, 6.0)]
    columns += [("push_velocity", "fell", 3.5)]
    _, rows = rows_of("results.md", "policy, latest actions in training")
    assert len(rows) == 21
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
    low, high = test.confidence_interval()
    more = ("damping on the drive", "history of 3")
    assert f"tracks {torque.mean():.4f}, PD, tuned and trained with it, {position.mean():.4f}" in text
    assert f"(95% interval of the difference {low:.3f} to {high:.3f})" in text
    assert f"over {fell.mean():.2f} instead of {fell_pd.mean():.2f} (p = {welch(fell, fell_pd):.3f};" in text
    untuned = swept.loc[("late by 0 to 10 ms", *columns[3], "a1_position")]
    assert f"10 ms {untuned.mean():.2f}, p = {welch(fell, untuned):.2f})" in text
    for_30 = swept.loc[("late by 0 to 30 ms, tuned gains", *columns[2], "a1_position")]
    said = f"tracks {later_pd.mean() - later.mean():.3f} less (p = {welch(later, later_pd):.3f}), and "
    assert f"{said}{for_30.mean() - later.mean():.3f} less than PD trained" in text
    before = [
        swept.loc[(f"{trained} (earlier)", *column, task)].mean()
        for column in (columns[1], columns[3])
        for trained, task in ((recipe, "a1_torque"), (tuned, "a1_position"))
    ]
    assert "gave {:.3f} against {:.3f}, and {:.2f} against {:.2f}.".format(*before) in text
    damped, past = (swept.loc[(f"late by 0 to 20 ms, {how}", *columns[1], "a1_torque")] for how in more)
    assert f"tracks {damped.mean():.3f} (p = {welch(damped, torque):.2f}, three seeds against seven)" in text
    assert "alone {0:.3f}, {2:.3f} and {1:.3f}".format(*past) in text
    late = swept.loc[("late by 0 to 20 ms", *columns[1], "a1_torque")]
    assert f"with neither, {late.min():.3f} to {late.max():.3f} (three seeds, " in text and len(late) == 3
    own, pd_20 = (
        [swept.loc[(trained, *column, task)] for column in columns[1:]]
        for trained, task in ((recipe, "go2_torque"), (tuned, "go2_position"))
    )
    low, high = stats.ttest_ind(own[0], pd_20[0], equal_var=False).confidence_interval()
    (at_20, at_30, falls), (pd_at_20, pd_at_30, pd_falls) = ([part.mean() for part in parts] for parts in (own, pd_20))
    said = f"tracks {pd_at_20 - at_20:.3f} less than tuned PD at 20 ms (95% interval {low:.3f} to {high:.3f}), at "
    said += f"30 ms {pd_at_30 - at_30:.3f} (p = {welch(own[1], pd_20[1]):.3f}); pushes knock over {falls:.2f} instead "
    assert f"{said}of {pd_falls:.2f} (p = {welch(own[2], pd_20[2]):.2f})" in text
    falls = (
        swept.xs(3.5, level="from").xs(("push_velocity", "fell"), level=("parameter", "metric")).groupby(level=[0, 1])
    )
    falls, late = falls.mean(), "late by 0 to 10 ms"
    said = "more fall ({:.2f} instead of {:.2f})"
    assert said.format(falls["damping on the drive", "a1_torque"], falls[late, "a1_torque"]) in text
    late_30 = falls["late by 0 to 30 ms", "a1_torque_multihead"], falls[late, "a1_torque_multihead"]
    assert "multi-head ({:.2f} instead of {:.2f})".format(*late_30) in text
    fast = swept.loc["policy at 200 Hz", "action_delay", "track_percentage", 0.0, "a1_torque_multihead"]
    assert f"track {fast.min():.2f} to {fast.max():.2f} without latency after" in text


@pytest.fixture(scope="module")
def conditions():
    """What was measured in other conditions."""
    data = pd.read_csv(DOCS / "results" / "robustness.csv.xz").sort_values("seed")
    data = data[data["parameter"].str.startswith("condition ")]
    return data.assign(condition=data["parameter"].str.removeprefix("condition ").str.replace("_", " "))


MEASURED = {"undisturbed": ("as trained", "track_percentage"), "torques change": ("as trained", "torque_rate")}
MEASURED |= {"noise x 4": ("noise 4 times", "track_percentage"), "falls, dead leg": ("dead leg", "falls_per_minute")}
MEASURED |= {"peak force [N]": ("drop 50 cm", "peak_force")}
"""Condition and metric of columns; others are tracking in the condition of their name."""


def test_table_of_conditions(conditions):
    """Means over seeds, and which differ significantly from PD for 10 ms, the last row from PD for 20 ms."""
    columns, rows = rows_of("results.md", "policy | seeds | undisturbed")
    of = conditions.set_index(["trained", "task", "condition", "metric"]).sort_index(kind="stable")["mean"]
    assert len(rows) == 9
    for number, column in enumerate(columns[2:]):
        fewer = 2 * (column == "peak force [N]")  # rows with a seed less
        measured = MEASURED.get(column, (column, "track_percentage"))
        values = [of[(*trained_as(policy), *measured)] for policy, *_ in rows]
        differs = [False, *(p < 0.05 for p in holm([welch(each, values[0]) for each in values[1:7]])), False]
        differs.append(welch(values[8], values[7]) < 0.05)
        digits = 3 if measured[1] == "track_percentage" else 0
        found = [f"{each.mean():.{digits}f}" + "*" * int(star) for each, star in zip(values, differs, strict=True)]
        assert [cells[1 + number] for _, *cells in rows] == found, column
        assert [len(each) for each in values] == [
            int(seeds) - (0 < i <= fewer) for i, (_, seeds, *_) in enumerate(rows)
        ]


def test_other_conditions(conditions):
    """What is said of drops, ideal motors and SATA; of smoothness and noise, stars of the table say it."""
    text, late = text_of("results.md", "**Other conditions**"), "late by 0 to 10 ms"
    of = conditions.set_index(["trained", "condition", "metric", "task"]).sort_index(kind="stable")["mean"]
    drops = of.xs("drop 50 cm", level="condition").xs("falls_per_minute", level="metric").groupby(level=[0, 1]).mean()
    one = of.xs("drop 50 cm", level="condition").xs("falls_per_minute", level="metric").max()
    assert f"falls more than {drops.max():.1f} times a minute, one training of the combination {one:.1f} times" in text
    peaks = of.xs("drop 50 cm", level="condition").xs("peak_force", level="metric")
    recipe, tuned = (
        peaks[trained_as(policy)] for policy in ("default torque, 20 ms, damping, history", "PD, 20 ms, tuned")
    )
    assert f"{1 - recipe.mean() / tuned.mean():.0%} below tuned PD's (p = {welch(recipe, tuned):.3f})" in text
    base = text_of("results.md", "- **Trained with ideal motors**")
    ideal = of["ideal motors, no latency"].xs("track_percentage", level="metric")
    mean = ideal.groupby(level=[0, 1]).mean().unstack(level=0)
    assert (mean["real motors"] - mean["as trained"]).abs().max() < 0.0015 and len(ideal) == 45
    lost = (mean["as trained"] - mean["real motors 10 ms"])[["a1_position", "a1_torque_multihead", "a1_torque"]]
    assert "PD loses {:.3f}, torque multi-head {:.3f} and default torque {:.3f}".format(*lost) in base
    sata = of[late, "as trained", "track_percentage", "a1_sata"]
    assert f"{len(sata)} seeds track {sata.min():.2f} to {sata.max():.2f}".replace("3 seeds", "three seeds") in base


def test_repeated_trainings():
    """The same settings and seed on another machine, by commits that train alike, give the same sweeps."""
    data = pd.read_csv(DOCS / "results" / "repeated.csv.gz")
    apart = (data["track_percentage"] - data["first"].round(4)).abs()
    trainings = data.groupby(["task", "trained", "seed", "commit"]).ngroups
    assert apart.max() < 1e-6 and (data["commit"] != data["first_commit"]).all()
    sweeps = data.groupby(["task", "trained", "seed", "commit", "parameter"]).ngroups
    different = data.groupby(["task", "trained", "seed"]).ngroups
    said = f"{different} trainings, {trainings - different} of them twice, tracked the same to four decimals in all "
    said += f"{sweeps} sweeps and conditions"
    assert said in text_of("results.md", "## What policies bear")


def test_what_policies_bear(swept):
    """What the sentences say: latency of seven approaches, pushes and payload of five, energy of two."""
    text, base = text_of("results.md", "## What policies bear"), swept.loc[BASE]
    pushed = base.loc["push_velocity", "fell", 3.5].groupby("task").mean()
    names = ("position", "torque", "torque_multihead", "torque_curriculum_multihead", "torque_curriculum")
    words = "{:.2f} of the robots under PD, {:.2f} under default torque, {:.2f} under torque multi-head, {:.2f} under "
    words += "the combination and {:.2f} under the curriculum"
    assert words.format(*pushed[[f"a1_{name}" for name in names]]) in text
    assert f"curriculum; {pushed['a1_variable_stiffness']:.2f} under variable stiffness." in text
    both = pd.concat([swept.loc[trained, "push_velocity", "fell", 3.5] for trained in (BASE, f"{BASE} (earlier)")])
    both = {name: both[f"a1_{name}"] for name in names}
    p = dict(zip(names[1:], holm([welch(both[name], both["position"]) for name in names[1:]]), strict=True))
    said = f"default torque falls less ({both['torque'].mean():.2f} against {both['position'].mean():.2f}, p = "
    said += f"{p['torque']:.2f}), torque multi-head, too ({both['torque_multihead'].mean():.2f}, p = "
    said += f"{p['torque_multihead']:.2f}), and the curriculum more ({both['torque_curriculum'].mean():.2f}, p = "
    assert f"{said}{p['torque_curriculum']:.3f})." in text and {10} == {len(each) for each in both.values()}
    late = base.loc["action_delay", "track_percentage", 6.0]
    others = [f"a1_{name}" for name in names[1:]]
    position, torque, decap = late["a1_position"], late[others], late["a1_decap"]
    said = f"PD tracks {position.min():.2f} to {position.max():.2f}, variable stiffness "
    stiffness = late["a1_variable_stiffness"]
    assert f"{said}{stiffness.min():.2f} to {stiffness.max():.2f}, torque with" in text
    assert f"PD bias {decap.min():.2f} to {decap.max():.2f}, and the other four" in text
    assert f"approaches {torque.min():.2f} to {torque.max():.2f}. - **Pushes**" in text
    masses = base.loc["trunk_mass", "track_percentage"].groupby(["from", "task"]).mean().unstack()
    costs = masses.iloc[0] - masses.iloc[-1]
    low, high = costs[others].min(), costs[others].max()
    assert f"costs PD {costs['a1_position']:.3f}" in text and f"these four {low:.3f} to {high:.3f}. From" in text
    ends = []
    for steps in (0.0, 2.0):
        for task in ("a1_torque_multihead", "a1_position"):
            energy = base.loc["action_delay", "cost_of_transport", steps, task]
            ends.append(f"{energy.min():.3f} to {energy.max():.3f}")
    assert "has a cost of transport of {}, PD of {}; with actions 10 ms late {} and {}.".format(*ends) in text
    grip = base.loc["ground_friction", "track_percentage"].groupby(["from", "task"]).mean().unstack()
    lost = grip.max() - grip[grip.index >= 0.44].min()
    assert 0.02 < lost.max() < 0.03 and "From a friction of 0.45 on, all stay within 0.03 of their best" in text
