"""Numbers in the documents of the preset laptop, against the data."""

from itertools import product

import numpy as np
import pandas as pd
from support.documents import DOCS, rows_of, same, text_of

KEPT = "lam=0.9 gamma=0.97 desired_kl=0.03"
SETTINGS = ["worlds", "steps_per_rollout", "mini_batches", "epochs", "other"]


def laptop_settings():
    """What was tried for the preset laptop, and after how many million steps each run tracked 70%."""
    data = pd.read_csv(DOCS / "results" / "laptop_settings.csv.gz").fillna({"other": ""})
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
    assert len(rows) == 6 and data[SETTINGS].drop_duplicates().shape[0] == 46
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
    fresh = [(task.strip("`"), seed) for task in header[3:-1] for seed in range(5, 13)]
    tried = {other: steps.droplevel("other") for other, steps in walking.loc[256, 24, 4, 5].groupby("other")}
    chances = product(("0.96", "0.95"), ("0.03", "0.04"))
    names = ["lam=0.9", KEPT, *(f"lam=0.9 gamma={gamma} desired_kl={kl}" for gamma, kl in chances)]
    before, *others = (np.log(tried[name].reindex(fresh).fillna(7.5)) for name in names)
    kept, *rest = (np.exp((steps - before).mean()) for steps in others)
    text = text_of("tried.md", "On seeds 5 to 12")
    assert f"takes {kept:.2f} times" in text and f"0.04 {min(rest):.2f} to {max(rest):.2f} times" in text


def test_whole_trainings_of_few_worlds():
    """Tracking at the end, and that all had learned to walk before."""
    data, _ = laptop_settings()
    whole = data[data["other"].str.endswith("20M")].groupby(["other", "task", "seed"])
    ends = whole.apply(lambda run: run[run["steps"] > 0.82 * run["steps"].max()]["track_percentage"].mean())
    assert (whole["track_percentage"].max() >= 0.8).all() and len(ends) == 36
    kinds = [ends[ends.index.get_level_values("task").str.endswith("multihead")].groupby("other"), ends.groupby("task")]
    (low, high), (lowest, highest) = ((kind.min(), kind.max()) for kind in kinds)
    said = {name: f"{low[f'{name} 20M']:.2f} to {high[f'{name} 20M']:.2f}" for name in ("lam=0.9", KEPT)}
    said |= {
        g: "{:.2f} to {:.2f}".format(*(of[f"{KEPT} 20M".replace("0.97", g)] for of in (low, high)))
        for g in ("0.96", "0.95")
    }
    text = text_of("tried.md", "**At the end of 20 million")
    assert f"tracked {said['lam=0.9']} (torque" in text and f"the kept row {said[KEPT]}, with gamma" in text
    assert f"gamma 0.96 {said['0.96']}, with 0.95 {said['0.95']};" in text
    assert f"ends at {lowest['a1_position']:.2f} to {highest['a1_position']:.2f};" in text


def test_few_worlds_of_a_go2():
    """The same numbers with other gains, scales and noise."""
    _, walking = laptop_settings()
    go2 = walking.xs("go2_torque_multihead", level="task").groupby("other")
    text = text_of("tried.md", "For the Go2 alone")
    for other, words in (
        ("again", "again: "),
        ("stiffness=30", "stiffness of 30 gave "),
        ("stiffness=25", "of 25 "),
        ("torque_scale=8", "`torque_scale` 8 "),
        ("action_scale=0.35", "`action_scale` 0.35 "),
        ("init_std=0.7", "`init_std` 0.7 "),
        ("desired_kl=0.03 stiffness=30", "desired KL 0.03 "),
    ):
        steps = go2.get_group(f"lam=0.9 gamma=0.97 {other}")
        assert f"{words}{steps.mean():.1f}, {steps.max():.1f}" in text and len(steps) == 4, other


def test_laptop():
    """Minutes of training on two cores until an evaluation tracks 70%."""
    data = pd.read_csv(DOCS / "results" / "laptop.csv.gz")
    seconds = data[data["track_percentage"] >= 0.7].groupby(["task", "seed"])["seconds"].min()
    text = text_of("getting_started.md", "On two cores of a virtual machine")
    texts = {task: [f"{s // 60:.0f}:{s % 60:02.0f}" for s in times] for task, times in seconds.groupby("task")}
    first, second, third, fourth = texts["a1_torque_multihead"]
    assert f"after {first}, {second}, {third} and {fourth} minutes of training (seeds 1 to 4)" in text
    assert "`a1_position` after {}, {}, {} and {}, at most".format(*texts["a1_position"]) in text
    assert "seeds 1 to 3, after {}, {} and {} (ad0b145;".format(*texts["go2_torque_multihead"]) in text
