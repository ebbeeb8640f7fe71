"""The tables of the documents, recomputed from the raw data beside them."""

from pathlib import Path

import pandas as pd
import pytest

from legged_torque.paper.report.tables import holm, welch

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
KINDS = {name: [name.replace(" ", "_")] for name in ("stairs up", "stairs down", "stepping stones", "gaps", "pits")}
KINDS |= {"obstacles": ["discrete_obstacles"]}
KINDS |= {"slopes, waves, flat": ["flat", "smooth_slope_up", "smooth_slope_down", "rough_slope", "waves"]}


def text_of(page, heading):
    """A page from a heading on, in one line."""
    return " ".join((DOCS / page).read_text("utf-8").partition(heading)[2].split())


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
            value = measured.get((f"{TASKS[method]}_high", environment), measured.get((TASKS[method], environment)))
            assert same(number, value), (method, environment, number, value)


def test_hard_ranges():
    """Tracking, velocity error and cost of transport with hard ranges."""
    measured = means("results/hard/evaluations.csv.gz")
    _, rows = rows_of("results.md", "method | tracking, low")
    metrics = [name for name in ("track_percentage", "track_xy", "cost_of_transport") for _ in range(2)]
    for method, *numbers in rows:
        for number, metric, environment in zip(numbers, metrics, 3 * ["low", "high"], strict=True):
            values = measured[metric]
            value = values.get((f"{TASKS[method]}_high", environment), values.get((TASKS[method], environment)))
            assert same(number, value), (method, metric, environment, number, value)


def test_latency():
    """Lowest and highest seed of policies that were trained without latency."""
    data = pd.read_csv(DOCS / "results" / "latency.csv").set_index(["robot", "trained_with", "latency_ms", "method"])
    torque, position = (data.loc[("a1", "ideal", "20", method)] for method in ("torque_multihead", "position"))
    low, high = ((of["track_percentage"].min(), of["track_percentage"].max()) for of in (torque, position))
    falls, text = torque["falls_per_minute"], text_of("randomization.md", "## Delays")
    assert f"{low[0]:.3f} to {low[1]:.3f} with actions 20 ms late" in text
    often = f"falls {falls.min():.0f} to {falls.max():.0f} times a minute"
    assert f"{often}; PD tracks {high[0]:.3f} to {high[1]:.3f}" in text


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
        assert all(same(numbers[columns.index(name) - 1], value) for name, value in values.items()), (policy, values)


@pytest.fixture(scope="module")
def swept():
    """Sweeps of newly trained A1s."""
    data = pd.read_csv(DOCS / "results" / "robustness.csv.gz")
    return data.set_index(["trained", "parameter", "metric", "from", "task"]).sort_index()["mean"]


def test_cures_of_latency(swept):
    """Lowest and highest seed by latency and training, and of falls after pushes."""
    trained = {"10 ms": "late by 0 to 10 ms", "30 ms": "late by 0 to 30 ms", "10 ms, damping": "damping on the drive"}
    trained |= {"30 ms, damping": "late by 0 to 30 ms, damping on the drive", "10 ms, 200 Hz": "policy at 200 Hz"}
    columns = [("action_delay", "track_percentage", steps) for steps in (0.0, 4.0, 6.0)]
    columns += [("push_velocity", "fell", 3.5)]
    _, rows = rows_of("results.md", "policy, latest actions in training")
    assert len(rows) == 11
    for policy, *cells in rows:
        method, how = policy.split(", ", 1)
        for cell, column in zip(cells, columns, strict=True):
            key = (trained[how], *column, TASKS[method])
            assert (cell == "–") == (key not in swept.index)
            if cell != "–":
                values = swept.loc[key]
                assert len(values) == (5 if how == "10 ms" else 3)
                low, high = cell.split(", ")
                assert same(low, values.min()) and same(high, values.max()), (policy, column)


def test_what_policies_bear(swept):
    """What the sentences on pushes, latency, payload and energy say of five approaches."""
    text, base = text_of("results.md", "## What policies bear"), swept.loc["late by 0 to 10 ms"]
    pushed = base.loc["push_velocity", "fell", 3.5].groupby("task").mean()
    names = ("position", "torque", "torque_multihead", "torque_curriculum_multihead", "torque_curriculum")
    words = "{:.2f} of the robots under PD, {:.2f} under default torque, {:.2f} under torque multi-head, {:.2f} under "
    words += "the combination and {:.2f} under the curriculum"
    assert words.format(*pushed[[f"a1_{name}" for name in names]]) in text
    late = base.loc["action_delay", "track_percentage", 6.0]
    position, torque = late["a1_position"], late.drop("a1_position")
    assert f"PD tracks {position.min():.2f} to {position.max():.2f}, the four torque approaches" in text
    assert f"approaches {torque.min():.2f} to {torque.max():.2f}. - **Pushes**" in text
    masses = base.loc["trunk_mass", "track_percentage"].groupby(["from", "task"]).mean().unstack()
    costs = masses.iloc[0] - masses.iloc[-1]
    others = costs.drop("a1_position")
    assert f"costs PD {costs['a1_position']:.3f}" in text and f"{others.min():.3f} to {others.max():.3f}. From" in text
    for steps in (0.0, 2.0):
        for task in ("a1_torque_multihead", "a1_position"):
            energy = base.loc["action_delay", "cost_of_transport", steps, task]
            assert f"{energy.min():.3f} to {energy.max():.3f}" in text


def test_low_again():
    """Means and standard errors of seeds, and what torque multi-head saves."""
    seeds_of = pd.read_csv(DOCS / "results" / "low.csv.gz").groupby(["task", "seed"]).mean()
    data, others = seeds_of.groupby("task"), [task for task in TASKS.values() if task != "a1_position"]
    metrics = ["track_percentage", "track_xy", "track_angular", "cost_of_transport"]
    _, rows = rows_of("results.md", "method | seeds")
    for method, seeds, *cells in rows:
        means, errors = (of.loc[TASKS[method]] for of in (data.mean(), data.sem()))
        assert int(seeds) == data.size()[TASKS[method]]
        for cell, metric in zip(cells, metrics, strict=True):
            mean, error = cell.split(" ± ")
            assert same(mean, means[metric]) and same(error, errors[metric]), (method, metric)
    costs = data.mean()["cost_of_transport"] / data.mean()["cost_of_transport"]["a1_position"]
    text = text_of("results.md", "## `low` again")
    p = {m: holm([welch(seeds_of[m][t], seeds_of[m]["a1_position"]) for t in others]) for m in metrics}
    less, p_less = 1 - costs["a1_torque_multihead"], p["cost_of_transport"][others.index("a1_torque_multihead")]
    assert f"torque multi-head needs {less:.0%} less than PD (p = {p_less:.3f})" in text
    more = [f"{costs[f'a1_torque_curriculum{name}'] - 1:.0%}" for name in ("", "_multihead")]
    assert f"the curriculum needs {more[0]} and the combination {more[1]} more" in text
    assert len(rows) == 7 and max(*p["track_percentage"], *p["track_xy"]) < 0.05
    assert [others[i] for i in range(6) if p["track_angular"][i] >= 0.05] == ["a1_torque_curriculum"]


def test_learners():
    """Million steps to 50 and 70% and tracking at the end, lowest and highest of the seeds that came so far."""
    data = pd.read_csv(DOCS / "results" / "learners.csv.gz").query("total != 12000000")  # those are of docs/tried.md
    _, rows = rows_of("howto/learner.md", "task | 50%: PPO")
    assert len(rows) == 6
    for task, *cells in rows:
        for number, cell in enumerate(cells):
            learner = ("PPO", "PPO, 128 worlds", "FlashSAC")[number % 3]
            chosen = data[(data["task"] == task.strip("`")) & (data["learner"] == learner)]
            runs = [run for _, run in chosen.groupby("seed")]
            if number < 6:
                reached = [run[run["track_percentage"] >= (0.5, 0.7)[number // 3]]["steps"].min() / 1e6 for run in runs]
                texts = [f"{steps:.0f}" for steps in sorted(steps for steps in reached if steps > 0)]
            else:
                ended = [run for run in runs if run["steps"].max() > 0.97 * run["total"].max()]
                tails = [run[run["steps"] > 0.9 * run["total"]]["track_percentage"].mean() for run in ended]
                texts = [f"{value:.2f}" for value in sorted(tails)]
            said = "–".join(dict.fromkeys((texts[0], texts[-1]))) if texts else "–"
            assert cell == said + (f" ({len(texts)})" if 0 < len(texts) < 4 else ""), (task, number)


def test_students():
    """Shares of tiles that teachers and students cross."""
    data = pd.read_csv(DOCS / "results" / "students.csv.gz").groupby(["policy", "kind", "robot"])["crossed"].mean()
    crossed, text = data.groupby(["policy", "robot"]).mean(), text_of("howto/learner.md", "## Students")
    assert "Teachers cross {:.2f} and {:.2f} of".format(*crossed["teacher"]) in text
    assert {f"{share:.2f}" for share in crossed["student"]} == {"0.72"} and "students 0.72" in text
    stairs = data.xs("stairs_up", level="kind")
    assert "of stairs up {:.2f}, {:.2f} and {:.2f}".format(stairs["teacher", "a1"], *stairs["student"]) in text


def test_sweeps():
    """What is said of the latency of bundled policies."""
    data = pd.read_csv(DOCS / "results" / "sweeps.csv.gz").set_index(["parameter", "metric", "from", "task"])["mean"]
    late, ends = data["action_delay", "track_percentage", 6.0], []
    for approach in ("position", "torque_multihead"):
        tracking = late[[f"{robot}_{approach}" for robot in ("go1", "go2", "anymal_c")]]
        ends.append(f"{tracking.min():.2f} to {tracking.max():.2f}")
    text = text_of("results.md", "## What policies bear")
    assert f"with 30 ms PD tracks {ends[0]}, torque multi-head {ends[1]} (" in text
