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
    warp, step, torch, update = start["compiled"].values()
    assert f"Warp compile for {warp:.0f} s, the physics step's for {step:.0f} of these, torch's" in text
    assert f"torch's for {torch:.0f} and PPO's for {update:.0f} (ad5068b" in text
    assert f"if all compiled at once, {until[1] + step:.0f} s would be left" in text


def test_whole_trainings():
    """Seconds of a training without evaluations, on one and two GPUs, and until it tracks 70%; FlashSAC's."""
    whole = next(each for each in DATA if "no_exchange" in each)
    (one,) = whole["one"]
    after = sum(one[stage] for stage in ("evaluations", "logs and checkpoints", "rollouts", "updates", "end"))
    assert f"88 million steps of `a1_torque_multihead` took {after:.0f} s" in text_of(
        "performance.md", "- **Training.**"
    )
    speeds = {name: pd.DataFrame(whole[name])["steps_per_s"].mean() for name in ("two", "each_step", "no_exchange")}
    times = {name: speed / one["steps_per_s"] for name, speed in speeds.items()}
    text = text_of("performance.md", "- **Two")
    assert f"make {speeds['two'] / 1e6:.1f} million steps/s, {times['two']:.2f} times those of one" in text
    others = sorted(each["two_gpus_steps_per_s"] / each["one_gpu_steps_per_s"] for each in whole["earlier"])
    assert f"{times['each_step']:.2f}, on other machines {others[0]:.2f} to {others[-1]:.2f})" in text
    assert f"without exchanging gradients, {times['no_exchange']:.2f}." in text
    reached = next(each for each in DATA if "seeds" in each)
    until, small = reached["seeds"], pd.DataFrame(reached["small"]["rows"]).groupby("settings")
    (first, last), late = ((min(of), max(of)) for of in ([s[key][0] for s in until if s[key]] for key in ("70", "85")))
    text = text_of("performance.md", "- **70%**")
    assert f"took {first:.1f} to {last:.1f} s" in text and "{:.1f} and {:.1f} s; one seed".format(*late) in text
    laptop, slow = (small.get_group(name) for name in ("laptop", "small networks"))
    assert "took {:.1f} to {:.1f} s (four".format(*sorted(laptop["70"].str[0])[:: len(laptop) - 1]) in text
    assert laptop["80"].isna().all() and len(laptop) == 4
    of_slow = [sorted(slow[key].str[0]) for key in ("70", "80")]
    assert "curricula {:.1f} and {:.1f} s, 80% {:.1f} and {:.1f} s".format(*of_slow[0], *of_slow[1]) in text
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
    whole = [row["steps_per_s_of_the_display"] / 1e6 for row in DATA[-1]["rows"][1:]]
    assert "ours made {:.1f} and {:.1f} million steps/s".format(*whole) in text
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
    """Instructions of physics steps and cycles between them, on a plane and on rough ground, without and with parts."""
    rows = pd.DataFrame(measured("counters of the four physics steps")["rows"]).query("worlds == 4096")
    plane, rough = (of.median(numeric_only=True) for _, of in sorted(rows.groupby("task"), reverse=True))
    text = text_of("performance.md", "A physics step of 4096 standing A1s")
    assert f"takes {rough.us:.0f} us on the default map and {plane.us:.0f} us on a plane" in text
    of = [f"{round(each.instructions, -2):,.0f}" for each in (rough, plane)]
    assert f"executes {of[0]} instructions instead of {of[1]}" in text
    assert f"one every {rough.cycles_per_issue:.1f} and {plane.cycles_per_issue:.1f} cycles" in text
    few, many, _ = measured("counters of the physics step of standing")["rows"]
    text = text_of("performance.md", "**What bounds a step**")
    assert f"every {few['cycles_per_issue']:.1f} cycles; arithmetic is at {few['arithmetic']:.0f}%" in text
    assert f"need {many['cycles_per_issue']:.1f} cycles each: {many['registers']} registers" in text
    steps = pd.DataFrame(measured("counters of physics steps of 16384")["rows"]).set_index("self_collision")
    alone, parts = steps.loc[False], steps.loc[True]
    more, cycles = (parts / alone), (parts["cycles_per_issue"], alone["cycles_per_issue"])
    said = "execute {:.2f} times as many instructions, one every {:.1f} instead of {:.1f} cycles, and take {:.2f} times"
    assert said.format(more["instructions"], *cycles, more["us"]) in text.replace("\n", " ")


def test_self_collision():
    """Times of physics steps without contacts between parts, and with them before and after changes."""
    rows = pd.DataFrame(measured("contacts between parts")["rows"])
    columns = [(False, "2cdd058"), (True, "880b83a"), (True, "2cdd058")]
    times = rows.set_index(["worlds", "robots", "self_collision", "commit"])["us"]
    _, said = rows_of("performance.md", "worlds | robots | without")
    assert len(said) == 6
    for worlds, robots, *cells in said:
        found = [times.get((int(worlds), robots, *column)) for column in columns]
        assert ["" if us is None else f"{us:.0f}" for us in found] == cells, (worlds, robots)


def test_kernels_of_an_update():
    """Sums of the kernels' times, their bounds, and what cuBLAS takes."""
    data = measured("kernels of a minibatch")
    names = {"layers forward": "forward", "losses": "losses", "gradients of what layers read": "input_gradient"}
    names |= {"gradients of weights": "weight_gradient", "observations": "observe"}
    _, rows = rows_of("performance.md", "kernels | before | now | estimate")
    for name, *numbers in rows:
        for text, when in zip(numbers, ("before", "now"), strict=False):
            kernels = [each for each in data[when] if names.get(name, each["kernel"]) == each["kernel"]]
            if name not in names:
                kernels = [each for each in kernels if each["kernel"] not in names.values()]
            assert same(text, sum(each["us"] for each in kernels)), (name, when)
        bound = data["bound_us"].get(names.get(name))
        assert numbers[2] == (f"{bound:.0f}" if bound else ""), name
    unbounded = [each["us"] for each in data["now"] if each["kernel"] not in data["bound_us"]]
    least = 20 * (sum(data["bound_us"].values()) + sum(unbounded)) / 1e3
    data = measured("products of a minibatch")
    stages = {each["stage"]: each["us"] for each in data["stages"]}
    hidden = sum(stages[f"forward {i}"] for i in range(3))
    cublas = 2 * sum(each["us"] for each in data["cublas"][:3])
    text = text_of("performance.md", "An update is")
    assert f"an update takes {least:.1f} ms" in text
    assert f"layers take {hidden:.0f} us forward, in cuBLAS {cublas:.0f}," in text
