"""Numbers of docs/performance.md, against the measurements beside it."""

import json

import pandas as pd
from support.documents import DOCS, rows_of, same, text_of

DATA = json.loads((DOCS / "performance" / "h200.json").read_text())["measurements"]


def measured(beginning):
    """The measurement whose description begins so."""
    return next(each for each in DATA if each["what"].startswith(beginning))


def test_training_speed():
    """Times of training and its parts."""
    keys = ["physics_ms", "step_ms", "rollout_ms", "update_ms", "iteration_ms"]
    rows = rows_of("performance.md", "task | worlds")[1]
    for row, (_, worlds, *times, million, memory) in zip(DATA[0]["rows"], rows, strict=True):
        assert int(worlds) == row["worlds"] and same(million, row["iteration_steps_per_s"] / 1e6)
        assert all(same(text, row[key]) for text, key in zip(times, keys, strict=True)), row
        assert same(memory, row["peak_memory_mib"] / 1024)
    said = f"{DATA[0]['rows'][0]['iteration_steps_per_s'] / 1e6:.1f} million steps/s without evaluations"
    assert all(said in page.read_text("utf-8") for page in (DOCS / "index.md", DOCS.parent / "README.md"))
    images = DATA[0]["images"]
    said = "took {:.1f} ms with 4096 worlds and {:.1f} ms with 16384, which made {:.2f} and {:.2f} million steps/s"
    said = said.format(*(r["update_ms"] for r in images), *(r["iteration_steps_per_s"] / 1e6 for r in images))
    assert said in text_of("performance.md", "With mirror images in place").replace("\n", " ")
    few, many = (row["70"] for row in measured("train.py --task=a1_torque_multihead --perturbation low")["rows"])
    said = "took {:.0f} million steps and {:.0f} s instead of {:.0f} million and {:.0f} s"
    said = said.format(many[0] / 1e6, many[1], few[0] / 1e6, few[1])
    assert said in text_of("performance.md", "More than 16384 worlds")


def test_start():
    """Seconds until the first iteration has ended, and of compiling kernels."""
    start = next(each for each in DATA if "warm" in each)
    text, stages = text_of("performance.md", "- **Start.**"), ["imports and settings", "task", "first iteration"]
    stages.append("trainer")
    until = [sum(times[stage] for stage in stages) for times in (*start["warm"], start["cold"])]
    assert "{1:.0f} and {0:.0f} s pass with warm caches and {2:.0f} s".format(*until) in text
    parts = [start["warm"][1][stage] for stage in stages[:3]]
    assert "before the task take {:.1f}, the task {:.1f}, the iteration {:.1f}:".format(*parts) in text


def test_whole_trainings():
    """Steps per second on two GPUs, and seconds until a training tracks 70%; FlashSAC's."""
    whole = next(each for each in DATA if "no_exchange" in each)
    (one,) = whole["one"]
    speeds = {name: pd.DataFrame(whole[name])["steps_per_s"].mean() for name in ("two", "no_exchange")}
    times = {name: speed / one["steps_per_s"] for name, speed in speeds.items()}
    text = text_of("performance.md", "- **Two")
    assert f"make {speeds['two'] / 1e6:.1f} million steps/s, {times['two']:.2f} times those of one" in text
    assert f"exchanging gradients, {times['no_exchange']:.2f}." in text
    reached = next(each for each in DATA if "seeds" in each)
    until = reached["seeds"]
    (first, last), late = ((min(of), max(of)) for of in ([s[key][0] for s in until if s[key]] for key in ("70", "85")))
    text = text_of("performance.md", "- **70%**")
    assert f"took {first:.1f} to {last:.1f} s" in text and "{:.1f} and {:.1f} s; one seed".format(*late) in text
    flash = measured("train.py --task=g1_position")["rows"][-1]
    seconds = sum(flash[stage] for stage in ("logs and checkpoints", "rollouts", "updates"))
    assert f"took {seconds:.0f} s after the first iteration" in text_of("howto/learner.md", "- Alone on an H200")


def test_mjlab():
    """The comparison of trainers."""
    _, rows = rows_of("performance.md", "trainer | settings")
    compared = [*DATA[1]["rows"], *DATA[-1]["rows"]]
    for row, (_, _, _, step, iteration, speed, start, tracking) in zip(compared, rows, strict=True):
        assert same(step, row["step_ms"]) and same(iteration, row["iteration_ms"]) and same(start, row["start_up_s"])
        assert abs(float(speed.replace(" ", "")) / row["training_steps_per_s"] - 1.0) < 0.005
        assert same(tracking.split()[0], row["tracking_after_iterations"][-1][2])
    mine, theirs = ([row["training_steps_per_s"] for row in DATA[i]["rows"]] for i in (-1, 1))
    times = f"{mine[0] / theirs[1]:.0f} times as many steps/s on MuJoCo Warp, and {mine[1] / theirs[1]:.0f} times with"
    text = text_of("performance.md", "## Compared with mjlab")
    assert times in text and f"own, {mine[2] / 133e3:.0f} to {mine[2] / theirs[0]:.0f} times" in text
    seconds = [row["seconds_to_70"] - row["start_up_s"] for row in DATA[-1]["rows"] if "seconds_to_70" in row]
    said = (
        "{:.0f} s after the first iteration on MuJoCo Warp (288b895), {:.1f} s with the fused engine (2677d36), {:.1f}"
    )
    assert said.format(*seconds) in text
    beside = DATA[-1]["rows"][1]["mjlab"]
    iterations, _, tracking = beside["tracking_after_iterations"][-1]
    said = f"ones {beside['training_steps_per_s'] / 1e3:.0f} 000, tracking {tracking:.2f} after {iterations} iterations"
    assert said in text


def test_counters():
    """Cycles between the instructions of physics steps, and what bounds them."""
    few, many, _ = measured("counters of the physics step of standing")["rows"]
    text = text_of("performance.md", "**What bounds a step**")
    assert f"every {few['cycles_per_issue']:.1f} cycles; arithmetic is at {few['arithmetic']:.0f}%" in text
    assert f"need {many['cycles_per_issue']:.1f} cycles each: {many['registers']} registers" in text


def test_self_collision():
    """Times of physics steps without and with contacts between parts."""
    rows = pd.DataFrame(measured("contacts between parts")["rows"])
    times = rows.set_index(["worlds", "robots", "self_collision"])["us"]
    _, said = rows_of("performance.md", "worlds | robots | without")
    assert len(said) == 6
    for worlds, robots, *cells in said:
        found = [times[int(worlds), robots, has_contacts] for has_contacts in (False, True)]
        assert [f"{us:.0f}" for us in found] == cells, (worlds, robots)
