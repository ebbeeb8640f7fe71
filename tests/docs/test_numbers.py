"""The tables of the documents, recomputed from the raw data beside them."""

import re
from itertools import product

import pandas as pd
import pytest
from support.documents import DOCS, METRICS, TASKS, iqm, rows_of, same, text_of

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.paper.report.tables import holm, welch
from legged_torque.paper.values import TABLE_I
from legged_torque.utils.config import to_dict


@pytest.fixture(scope="module")
def table_one():
    """Table I: the number of each seed, by environment and task."""
    data = pd.read_csv(DOCS / "results" / "evaluations.csv.xz").query("steps >= 90e6").drop(columns="steps")
    return data.groupby(["environment", "task", "seed"]).mean()


def test_table_one(table_one):
    """Tracking of each method in each environment."""
    measured = table_one["track_percentage"].groupby(["environment", "task"]).agg(iqm)
    columns, rows = rows_of("results.md", "method | low | paper")
    assert len(rows) == 7
    for method, *numbers in rows:
        for environment, number in zip(columns[1::2], numbers[::2], strict=True):
            assert same(number, measured[environment, TASKS[method]]), (method, environment, number)
    assert table_one.groupby(["environment", "task"]).size().tolist() == 28 * [10]


def test_findings(table_one):
    """Who is significantly better or worse than PD, in which metric and environment, and who needs how much energy."""
    others = [task for task in TASKS.values() if task != "a1_position"]
    better, worse, less = {}, {}, {}
    for environment, metric in product(("low", "high", "high_frequency", "doubled"), METRICS):
        values = dict(list(table_one.loc[environment][metric].groupby("task")))
        own = values["a1_position"]
        p = holm([welch(values[task], own) for task in others])
        different = [task for task, value in zip(others, p, strict=True) if value < 0.05]
        is_up = {task: iqm(values[task]) > iqm(own) for task in others}
        for found, up in ((better, metric == "track_percentage"), (worse, metric != "track_percentage")):
            found.setdefault(metric, []).append([task for task in different if is_up[task] == up])
        less[environment, metric] = {task: 1.0 - iqm(values[task]) / iqm(own) for task in others}
    curricula = ["a1_torque_curriculum", "a1_torque_curriculum_multihead"]
    text, count = text_of("results.md", "# Results"), {key: sum(map(len, found)) for key, found in worse.items()}
    numbers = [("no", "one", "two", "three", "four", "five", "six")[len(each)] for each in worse["track_percentage"]]
    names = ("`low`, {} in `high`, {} in `high_frequency` and {} in `doubled`").format(*numbers[1:])
    assert f"significantly better than {numbers[0]} of six in {names}" in text and not any(better["track_percentage"])
    assert f"most exact, in {count['track_xy']} of 24 comparisons significantly" in text and not any(better["track_xy"])
    exact = [*map(len, better["track_angular"])]
    assert f"exactly than PD, in {sum(exact)} of 24 comparisons" in text and exact == [5, 6, 5, 5]
    assert better["cost_of_transport"] == [["a1_torque_multihead"], ["a1_torque_multihead"], [], []]
    first = ["a1_torque_gravity", *curricula]
    assert worse["cost_of_transport"] == [first, curricula, curricula[:1], curricula[:1]]
    more = [-less[name, METRICS[-1]]["a1_torque_curriculum"] for name in ("doubled", "low")]
    assert f"The curriculum needs {100 * more[0]:.0f} to {more[1]:.0%} more in all columns" in text
    low, high = (less[name, METRICS[-1]] for name in ("low", "high"))
    saved = [f"{each['a1_torque_multihead']:.0%}" for each in (low, high)]
    assert f"needs {saved[0]} less than PD in `low` and {saved[1]} less in `high`" in text
    assert f"Here it is {low['a1_multihead']:.0%}".rstrip("%") + f" (not significantly) and {saved[0]}" in text
    assert f"the curricula {-low[curricula[1]]:.0%}".rstrip("%") + f" and {-low[curricula[0]]:.0%} more" in text
    torque = table_one["track_percentage"].drop("doubled").xs("a1_torque", level="task")
    learned = f"learned in {len(torque)} of {len(torque)} trainings with a torque scale of 8"
    assert f"{learned} (tracking {torque.min():.3f} to {torque.max():.3f})" in text


def test_table_two():
    """With Table II's PPO: tracking, how many numbers are better than the paper's, and energy."""
    data = pd.read_csv(DOCS / "results" / "table_ii.csv.xz").drop(columns="commit")
    assert data.groupby(["task", "seed"])["steps"].max().gt(109e6).sum() == 20
    seeds = data.query("steps >= 90e6").groupby(["task", "seed"]).mean()
    measured = seeds.groupby("task").mean()
    row = next(cells for cells in rows_of("results.md", "ranges | PPO")[1] if cells[:2] == ["`default`", "Table II"])
    tasks = [f"a1_{name}" for name in ("position", "torque_multihead", "multihead", "torque_curriculum")]
    assert all(same(text, measured["track_percentage"][task]) for text, task in zip(row[3:7], tasks, strict=True))
    won = {
        metric: [(measured[metric][task] > TABLE_I[metric, task][0]) == (metric == METRICS[0]) for task in tasks]
        for metric in [*METRICS, "collision_force"]
    }
    assert [*map(sum, won.values())] == [3, 0, 3, 4, 4] and row[7:] == ["6 of 12", "4 of 4", "4 of 4"]
    text, cost = text_of("results.md", "**With Table II"), measured["cost_of_transport"]
    saved = [100 * (1 - cost[f"a1_{name}"] / cost["a1_position"]) for name in ("multihead", "torque_multihead")]
    assert "need {:.0f} and {:.0f}% less than PD".format(*saved) in text and not won["track_percentage"][3]
    torque = sorted(seeds["track_percentage"]["a1_torque"], reverse=True)
    said = f"two of four trainings ({', '.join(f'{value:.3f}' for value in torque)})"
    assert said in text and torque[1] > 0.7 > torque[2]


def test_hard_ranges():
    """With hard ranges: who tracks and turns significantly better than PD, and who needs less energy."""
    data = pd.read_csv(DOCS / "results" / "hard" / "evaluations.csv.xz").drop(columns=["steps", "commit"])
    seeds = data.groupby(["environment", "task", "seed"]).mean()
    assert seeds.groupby(["environment", "task"]).size().tolist() == 14 * [5]
    text, others = text_of("results.md", "## Hard ranges"), [task for task in TASKS.values() if task != "a1_position"]
    better, mean = {}, seeds.groupby(["environment", "task"]).mean()
    for name, metric in product(("low", "high"), METRICS):
        values = dict(list(seeds.loc[name][metric].groupby("task")))
        p = holm([welch(values[task], values["a1_position"]) for task in others])
        better[name, metric] = [task for task, value in zip(others, p, strict=True) if value < 0.05]
    tasks = [f"a1_{name}" for name in ("position", "torque_multihead", "multihead", "torque_curriculum")]
    combination = "a1_torque_curriculum_multihead"
    first = ["a1_torque_gravity", "a1_torque_curriculum", combination]
    assert (better["low", "track_percentage"], better["high", "track_percentage"]) == ([], first)
    tracking = mean["track_percentage"]
    assert {f"{value:.3f}" for value in tracking["high"][first]} == {"0.657"}
    assert (
        "In `high`, gravity pre-training, the torque curriculum and the combination track 0.657, significantly" in text
    )
    assert sorted(tracking["high"][tasks], reverse=True) == [tracking["high"][tasks[i]] for i in (3, 1, 0, 2)]
    curriculum = [tracking[name]["a1_torque_curriculum"] - tracking[name]["a1_position"] for name in ("low", "high")]
    against = text_of("results.md", "## Against the paper")
    assert "it is better by {:.3f} (not significantly) and {:.3f}.".format(*curriculum) in against
    own, low = seeds["track_percentage"]["low", "a1_position"], tracking["low"][others]
    gained = tracking["high"][first] - tracking["high"]["a1_position"]
    opening = text_of("results.md", "# Results")
    assert f"track {gained.min():.3f} to {gained.max():.3f} better than PD." in opening
    assert f"than PD with {tracking['high']['a1_position']:.3f}." in text
    assert f"PD tracks {own.mean():.3f} ({own.min():.3f} to {own.max():.3f}), the" in text
    assert f"methods track {low.min():.3f} to {low.max():.3f}, not" in text
    turning = [len(better[name, "track_angular"]) for name in ("low", "high")]
    assert turning == [5, 3] and "In `low` five torque methods and in `high` three turn" in text
    assert better["low", "track_xy"] == better["high", "track_xy"] == []
    change = {metric: mean[metric].unstack("task") for metric in ("track_angular", "cost_of_transport")}
    less = {metric: 1.0 - of.div(of["a1_position"], axis=0) for metric, of in change.items()}
    assert f"exactly than PD, by up to {less['track_angular'].to_numpy().max():.0%}, and" in text
    assert [better[name, METRICS[-1]] for name in ("low", "high")] == 2 * [[combination]]
    saved = less["cost_of_transport"][combination]
    assert f"the combination needs {100 * saved['low']:.0f} and {saved['high']:.0%} less energy" in text
    heads = [less["cost_of_transport"][f"a1_{name}"]["low"] for name in ("multihead", "torque_multihead")]
    assert f"with hard ranges {100 * heads[0]:.0f} and {heads[1]:.0%}, not significantly" in against
    row = next(cells for cells in rows_of("results.md", "ranges | PPO")[1] if cells[0] == "`hard`")
    assert row[2] == "5"
    assert all(same(number, tracking["low"][task]) for number, task in zip(row[3:7], tasks, strict=True))
    won = {
        metric: [
            (mean[metric][name, task] > TABLE_I[metric, task][column]) == (metric == METRICS[0])
            for task, (column, name) in product(tasks, enumerate(("low", "high")))
        ]
        for metric in [*METRICS, "collision_force"]
    }
    assert [*map(sum, won.values())] == [0, 0, 0, 0, 8] and row[7:] == ["0 of 24", "0 of 8", "8 of 8"]


def test_latency():
    """Lowest and highest seed of policies that were trained without latency."""
    data = pd.read_csv(DOCS / "results" / "latency.csv").set_index(["robot", "trained_with", "latency_ms", "method"])
    torque, position = (data.loc[("a1", "ideal", "20", method)] for method in ("torque_multihead", "position"))
    low, high = ((of["track_percentage"].min(), of["track_percentage"].max()) for of in (torque, position))
    falls, text = torque["falls_per_minute"], text_of("randomization.md", "## Delays")
    assert f"{low[0]:.3f} to {low[1]:.3f} with actions 20 ms late" in text
    often = f"falls {falls.min():.0f} to {falls.max():.0f} times a minute"
    assert f"{often}; PD tracks {high[0]:.3f} to {high[1]:.3f}" in text


def test_tuned_gains(table_one):
    """How many settings of PD were tried with how many seeds, which came out, and what it tracks."""
    data, settings = pd.read_csv(DOCS / "results" / "pd_gains.csv"), ["stiffness", "damping", "action_scale"]
    tried = data[data["seed"] > 20].groupby([*settings, "max_learning_rate"])["track_percentage"]
    again = tried.mean()[tried.size() == 3]
    assert (len(tried), len(again)) == (21, 3) and set(again.index) == set(tried.first().nlargest(3).index)
    assert again.idxmax() == (20.0, 1.0, 0.25, 0.01)
    own, tuned = table_one.loc["low", "a1_position"]["track_percentage"], data[data["seed"] <= 5]["track_percentage"]
    said = f"With seeds 1 to 5, it tracks {iqm(tuned):.3f}, PD of ten seeds {iqm(own):.3f}."
    assert len(tuned) == 5 and said in text_of("results.md", "**PD was tuned**")


def test_learners():
    """Million steps to 50 and 70% and tracking at the end, lowest and highest of the seeds that came so far."""
    data = pd.read_csv(DOCS / "results" / "learners.csv.xz").query("total != 12000000")  # those are of docs/tried.md
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
    """How much less than their teachers students track on kinds of tiles of the training, and how many fewer cross."""
    text = text_of("howto/learner.md", "## Students").replace("\n", " ")
    data = pd.read_csv(DOCS / "results" / "students.csv.xz").groupby(["policy", "robot", "seed", "robots", "kind"])
    trained = [kind for kind, share in to_dict(LeggedRobotCfg().terrain.terrain_proportions).items() if share]
    assert len(trained) == 6
    runs = pd.read_csv(DOCS / "tried.csv.xz").query("run == 'student/60M'").groupby(["run", "task", "seed"])
    seconds = runs["seconds"].max()["student/60M"]
    assert f"60 million took {seconds.min():.0f} to {seconds.max():.0f} s" in text
    crossed, tracked = (data[column].mean() for column in ("crossed", "track_percentage"))

    def less(numbers, policy, kinds, teacher="teacher"):
        """Share by which each student is below its teacher. Shape: (students, kinds)."""
        both = numbers[policy].unstack("kind"), numbers[teacher].unstack("kind")
        return (100.0 * (1.0 - both[0] / both[1])).dropna()[kinds]

    def of_worst_kind(policies, teacher="teacher"):
        """How many percent fewer robots of each student cross the kind on which it is worst."""
        return pd.concat([less(crossed, policy, trained, teacher).max(axis=1) for policy in policies])

    own, students = "teacher, 70d6345", [f"student, 70d6345, seed {seed}" for seed in (1, 2)]
    lost = pd.concat([less(tracked, policy, trained, own).max(axis=1) for policy in students])
    assert len(lost) == 10 and f"track at most {lost.max():.1f}% less" in text
    kinds = pd.concat([less(crossed, policy, trained, own).idxmax(axis=1) for policy in students])
    assert set(kinds) == {"discrete_obstacles"}
    fewer = of_worst_kind(students, own).groupby(level=["robot", "seed"])
    said = ", ".join("{:.1f} and {:.1f}%".format(*each) for _, each in fewer)
    assert f"On the worst kind, obstacles, {said} fewer cross." in text and len(fewer) == 5
    sides = of_worst_kind([f"student, 70d6345, equivariant, seed {seed}" for seed in (1, 2)], own)
    assert len(sides) == 10 and f"students ({sides.min():.1f} to {sides.max():.1f}%), LSTMs" in text
    older = of_worst_kind(f"student, seed {seed}" for seed in (1, 2, 3))
    lstm = of_worst_kind(f"student, seed {seed}, lstm" for seed in (1, 2, 3, 4))
    assert len(lstm) == 8 and f"LSTMs ({lstm.min():.1f} to {lstm.max():.1f}%)" in text
    longer, known = "student, 38abe66, 10 steps of history", "teacher, 38abe66"
    seeing = of_worst_kind([longer], known)
    assert len(seeing) == 5 and f"ten steps of history ({seeing.min():.1f} to {seeing.max():.1f}%; 38abe66" in text
    went_on = [f"{longer}, 60 million, PPO {how}" for how in ("1e-4", "3e-5", "1e-4 and std 0.2")]
    assert (of_worst_kind(went_on, known) > of_worst_kind([f"{longer}, 60 million"], known).item()).all()
    equal = of_worst_kind(["student, 120 million"])
    through = of_worst_kind(["student, 48 steps"])
    assert (through > 0.9 * older.groupby(level=[0, 1, 2]).max().reindex(through.index)).all()
    changed = ("240 million", "512 remembered", "8 epochs", "annealed from the start", "std 0.3", "24 steps")
    changed = of_worst_kind(f"student, seed 2, {how}" for how in (*changed, "5 steps of history"))["a1", 2, 1000]
    assert len(changed) == 7 and (changed > 0.9 * older["a1", 2, 1000].max()).all()  # within their errors
    for how, seed in (("a tenth", 1), ("nothing", 1), ("harder rows, seed 2", 2), ("harder rows, seed 3", 3)):
        other, kept = (of_worst_kind([f"student, {each}"]) for each in (how, f"seed {seed}"))
        assert len(other) and (other > 0.9 * kept.reindex(other.index)).all(), how  # within their errors
    twice = of_worst_kind(["student, 240 million"])
    assert len(twice) == 2 and (twice > equal.reindex(twice.index)).all()
    stones = pd.concat([less(tracked, policy, ["stepping_stones"], own)["stepping_stones"] for policy in students])
    assert f"students track {stones.min():.0f} to {stones.max():.0f}% less" in text


def test_coverage():
    """Errors of identified numbers, and how many of their intervals held."""
    data = pd.read_csv(DOCS / "results" / "coverage.csv.xz")
    text = text_of("howto/identify.md", "Physics steps can bias").replace("\n", " ")
    seconds = data.groupby(["commit", "trial"])["seconds"].first()
    on_core, seconds = sorted(seconds.loc["2287a70"]), seconds.loc["db0ae3b"]
    alone, seconds = seconds[100], seconds.drop(100)
    data = data[(data["trial"] < 100) & (data["commit"] == "db0ae3b")]
    assert "and {:.0f} and {:.0f} s on a core".format(*on_core) in text
    assert data["trial"].nunique() == 100 and f"{100.0 * data['held'].mean():.1f}% of the intervals held" in text
    held = 100.0 * data.groupby("parameter")["held"].mean()
    for kind, share in held.items():
        assert f"{kind.replace('_', ' ').replace('coulomb', 'Coulomb')} {share:.0f}%" in text
    largest = data.assign(error=data["error"].abs(), share=(data["error"] / data["truth"]).abs()).groupby("parameter")
    share = 100.0 * largest["share"].max()[["armature", "viscous_friction", "coulomb_friction"]].max()
    error = 1e3 * largest["error"].max()
    said = re.search(r"by at most ([\d.]+)%, biases by ([\d.]+) mrad, delays by ([\d.]+) ms", text)
    for most, found in zip(map(float, said.groups()), (share, error["bias"], error["delay"]), strict=True):
        assert 0.85 * most < found <= most
    assert f"{alone:.0f} s alone on an H200, {seconds.min():.0f} to {seconds.max():.0f} s beside nine others" in text


def test_identified():
    """Lowest and highest seed by the drives of training."""
    data = pd.read_csv(DOCS / "results" / "identified.csv").groupby("drives")["track_percentage"]
    low, high, text = data.min(), data.max(), text_of("howto/identify.md", "**Does training")
    said = {name: f"{low[name]:.3f} to {high[name]:.3f}" for name in low.index}
    assert f"tracks {said['true']} if trained with the true numbers, {said['identified']} with the" in text
    assert f"identified ones, {said['ideal']} with the task's ideal motors" in text


def test_faults():
    """Longest times until faults ended in damping, how often each was tried, and torques beyond limits."""
    data, page = pd.read_csv(DOCS / "results" / "faults.csv.gz"), "howto/run_on_robot.md"
    longest = data.groupby(["policy_hz", "fault"])["ms"].agg(["max", "size"])
    _, rows = rows_of(page, "fault | policy at 50 Hz")
    assert sorted(", ".join(faults for faults, *_ in rows).split(", ")) == sorted(data["fault"].unique())
    assert "Longest of 72 times" in text_of(page, "## Brakes") and (longest["size"] == 72).all()
    assert data["ms"].notna().all()
    for faults, *times in rows:
        of = longest.loc[(slice(None), faults.split(", ")), "max"].groupby("policy_hz").max()
        assert [f"{of[rate]:.0f}" for rate in (50, 200)] == times
    text = text_of(page, "## Brakes").replace("\n", " ")
    beyond = set(data[data["excess"] > 0.0]["fault"])
    assert beyond == {"joint too fast", "joint beyond its range"} and "only while a joint was set to another" in text
    assert data["ms"].max() < 20.0
