"""Numbers in the documents of the preset laptop, against the data."""

import json

import numpy as np
import pandas as pd
from scipy import stats
from support.documents import DOCS, rows_of, same, text_of

from legged_torque.envs import task_registry
from legged_torque.paper.report.tables import welch
from legged_torque.utils.options import Options

SETTINGS = ["worlds", "steps_per_rollout", "mini_batches", "epochs", "other"]


def laptop_settings():
    """What was tried for the preset laptop, and after how many million steps each run tracked 70%."""
    data = pd.read_csv(DOCS / "results" / "laptop_settings.csv.xz").fillna({"other": ""})
    return data, data[data["track_percentage"] >= 0.7].groupby([*SETTINGS, "task", "seed"])["steps"].min() / 1e6


def in_data(text):
    """Settings in the words of a table, in those of the data."""
    words = {"lambda ": "lam=", "gamma ": "gamma=", "desired KL ": "desired_kl="}
    for word, name in words.items():
        text = text.replace(word, name)
    return text.replace(", ", " ")


def of_seeds(came, runs):
    """How many seeds came there, in the words of a table."""
    return "" if came == runs == 4 else f" ({came} of {runs})"


def test_few_worlds():
    """Mean and latest of the steps after which evaluations track 70%, and how many seeds come there."""
    data, walking = laptop_settings()
    header, rows = rows_of("tried.md", "worlds x steps")
    assert len(rows) == 3 and data[SETTINGS].drop_duplicates().shape[0] == 65
    seeds = data.groupby([*SETTINGS, "task"])["seed"].nunique()
    for size, batches, epochs, *cells, _ in rows:
        shape, _, others = size.partition(", ")
        setting = (*map(int, shape.split(" x ")), int(batches), int(epochs), in_data(others))
        for task, cell in zip(header[3:-1], cells, strict=True):
            steps = walking.loc[(*setting, task.strip("`"))]
            runs = seeds.loc[(*setting, task.strip("`"))]
            mean, latest = cell.partition(" (")[0].split(", ")
            assert same(mean, steps.mean()) and same(latest, steps.max()), (size, task, steps)
            assert cell[len(f"{mean}, {latest}") :] == of_seeds(len(steps), runs)
    rollouts = walking.xs("rollouts 20M", level="other").reset_index()
    rollouts = rollouts[(rollouts["mini_batches"] == 4) & (rollouts["epochs"] == 5) & (rollouts["seed"] <= 12)]
    runs = rollouts.pivot(index=["task", "seed"], columns="worlds", values="steps")
    text = text_of("tried.md", "**More worlds, shorter rollouts**").replace("\n", " ")
    means = [runs.loc[task.strip("`"), 256].mean() for task in header[3:-1]]
    assert len(runs) == 36 and "after {:.1f}, {:.1f} and {:.1f} million".format(*means) in text
    assert f"at the latest {runs[256].max():.1f}. 512" in text and runs[256].notna().all()
    assert runs[[512, 768, 1024]].isna().sum().sum() == 2 and "(two failures as 7.5 million)" in text
    longer = np.log(runs.fillna(7.5)).sub(np.log(runs[256]), axis=0)
    chance = stats.ttest_1samp(longer[512], 0.0).pvalue
    times = [np.exp(longer[worlds].mean()) for worlds in (512, 768, 1024)]
    assert f"takes {times[0]:.2f} times as many (36 pairs, p = {chance:.3f}), 768" in text
    assert "8 {:.2f}, 1024 x 6 {:.2f} times".format(*times[1:]) in text


def at_the_end(run):
    """Mean tracking in the last 18% of a run."""
    return run[run["steps"] > 0.82 * run["steps"].max()]["track_percentage"].mean()


def test_equivariant_networks():
    """How many times the steps they take, and what tracking they end at, of laptop and default preset."""
    data, _ = laptop_settings()
    data = data[data["task"].isin(data["task"].unique()[:3])]
    data["other"], whole = data["other"].str.removesuffix(" 20M"), data["other"].str.endswith(" 20M")

    def steps_to(share, other, epochs=5):
        runs = data[(data["other"] == other) & (data["epochs"] == epochs)]
        walks = runs[(runs["track_percentage"] >= share) & (runs["steps"] < 7.6e6)]
        steps = walks.groupby(["task", "seed"])["steps"].min() / 1e6
        return np.log(steps.reindex([*runs.groupby(["task", "seed"]).groups]).fillna(7.5))

    before = {share: steps_to(share, "networks 128") for share in (0.7, 0.8)}
    pairs = [
        (steps_to(share, "equivariant 128", epochs) - before[share]).dropna() for epochs in (5, 7) for share in before
    ]
    assert [len(pair) for pair in pairs] == [24, 24, 12, 12]
    text = text_of("tried.md", "**Equivariant networks in place").replace("\n", " ")
    said = "needs {:.2f} times the steps to 70%, {:.2f} times those to 80% (24 pairs), with 7 epochs {:.2f} and {:.2f}"
    assert said.format(*(np.exp(pair.mean()) for pair in pairs)) in text
    ends = data[whole].groupby(["other", "task", "seed"]).apply(at_the_end)
    ends = [ends[f"{kind} 128"] for kind in ("equivariant", "networks")]
    assert [len(of) for of in ends] == [12, 12]
    assert "ends at {:.3f} instead of {:.3f} (12 trainings each)".format(*(of.mean() for of in ends)) in text
    curves = pd.read_csv(DOCS / "tried.csv.xz").query("run.str.startswith('equivariant/')")
    robots = pd.read_csv(DOCS / "results" / "robots.csv.xz").query("trained == 'ideal motors, no latency'")
    evaluations = pd.read_csv(DOCS / "results" / "evaluations.csv.xz").query("environment == 'low'")
    both = [runs.groupby(["task", "seed"]) for runs in (curves, pd.concat([evaluations, robots]))]
    changes = (both[0].apply(at_the_end) - both[1].apply(at_the_end)).dropna()
    multi_head = changes.index.get_level_values("task").str.endswith("torque_multihead")
    chances = [stats.ttest_1samp(changes[of], 0.0).pvalue for of in (multi_head, ~multi_head)]
    said = f"tracks {-changes[multi_head].mean():.3f} less (A1, Go2; {multi_head.sum()} pairs, p = {chances[0]:.3f})"
    assert (
        f"{said}, others {changes[~multi_head].mean():.3f} more ({(~multi_head).sum()}, p = {chances[1]:.2f})" in text
    )
    first, second = (runs.apply(lambda run: run[run["track_percentage"] >= 0.7]["steps"].min()) for runs in both)
    assert f"70% takes {np.exp(np.log(first / second).dropna().mean()):.2f} times the steps" in text


def test_energy_of_equivariant_networks():
    """Costs of transport with equivariant networks, with mirror images and with wider networks, and their speed."""
    text = text_of("tried.md", "**Equivariant networks in place").replace("\n", " ")
    rough = pd.read_csv(DOCS / "results" / "rough" / "evaluations.csv.gz").query("steps > 246e6")
    rough = rough[rough["task"] == "a1_rough_torque_multihead"].groupby(["environment", "seed"])
    rough = rough[["track_percentage", "cost_of_transport"]].mean().query("track_percentage > 0.6")["cost_of_transport"]
    ours, images = rough["low, equivariant networks"], rough["low, mirror images"]
    said = f"of {ours.min():.2f} to {ours.max():.2f}, with mirror images {images.min():.2f} to {images.max():.2f} (four"
    assert f"{said} seeds each that learned, p = {welch(ours, images):.3f};" in text and {len(ours), len(images)} == {4}
    late = pd.read_csv(DOCS / "tried.csv.xz").query("run.str.startswith('late10/') and steps > 90e6")
    ends = late.groupby(["run", "task", "seed"])[["track_percentage", "cost_of_transport"]].mean()
    runs = ["late10/equivariant", "late10/images", "late10/wide"]
    _, rows = rows_of("tried.md", "tracking, cost of transport")
    assert len(rows) == 5
    for task, *cells in rows:
        for run, cell in zip(runs, cells, strict=True):
            of = ends.query(f"run == '{run}' and task == {task.replace('`', chr(39))}")
            assert cell == (", ".join(f"{mean:.3f}" for mean in of.mean()) if len(of) else "") and len(of) in (0, 5)
    ours, images, wide = (ends.loc[run] for run in runs)
    more, less = (np.log(each / images).dropna()["cost_of_transport"] for each in (ours, wide))
    tracked = (images - ours)["track_percentage"]
    chances = [stats.ttest_1samp(values, 0.0).pvalue for values in (more, tracked, less)]
    assert (len(more), len(less)) == (25, 15) and chances[0] < 1e-3
    said = f"cost {np.exp(more.mean()):.2f} times as much as mirror images (25 pairs by task and seed, p < 0.001), and"
    said += f" track {tracked.mean():.3f} less (p = {chances[1]:.2f}). Wide ones cost {np.exp(less.mean()):.2f} times"
    assert f"{said} as much (15, p = {chances[2]:.2f})," in text
    measurements = json.loads((DOCS / "performance" / "h200.json").read_text())["measurements"]
    speeds = next(each for each in measurements if "1.5 times as wide" in each["what"])
    speeds = [np.mean(speeds[name]) / 1e6 for name in ("equivariant", "images", "wide")]
    said = "makes {:.1f} million steps/s, with mirror images {:.1f}, with wide networks {:.1f} (two"
    assert said.format(*speeds) in text
    assert ends.loc["late10/rates", "track_percentage"].max() < 0.1


def after(seconds):
    """Minutes and seconds, as the documents write them."""
    return [f"{s // 60:.0f}:{s % 60:02.0f}" for s in seconds]


def test_smaller_networks():
    """How many times the steps networks of [64, 64] need, and what is lost at the end."""
    data = pd.read_csv(DOCS / "results" / "laptop_settings.csv.xz").query("other.str.startswith('networks', na=False)")
    data["other"], tasks = data["other"].str.removesuffix(" 20M"), [*data["task"].unique()[:3]]
    runs = data[data["task"].isin(tasks)].groupby(["other", "task", "seed"])
    text, logarithms = text_of("tried.md", "**Networks of [64, 64]**").replace("\n", " "), {}
    for share in (0.7, 0.8):
        walks = data[(data["track_percentage"] >= share) & (data["steps"] < 7.6e6)]
        steps = walks.groupby(["other", "task", "seed"])["steps"].min().reindex([*runs.groups]) / 1e6
        logarithms[share] = np.log(steps.fillna(7.5)).groupby("other").agg(["mean", "size"])
    more = {share: np.exp(of["mean"]["networks 64"] - of["mean"]["networks 128"]) for share, of in logarithms.items()}
    sizes = {share: {*of["size"][["networks 64", "networks 128"]]} for share, of in logarithms.items()}
    assert f"{more[0.7]:.2f} times the steps to 70%, {more[0.8]:.2f} times those to 80% (24 runs)" in text
    ends = runs.filter(lambda run: run["steps"].max() > 2e7).groupby(["other", "task", "seed"]).apply(at_the_end)
    lost = ends["networks 128"] - ends["networks 64"]
    assert sizes == {0.7: {24}, 0.8: {24}} and f"end {lost.mean():.2f} lower ({len(lost)} pairs)" in text


def test_laptop():
    """Minutes of training on two cores until evaluations track 70 and 80%, and tracking at the end."""
    data = pd.read_csv(DOCS / "results" / "laptop.csv.gz")
    flash = data[data["task"].str.endswith("flashsac")].iloc[-1]
    said = (
        f"tracked {flash['track_percentage']:.2f} after {flash['steps']:,.0f} steps and {flash['seconds'] / 60:.0f} min"
    )
    assert said in text_of("howto/learner.md", "- On two cores of a")
    data = data[~data["task"].str.endswith("flashsac")]
    latest = data["commit"] == "38abe66"
    walked = data[~latest & (data["track_percentage"] >= 0.7)].groupby(["commit", "task", "seed"])["seconds"].min()
    said = "{} to {} until 70%".format(*after([walked.min(), walked.max()]))
    assert said in text_of("getting_started.md", "Earlier code took")
    _, rows = rows_of("getting_started.md", "task")
    for task, *cells in rows:
        of_task = data[latest & (data["task"] == task.strip("`"))]
        for share, cell in zip((0.7, 0.8), cells, strict=True):
            seconds = of_task[of_task["track_percentage"] >= share].groupby("seed")["seconds"].min()
            assert list(seconds.index) == [1, 2, 3, 4] and cell == ", ".join(after(seconds)), (task, share)
    last = data[latest].groupby(["task", "seed"])[["steps", "seconds"]].max()
    speeds = (last["steps"] / last["seconds"]).round(-2)
    said = text_of("getting_started.md", "Minutes of training on a virtual").replace("\n", " ")
    assert f"): {speeds.min():,.0f} to {speeds.max():,.0f} steps/s." in said and len(rows) == 3
    runs = data.groupby(["task", "seed", "commit"])[["steps", "seconds"]].max()
    speeds = runs["steps"] / runs["seconds"]
    _, rows = rows_of("getting_started.md", "| GPU (H200)")
    said = {name: cell for name, *_, cell in rows}
    assert said["steps per second"] == " to ".join(f"{round(speed, -2):,.0f}" for speed in (speeds.min(), speeds.max()))
    minutes = [20e6 / speed / 60 for speed in (speeds.max(), speeds.min())]
    assert said["the default training takes"] == "{:.0f} to {:.0f} minutes at these speeds".format(*minutes)
    text = text_of("getting_started.md", "In one process on a GPU").replace("\n", " ")
    runs, _ = laptop_settings()
    kept = runs["other"] == "lam=0.9 gamma=0.97 desired_kl=0.03 fade 4-10M 20M"
    ends = runs[kept].groupby(["task", "seed"]).apply(at_the_end)[:, 1]
    rough = ends.pop("a1_rough_torque_multihead")
    assert f"tasks (seed 1) ended at {ends.min():.2f} (`{ends.idxmin()}`) to {ends.max():.2f}, one" in text
    assert f"on rough ground at {rough:.2f} " in text and len(ends) == 11


def test_fading():
    """The PD part fades when the page says so."""
    fading = task_registry.get_cfgs("a1_torque_multihead", Options(device="cpu", preset="laptop"))[0].control.mixing.pd
    said = f"fades between {fading.t_start / 1e6:.0f} and {fading.t_end / 1e6:.0f} million steps"
    assert said in text_of("getting_started.md", "The preset `laptop` has")
