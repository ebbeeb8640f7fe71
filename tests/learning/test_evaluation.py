"""Evaluation while training and of checkpoints: what is measured, when, and that training does not notice."""

import json
import math
import re
from itertools import groupby
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from support.rollouts import make_ppo, record_rollout
from support.scripts import assert_told_in_one_line, contents, run_here
from support.settings import error_of, flatten, get, get_cfgs
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.nn.functional import elu, linear

from legged_torque.envs import task_registry
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.base.metrics import WalkingMetrics
from legged_torque.learning import evaluator
from legged_torque.learning.evaluator import TrainingEvaluator
from legged_torque.utils.config import set_by_path
from legged_torque.utils.metrics import UNITS

COLUMNS = "steps,iteration,seconds,track_percentage,track_xy,track_angular,collision_force,cost_of_transport,height,"
COLUMNS += "speed,falls_per_minute,critic_gradient_norm"
TASK = ["--task=a1_position", "--device=cpu"]
SMALL = [*TASK, "--num_envs=2", "--set=runner.num_steps_per_env=4", "--set=runner.save_interval=1", "--logger=none"]
SMALL += ["--set=actor.hidden_dims=[8]", "--set=critic.hidden_dims=[8]", "--set=algorithm.num_mini_batches=1"]
SMALL += ["--set=evaluation.interval=8", "--set=evaluation.num_samples=6"]


@pytest.fixture
def noted(monkeypatch):
    """Every control step of every task: which task, what held before, what it was told, and what came of it.

    Worlds of evaluations do not settle before the first one.
    """
    monkeypatch.setattr(evaluator, "WARM_UP_TIME", 0.0)
    steps, step = [], LeggedRobot.step

    def noted_step(task, actions):
        note = SimpleNamespace(task=task, actions=actions.clone(), total_steps=int(task.total_steps))
        note.commands, note.obs = task.commands.clone(), task.get_observations()
        note.mixing = float(task.mixing[0]) if hasattr(task, "mixing") else None
        result = step(task, actions)
        note.reset, note.height = task.reset_buf.clone(), task.base_pos[:, 2].clone()
        note.velocity = task.base_lin_vel[:, :2].clone()
        steps.append(note)
        return result

    monkeypatch.setattr(LeggedRobot, "step", noted_step)
    return steps


@pytest.fixture
def make_runner(make_task, tmp_path):
    """Factory of small runners; settings of the training go by dotted path, ``perturbation`` is that of the task."""

    def make(name="a1_position", seed=0, perturbation="none", env=None, **overrides):
        _, train_cfg = task_registry.get_cfgs(name)
        settings = {"runner.num_steps_per_env": 4, "algorithm.num_mini_batches": 2, "runner.logger": "none"}
        settings |= {"actor.hidden_dims": [8, 8], "critic.hidden_dims": [8], "evaluation.num_samples": 6}
        for path, value in {**settings, **overrides}.items():
            set_by_path(train_cfg, path, value)
        task = make_task(name, 4, seed, **perturb(perturbation), **(env or {}))
        torch.manual_seed(seed)
        return task_registry.make_alg_runner(task, train_cfg=train_cfg, log_root=tmp_path)[0]

    return make


def perturb(name):
    """The changes of a perturbation by dotted path."""
    return flatten(get_cfgs()[0].perturbations()[name])


def rows_of(runner, name="evaluations.csv"):
    """The rows that a runner has written, None without a file."""
    file = Path(runner.log_dir) / name
    if not file.exists():
        return None
    header, *lines = file.read_text().splitlines()
    assert header == COLUMNS
    return [dict(zip(COLUMNS.split(","), map(float, line.split(",")), strict=True)) for line in lines]


def by_evaluation(steps, training):
    """Notes of steps in worlds other than the training's, a list per evaluation."""
    return [list(notes) for task, notes in groupby(steps, lambda note: note.task) if task is not training]


WHEN = {24: [32, 48, 80], 16: [16, 32, 48, 64, 80], 5: [16, 32, 48, 64, 80], 50: [64], 81: None, 0: None}


@pytest.mark.parametrize(("interval", "steps"), WHEN.items())
def test_when_rows_appear(make_runner, interval, steps):
    """A rollout has 16 steps; a row comes at the first end of one at or after each multiple of the interval."""
    runner = make_runner(**{"evaluation.interval": interval})
    runner.learn(5)
    numbers = [(row["steps"], row["iteration"]) for row in rows_of(runner) or []] or None
    assert numbers == (steps and [(number, number // 16) for number in steps])


@pytest.mark.parametrize(("samples", "most", "worlds", "count"), [(13, 3, 3, 5), (12, 3, 3, 4), (9, 100, 4, 3)])
def test_what_a_row_says(make_runner, noted, samples, most, worlds, count):
    """Mean actions of the policy of the moment, for the given worlds and steps; tensorboard has the same numbers."""
    settings = {"evaluation.num_samples": samples, "evaluation.num_envs": most, "evaluation.interval": 16}
    episodes = {"env.episode_length_s": 0.05, "commands.resampling_probability": 0.5}  # three steps
    runner = make_runner(env=episodes, **settings, **{"runner.logger": "tensorboard"})
    runner.learn(3, init_at_random_ep_len=True)
    evaluations, rows = by_evaluation(noted, runner.env), rows_of(runner)
    assert len(evaluations) == len(rows) == 3 and [len(notes) for notes in evaluations] == [count] * 3
    (task,) = {note.task for notes in evaluations for note in notes}
    assert task.num_envs == worlds and task.reward_names == []
    assert all(torch.equal(note.actions, runner.alg.actor(note.obs)) for note in evaluations[-1])
    for notes, row in zip(evaluations, rows, strict=True):
        kept = ~torch.stack([note.reset for note in notes])
        heights = torch.stack([note.height for note in notes])[kept]
        errors = torch.stack([(note.commands[:, :2] - note.velocity).square().sum(dim=1) for note in notes])[kept]
        assert row["height"] == pytest.approx(float(heights.mean()), rel=1e-5)
        assert row["track_xy"] == pytest.approx(float(errors.mean()), rel=1e-5)
        assert not kept.all()
    runner.logger.writer.flush()
    events = EventAccumulator(runner.log_dir).Reload()
    for tag in [*(f"Evaluation/{name}" for name in UNITS), "Loss/critic_gradient_norm"]:
        scalars, name = events.Scalars(tag), tag.split("/")[1]
        assert [event.step for event in scalars] == [0, 1, 2]
        assert [event.value for event in scalars] == pytest.approx([row[name] for row in rows], rel=1e-5, nan_ok=True)
    assert rows[1]["seconds"] < rows[2]["seconds"]


def test_training_does_not_notice(make_runner):
    """With and without evaluations, networks, observations and the random numbers to come are the same bit by bit."""
    results, rows = [], []
    for interval, also in ((0, []), (16, []), (16, ["high"])):
        settings = {"evaluation.interval": interval, "evaluation.also": also, "evaluation.also_from": 32}
        settings["runner.run_name"] = f"run_{len(rows)}"  # folders that are not the same in the same second
        runner = make_runner("a1_torque_multihead", 3, perturbation="low", **settings)
        torch.manual_seed(5)
        runner.learn(3)
        rows.append(rows_of(runner) and [{**row, "seconds": 0.0} for row in rows_of(runner)])
        result = {**runner.alg.actor.state_dict(prefix="actor."), **runner.alg.critic.state_dict(prefix="critic.")}
        result |= dict(runner.env.get_observations().items()) | {"std": runner.alg.actor.output_std}
        result |= {"lr": runner.alg.learning_rate, "next": torch.rand(5), "commands": runner.env.commands}
        results.append({name: value.detach().clone() for name, value in result.items()})
    assert all(torch.equal(result[name], value) for result in results[1:] for name, value in results[0].items())
    assert rows[0] is None and len(rows[1]) == 3 and rows[1] == rows[2]  # further evaluations change no other


def test_worlds_settle_before_the_first_evaluation(make_runner, noted, monkeypatch):
    """For as long as it is said, in runs of whole evaluations; what happens then does not count."""
    monkeypatch.setattr(evaluator, "WARM_UP_TIME", 0.1)  # 5 steps, of an evaluation's 3
    runner = make_runner(**{"evaluation.num_samples": 9, "evaluation.num_envs": 3, "evaluation.interval": 16})
    runner.learn(2)
    evaluations, rows = by_evaluation(noted, runner.env), rows_of(runner)
    assert [len(notes) for notes in evaluations] == [9, 3]
    for notes, row in zip(evaluations, rows, strict=True):
        kept = ~torch.stack([note.reset for note in notes[-3:]])
        assert row["height"] == pytest.approx(float(torch.stack([n.height for n in notes[-3:]])[kept].mean()), rel=1e-5)


def test_curricula_are_those_of_the_training(make_runner, noted):
    """Evaluations act with the weights of eq. 1 at the training's steps: 16, 32, 48, and weights of 0, 24, 48."""
    env = {"control.mixing.update_interval": 24, "control.mixing.pd.t_end": 100}
    runner = make_runner("a1_torque_multihead", env=env, **{"evaluation.interval": 16, "evaluation.num_samples": 8})
    runner.learn(3)
    evaluations = by_evaluation(noted, runner.env)
    assert [notes[0].total_steps for notes in evaluations] == [16, 32, 48]
    mixing = [note.mixing for notes in evaluations for note in notes]
    assert mixing == pytest.approx([1.0, 1.0, 0.76, 0.76, 0.52, 0.52], rel=1e-6)
    assert int(runner.env.total_steps) == 48


def test_random_numbers_of_its_own(make_runner, noted):
    """Its worlds depend on its seed alone, do not begin in step, and the next evaluation draws other numbers."""
    task = make_runner(env={"commands.resampling_probability": 1.0}).env
    settings = {"num_envs": 4, "num_samples": 8, "perturbation": ""}
    for outside, seed in ((1, 7), (2, 7), (2, 8)):
        torch.manual_seed(outside)
        evaluating = TrainingEvaluator(task, lambda obs: torch.zeros(len(obs), 12), settings, seed)
        numbers = [evaluating.evaluate() for _ in range(2)]
        assert numbers[0] != numbers[1]
        drawn = torch.rand(3)
        torch.manual_seed(outside)
        assert torch.equal(drawn, torch.rand(3))
    notes = [noted[start : start + 4] for start in (0, 4, 8)]
    seen = [torch.stack([torch.cat([note.commands, note.obs["policy"]], dim=1) for note in each]) for each in notes]
    assert torch.equal(seen[0], seen[1]) and not torch.equal(seen[0], seen[2])
    assert len(seen[0][:, :, :3].flatten().unique()) == 4 * 4 * 3  # commands are drawn anew in every step
    assert len(set(notes[0][0].task.episode_length_buf.tolist())) > 1


@pytest.mark.parametrize(("chosen", "expected"), [("", "low"), ("high", "high"), ("none", "none")])
def test_environment_of_the_evaluation(make_runner, noted, chosen, expected):
    """``evaluation.perturbation`` holds in its worlds alone; without, they are perturbed as those of the training."""
    runner = make_runner(perturbation="low", **{"evaluation.perturbation": chosen, "evaluation.interval": 16})
    runner.learn(1)
    assert noted[-1].task is not runner.env
    for task, name in ((noted[-1].task, expected), (runner.env, "low")):
        assert all(get(task.cfg, path) == value for path, value in perturb(name).items())


def test_further_environments(make_runner, noted):
    """They are measured from their step on, in worlds of their own that settle on their own, and logged apart."""
    also = {"evaluation.also": ["high", "none"], "evaluation.also_from": 30, "evaluation.interval": 16}
    runner = make_runner(perturbation="low", **also, **{"runner.logger": "tensorboard"})
    runner.learn(3)
    tasks = [notes[0].task for notes in by_evaluation(noted, runner.env)]
    assert [tasks.index(task) for task in tasks] == [0, 0, 2, 3, 0, 2, 3]
    for task, name in zip(tasks[1:4], ("low", "high", "none"), strict=True):
        assert all(get(task.cfg, path) == value for path, value in perturb(name).items())
    rows = {name: rows_of(runner, f"evaluations{name}.csv") for name in ("", "_high", "_none")}
    assert [[row["steps"] for row in each] for each in rows.values()] == [[16, 32, 48], [32, 48], [32, 48]]
    assert len({row["height"] for each in rows.values() for row in each}) == 7
    runner.logger.writer.flush()
    events = EventAccumulator(runner.log_dir).Reload().Scalars("Evaluation_high/height")
    assert [event.value for event in events] == pytest.approx([row["height"] for row in rows["_high"]], rel=1e-5)


def test_unknown_environment(make_runner, tmp_path):
    """It is told at once, with the nearest name, and nothing is written."""
    assert "unknown evaluation.also 'hihg'; did you mean 'high'?" in error_of(
        make_runner, **{"evaluation.also": ["low", "hihg"]}
    )
    line = error_of(make_runner, **{"evaluation.perturbation": "hihg"})
    assert line.startswith("unknown evaluation.perturbation 'hihg'; did you mean 'high'?")
    result = run_here("train.py", *SMALL, "--set=evaluation.perturbation=hihg", "--max_iterations=1", root=tmp_path)
    assert_told_in_one_line(result, line)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("clip", [True, False])
def test_critic_gradient_norm(clip):
    """The reported norm is over the critic alone, for its weighted loss, and before gradients are clipped."""
    settings = {"use_clipped_value_loss": clip, "clip_param": 0.1, "max_grad_norm": 1e-3}
    alg = make_ppo(num_mini_batches=1, value_loss_coef=0.5, **settings)
    record_rollout(alg)
    with torch.no_grad():
        alg.critic.mlp[-1].bias += 0.3  # so that clipping matters
    storage = alg.storage
    values = alg.critic(storage.observations.flatten(0, 1)).flatten()
    old, returns = storage.values.flatten(), storage.returns.flatten()
    error = (values - returns) ** 2
    if clip:
        error = torch.maximum(error, (old + torch.clip(values - old, -0.1, 0.1) - returns) ** 2)
    grads = torch.autograd.grad(0.5 * error.mean(), list(alg.critic.parameters()))
    expected = math.sqrt(sum(float(grad.double().square().sum()) for grad in grads))
    assert alg.update()["critic_gradient_norm"] == pytest.approx(expected, rel=1e-4) and expected > 0.1


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A folder whose logs hold a small run of ``a1_position`` without perturbations."""
    root = tmp_path_factory.mktemp("root")
    assert run_here("train.py", *SMALL, "--max_iterations=3", "--run_name=first", root=root)[0] == 0
    return root


def evaluate(root, file, *words):
    """What evaluate.py prints, and its file, which must be JSON to the letter."""
    status, output, error = run_here("evaluate.py", *TASK, f"--json={file}", *words, root=root)
    assert (status, error) == (0, "")
    return output, json.loads(file.read_text(), parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


def test_a_resumed_run_writes_its_own_rows(root, tmp_path):
    """They begin after the checkpoint's steps, and the file of the first run stays as it was; no logger is needed."""
    first = next(root.glob("logs/*/*_first"))
    text = (first / "evaluations.csv").read_text()
    words = [f"--load_run={first}", "--checkpoint=2", "--resume", "--max_iterations=4", "--run_name=second"]
    assert run_here("train.py", *TASK, *words, root=tmp_path)[0] == 0
    rows = [rows_of(SimpleNamespace(log_dir=run)) for run in (first, *tmp_path.glob("logs/*/*_second"))]
    assert (first / "evaluations.csv").read_text() == text
    assert [[row["steps"] for row in each] for each in rows] == [[8, 16, 24], [24, 32]]
    assert [row["iteration"] for row in rows[1]] == [3, 4]
    seconds = torch.load(first / "model_2.pt", weights_only=True)["infos"]["seconds"]
    assert rows[1][0]["seconds"] >= float(f"{seconds:.6g}") > 0.0


def test_a_seed_fixes_every_number(root, tmp_path):
    """Two evaluations with one seed give the same file; another seed, perturbation or checkpoint, other numbers."""
    often = "--set=domain_rand.push_probability=0.5"  # or low and high would rarely differ in so few steps
    words = ["--num_envs=3", "--steps=20", "--seed=3", often]
    _, result = evaluate(root, tmp_path / "a.json", *words)
    torch.rand(11)
    evaluate(root, tmp_path / "b.json", *words)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    assert [result[key] for key in ("steps", "checkpoint", "num_envs", "num_steps")] == [24, "model_3.pt", 3, 20]
    changes = ["--seed=4", "--perturbation=low", "--perturbation=high", "--checkpoint=1", "--perturbation=none"]
    others = [evaluate(root, tmp_path / f"{i}.json", *words, change)[1] for i, change in enumerate(changes)]
    numbers = [json.dumps([each["metrics"], each["by_command"]]) for each in (result, *others)]
    assert len(set(numbers)) == 5 and numbers[0] == numbers[-1]  # the run had no perturbations either
    assert [each["seed"] for each in others] == [4, 3, 3, 3, 3] and others[3]["steps"] == 8
    assert [each["perturbation"] for each in others] == ["as in training", "low", "high", "as in training", "none"]


def test_fixed_command_with_one_world(root, tmp_path, noted, monkeypatch):
    """The command holds in all steps, new episodes included; standard errors are null; the folder is created."""
    told, add_step = [], WalkingMetrics.add_step
    monkeypatch.setattr(WalkingMetrics, "add_step", lambda *args: (told.append(args[1]), add_step(*args)))
    words = ["--num_envs=1", "--steps=9", "--set=env.episode_length_s=0.05", "--set=commands.resampling_probability=1"]
    output, result = evaluate(root, tmp_path / "new" / "folder" / "x.json", *words, "--command", "0.5", "0", "-0.2")
    assert len(told) == len(noted) == 9 and any(note.reset.any() for note in noted)
    for commands in told + [note.commands for note in noted]:
        torch.testing.assert_close(commands, torch.tensor([[0.5, 0.0, -0.2]]))
    assert result["command"] == [0.5, 0.0, -0.2]
    state = torch.load(next(root.glob("logs/*/*_first/model_3.pt")), weights_only=True)["actor_state_dict"]
    weights = [state[f"mlp.{name}"] for name in ("0.weight", "0.bias", "2.weight", "2.bias")]
    for note in noted:  # mean actions of a network with one hidden layer
        mean = linear(elu(linear(note.obs["policy"], *weights[:2])), *weights[2:])
        torch.testing.assert_close(note.actions, mean)
    for name, value in {"lin_vel_x": 0.5, "lin_vel_y": 0.0, "ang_vel_yaw": -0.2}.items():
        (part,) = result["by_command"][name]
        assert (part["from"], part["to"], part["share"]) == pytest.approx((value, value, 1.0), abs=1e-6)
        assert re.search(rf"(?m)^  error of {name} +{part['error']:.3f}$", output)
    heights, metrics = [float(note.height) for note in noted if not note.reset.any()], result["metrics"]
    assert metrics["height"]["mean"] == pytest.approx(sum(heights) / len(heights), rel=1e-5)
    assert list(metrics) == list(UNITS) and all(entry["standard_error"] is None for entry in metrics.values())
    for name, unit in UNITS.items():
        assert re.search(rf"(?m)^  {name} +{metrics[name]['mean']:.4f} \+- nan {re.escape(unit)}$", output), name
    assert "model_3.pt, after 24 steps of training, 1 worlds x 9 steps:" in output


def test_mean_level_is_noted(make_runner):
    """On rough ground a row says how far training has come; four worlds start on levels 0 to 3."""
    ground = {"terrain.mesh_type": "heightfield", "terrain.border_size": 1.0}
    runner = make_runner(env=ground, **{"evaluation.interval": 16})
    runner.learn(1)
    header, row = (Path(runner.log_dir) / "evaluations.csv").read_text().splitlines()
    assert header == f"{COLUMNS},terrain_level" and row.endswith(",1.5")
    assert runner.env.terrain.levels.tolist() == [0, 1, 2, 3]


def test_crossing_tiles_after_training_on_a_plane(root, tmp_path):
    """The policy sees what it saw; there is a row per kind and level; a seed fixes every number."""
    words = ["--terrain", "stairs_up", "flat", "--level", "0.5", "0", "--num_envs=2", "--command", "2", "0", "0"]
    output, result = evaluate(root, tmp_path / "a.json", *words)
    evaluate(root, tmp_path / "b.json", *words)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    tiles = [(row["kind"], row["level"], row["worlds"]) for row in result["grounds"]]
    assert tiles == [("stairs_up", 0.0, 2), ("stairs_up", 0.5, 2), ("flat", 0.0, 2), ("flat", 0.5, 2)]
    assert (result["num_envs"], result["time_limit"], result["steps"]) == (8, 4.0, 24) and "num_steps" not in result
    for row in result["grounds"]:
        assert row["crossed"] == {"mean": 0.0, "standard_error": 0.0}  # it cannot walk yet
        assert list(row["metrics"]) == list(UNITS)
        cost = row["metrics"]["cost_of_transport"]["mean"]
        place = rf"{row['kind']} +{row['level']:g} +2 +0.000 \+- 0.000 +{row['fell']['mean']:.3f} "
        assert re.search(rf"(?m)^  {place}.* {cost:.2f}$", output), row
    assert "8 worlds, told to walk 2 0 m/s for 4.0 s at most:" in output


MISTAKES = {
    "--terrain stairs_pu": "unknown kind of terrain 'stairs_pu'; did you mean 'stairs_up'?",
    "--terrain flat --level 0.5 1.01": "a level must be from 0 to 1, not 1.01",
    "--terrain flat --level -0.1": "a level must be from 0 to 1, not -0.1",
    "--terrain flat --level nan": "argument --level: it must be finite, not nan",
    "--terrain flat --level": "argument --level: expected at least one argument",
    "--terrain flat --command 0 0 0": "the command must have a speed of 0.1 m/s or more and a yaw rate of 0, not 0 0 0",
    "--terrain flat --command 1 0 0.5": "a yaw rate of 0, not 1 0 0.5",
    "--terrain flat --steps=5": "--steps is not for --terrain",
    "--level 0.5": "--level needs --terrain",
    "--terrain flat --level 0 --set terrain.measure_heights=true": "does not fit this task",
    "--perturbation=hihg": "unknown perturbation 'hihg'; did you mean 'high'?",
    "--checkpoint=7": "unknown checkpoint '7'; allowed: 0, 1, 2, 3",
    "--steps=0": "--steps must be at least 1, not 0",
    "--command 1 0": "argument --command: expected 3 arguments",
    "--step=5": "unknown option '--step=5'; did you mean '--steps'?",
}


@pytest.mark.parametrize(("words", "message"), MISTAKES.items())
def test_mistakes(root, words, message):
    """Exit status 2, one line that names the mistake, and nothing is written."""
    before = contents(root)
    result = run_here("evaluate.py", *TASK, f"--json={root / 'x.json'}", *words.split(), root=root)
    assert_told_in_one_line(result, message)
    assert contents(root) == before
