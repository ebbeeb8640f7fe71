"""The numbers of the study of what policies bear, recomputed from the raw data beside the documents."""

import re

import pandas as pd
import pytest
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
    method, late, how = re.fullmatch(r"(.+?), (\d+ ms)((?:, \w+)*)", policy.strip("*")).groups()
    return ", ".join([f"late by 0 to {late}", *(more[each] for each in how.split(", ")[1:])]), tasks[method]


def p_text(first, second):
    """How the documents write p of Welch's test."""
    p = welch(first, second)
    return "p < 0.001" if p < 0.001 else f"p = {p:.3f}" if p < 0.0095 else f"p = {p:.2f}"


RECIPE, MORE = "default torque, 20 ms, damping, history", "torque multi-head, 20 ms, damping, history"


def test_cures_of_latency(swept):
    """Lowest and highest seed by latency and training, and of falls after pushes; the best against tuned PD."""
    columns = [("action_delay", "track_percentage", steps) for steps in (0.0, 4.0, 6.0)]
    columns += [("push_velocity", "fell", 3.5)]
    _, rows = rows_of("results.md", "policy, latest actions in training")
    assert len(rows) == 12

    def values(policy, column):
        trained, task = trained_as(policy)
        return swept.loc[(trained, *columns[column], task)]

    for policy, *cells in rows:
        for column, cell in enumerate(cells):
            found, (low, high) = values(policy, column), cell.split(", ")
            assert len(found) == 5 and same(low, found.min()) and same(high, found.max()), (policy, column)
    text = text_of("results.md", "- **Torque with damping and latency")
    (at_20, at_30, fell), (more_20, more_30, more_fell), (pd_20, pd_30, pd_fell) = (
        [values(policy, column) for column in (1, 2, 3)] for policy in (RECIPE, MORE, "PD, 20 ms, tuned")
    )
    said = f"tracks {at_20.mean():.3f}, torque multi-head {more_20.mean():.3f}, PD {pd_20.mean():.3f}"
    assert f"{said} ({p_text(at_20, pd_20)} and {welch(more_20, pd_20):.3f});" in text
    said = f"over {fell.mean():.2f}, {more_fell.mean():.2f} and {pd_fell.mean():.2f} ({p_text(fell, pd_fell)} and "
    assert f"{said}{p_text(more_fell, pd_fell)})" in text
    less = [pd_30.mean() - each.mean() for each in (at_30, more_30)]
    said = "{:.3f} and {:.3f} less than PD ".format(*less)
    assert f"{said}({p_text(at_30, pd_30)} and {p_text(more_30, pd_30)})," in text
    seen, pd_seen = values("torque multi-head, 30 ms, damping, history", 2), values("PD, 30 ms, tuned", 2)
    assert f"that has seen them {pd_seen.mean() - seen.mean():.3f} ({p_text(seen, pd_seen)})." in text
    before = []
    for policy in (RECIPE, "PD, 20 ms, tuned"):
        trained, task = trained_as(policy)
        before.append(swept.loc[(f"{trained} (former defaults)", *columns[1], task)])
    said = "defaults, it tracked {:.3f} in seven seeds and PD {:.3f};".format(*(each.mean() for each in before))
    assert said in text and [len(each) for each in before] == [7, 5]
    (plain, plain_fell), (damped, damped_fell) = (
        [values(f"torque multi-head, 20 ms{how}", column) for column in (2, 3)] for how in ("", ", damping")
    )
    assert f"not seen: {damped.mean():.3f} instead of {plain.mean():.3f} at 30 ms ({p_text(damped, plain)})" in text
    said = f"{damped_fell.mean():.2f} instead of {plain_fell.mean():.2f} ({p_text(damped_fell, plain_fell)}), and less "
    assert f"{said}again with **history**, {more_fell.mean():.2f} ({p_text(more_fell, damped_fell)})" in text
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
    """Means over seeds, and which differ significantly from PD for 10 ms, the last two rows from PD for 20 ms."""
    columns, rows = rows_of("results.md", "policy | undisturbed")
    of = conditions.set_index(["trained", "task", "condition", "metric"]).sort_index(kind="stable")["mean"]
    assert len(rows) == 10
    for number, column in enumerate(columns[1:]):
        measured = MEASURED.get(column, (column, "track_percentage"))
        values = [of[(*trained_as(policy), *measured)] for policy, *_ in rows]
        differs = [False, *(p < 0.05 for p in holm([welch(each, values[0]) for each in values[1:7]])), False]
        differs += [welch(each, values[7]) < 0.05 for each in values[8:]]
        digits = 3 if measured[1] == "track_percentage" else 0
        found = [f"{each.mean():.{digits}f}" + "*" * int(star) for each, star in zip(values, differs, strict=True)]
        assert [cells[number] for _, *cells in rows] == found, column
        assert {len(each) for each in values} == {5}


def test_other_conditions(conditions):
    """What is said of energy, drops, a dead leg, former defaults and SATA; of the rest, stars of the table say it."""
    text, late = text_of("results.md", "**Other conditions**"), "late by 0 to 10 ms"
    of = conditions.set_index(["trained", "task", "condition", "metric"]).sort_index(kind="stable")["mean"]
    policies = [policy for policy, *_ in rows_of("results.md", "policy | undisturbed")[1]]
    drops = [of[(*trained_as(policy), "drop 50 cm", "falls_per_minute")] for policy in policies]
    assert f"falls more than {max(each.mean() for each in drops):.1f} times a minute" in text
    most = max(each.max() for each in drops)
    assert f"one training with a decaying bias {most:.1f} times." in text
    assert most == of[late, "a1_decap", "drop 50 cm", "falls_per_minute"].max()
    assert max(drops, key=lambda each: each.mean()) is drops[policies.index("decaying PD bias, 10 ms")]
    tuned, *recipes = (
        of[(*trained_as(policy), "drop 50 cm", "peak_force")] for policy in ("PD, 20 ms, tuned", RECIPE, MORE)
    )
    assert {f"{1 - each.mean() / tuned.mean():.0%}" for each in recipes} == {"4%"}
    said = "is 4% below tuned PD's (p = {:.3f} and {:.3f})"
    assert said.format(*(welch(each, tuned) for each in recipes)) in text
    tuned, more = (of[(*trained_as(policy), "dead leg", "falls_per_minute")] for policy in ("PD, 20 ms, tuned", MORE))
    assert f"history least (tuned PD: p = {welch(more, tuned):.3f})" in text
    tuned, *recipes = (
        of[(*trained_as(policy), "as trained", "cost_of_transport")] for policy in ("PD, 20 ms, tuned", RECIPE, MORE)
    )
    said = "of {:.2f} and {:.2f} as trained, PD of {:.2f} ".format(*(each.mean() for each in (*recipes, tuned)))
    chances = " and ".join(p_text(each, tuned) for each in recipes)
    assert f"{said}({chances})." in text_of("results.md", "- **Torque with damping and latency")
    base = text_of("results.md", "- **SATA**")
    sata = of[late, "a1_sata", "as trained", "track_percentage"]
    assert f"seeds track {sata.min():.2f} to {sata.max():.2f}" in base and len(sata) == 3
    pairs = [
        [of[when, f"a1_{task}", "as trained", metric] for when in (f"{late} (former defaults)", late)]
        for task, metric in (
            ("torque_multihead", "track_percentage"),
            ("torque", "cost_of_transport"),
            ("variable_stiffness", "cost_of_transport"),
        )
    ]
    (track, torque, stiffness), p = (
        [[each.mean() for each in pair] for pair in pairs],
        [p_text(*each) for each in pairs],
    )
    assert f"head {track[0]:.3f} of tracking instead of {track[1]:.3f} ({p[0]})" in base
    assert f"of transport of {torque[0]:.2f} instead of {torque[1]:.2f} ({p[1]}) and" in base
    assert f"stiffness {stiffness[0]:.2f} instead of {stiffness[1]:.2f} ({p[2]};" in base


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


def test_what_policies_bear(swept, conditions):
    """What the sentences say of seven approaches: latency, pushes, payload and friction; energy of two."""
    text, base = text_of("results.md", "## What policies bear"), swept.loc[BASE]
    trained = conditions.query(f"trained == '{BASE}' and condition == 'as trained' and metric == 'track_percentage'")
    trained = trained.set_index("task")["mean"]
    ours, position = (trained[f"a1_{name}"] for name in ("torque_multihead", "position"))
    said = f"torque multi-head tracks {ours.mean():.3f} and PD {position.mean():.3f} (p = {welch(ours, position):.2f})"
    ours, position = (
        base.loc["action_delay", "track_percentage", 2.0, f"a1_{name}"] for name in ("torque_multihead", "position")
    )
    late = f"with actions 10 ms late {ours.mean():.3f} and {position.mean():.3f} ({p_text(ours, position)}, not"
    assert f"{said}, {late} corrected)" in text
    pushed = base.loc["push_velocity", "fell", 3.5]
    names = ("position", "torque", "torque_multihead", "torque_curriculum_multihead", "torque_curriculum")
    names += ("variable_stiffness", "decap")
    pushed = [pushed[f"a1_{name}"] for name in names]
    words = "{:.2f} of the robots under PD, {:.2f} under default torque, {:.2f} under torque multi-head, {:.2f} under "
    words += "the combination and {:.2f} under the curriculum; {:.2f} under variable stiffness and {:.2f} under a "
    words += "decaying bias."
    assert words.format(*(each.mean() for each in pushed)) in text
    p = holm([welch(each, pushed[0]) for each in pushed[1:]])
    said = f"from {pushed[0].min():.2f} to {pushed[0].max():.2f}, and no difference to PD is significant"
    assert said in text and min(p) > 0.05 and f"; torque multi-head p = {p[1]:.2f})" in text
    late = base.loc["action_delay", "track_percentage", 6.0]
    ends = [late[f"a1_{name}"] for name in ("position", "variable_stiffness", "decap")]
    ends.append(late[[f"a1_{name}" for name in names[1:5]]])
    said = "PD tracks {} to {}, variable stiffness {} to {}, torque with a decaying PD bias {} to {}, and the other "
    said += "four torque approaches {} to {}."
    assert said.format(*(f"{end:.2f}" for each in ends for end in (each.min(), each.max()))) in text
    masses = base.loc["trunk_mass", "track_percentage"].groupby(["from", "task"]).mean().unstack()
    costs = masses.iloc[0] - masses.iloc[-1]
    others = costs.drop("a1_position")
    said = f"costs PD {costs['a1_position']:.3f} of tracking, the other six {others.min():.3f} to {others.max():.3f}."
    assert said in text and len(others) == 6
    ends = []
    for steps in (0.0, 2.0):
        for task in ("a1_torque_multihead", "a1_position"):
            energy = base.loc["action_delay", "cost_of_transport", steps, task]
            ends.append(f"{energy.min():.3f} to {energy.max():.3f}")
    assert "has a cost of transport of {}, PD of {}; with actions 10 ms late {} and {}.".format(*ends) in text
    grip = base.loc["ground_friction", "track_percentage"].groupby(["from", "task"]).mean().unstack()
    lost = grip.max() - grip[grip.index >= 0.44].min()
    assert 0.02 < lost.max() < 0.03 and "From a friction of 0.45 on, all stay within 0.03 of their best" in text
