"""Evaluation while training and of checkpoints: what is measured, when, and that training does not notice."""

from itertools import groupby, pairwise
from pathlib import Path

import pytest
import torch
from support.evaluations import COLUMNS, note_steps, read_rows
from support.settings import build_runner, error_of, get, get_cfgs
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from legged_torque.learning.evaluator import TrainingEvaluator, append_row
from legged_torque.utils.config import flat
from legged_torque.utils.metrics import UNITS


@pytest.fixture
def noted(monkeypatch):
    """Every control step of every task, see :func:`note_steps`."""
    return note_steps(monkeypatch)


@pytest.fixture
def make_runner(make_task, tmp_path):
    """Factory of small runners; settings of the training go by dotted path, ``perturbation`` is that of the task."""

    def make(name="a1_position", seed=0, perturbation="none", env=None, **overrides):
        settings = {"runner.logger": "none", "evaluation.num_samples": 6}
        settings |= {"actor.hidden_dims": [8, 8], "critic.hidden_dims": [8], **overrides}
        env = {**perturb(perturbation), **(env or {})}
        return build_runner(make_task, name, 4, seed, log_root=tmp_path, env=env, **settings)

    return make


def perturb(name):
    """The changes of a perturbation by dotted path."""
    return flat(get_cfgs()[0].perturbations()[name])


def rows_of(runner, name="evaluations.csv"):
    """The rows that a runner has written, None without a file."""
    return read_rows(Path(runner.log_dir) / name)


def by_evaluation(steps, training):
    """Notes of steps in worlds other than the training's, a list per evaluation."""
    return [list(notes) for task, notes in groupby(steps, lambda note: note.task) if task is not training]


WHEN = {24: [32, 48, 80], 5: [16, 32, 48, 64, 80], 81: [80], 0: None}


@pytest.mark.parametrize(("interval", "steps"), WHEN.items())
def test_when_rows_appear(make_runner, interval, steps):
    """A rollout has 16 steps; a row comes at the first end of one at or after each interval, and the last."""
    runner = make_runner(**{"evaluation.interval": interval})
    runner.learn(5)
    numbers = [(row["steps"], row["iteration"]) for row in rows_of(runner) or []] or None
    assert numbers == (steps and [(number, number // 16) for number in steps])


def test_the_end_of_a_training(make_runner, noted):
    """A short training has a short evaluation there, which changes nothing in a training that goes on."""
    rows, results, lengths = [], [], []
    for calls in ([5], [2, 3]):
        settings = {"evaluation.interval": 64, "algorithm.annealing_start": 1.0, "runner.run_name": str(len(calls))}
        runner = make_runner(perturbation="low", **settings, **{"evaluation.num_samples": 16})
        for iterations in calls:
            runner.learn(iterations)
        rows.append({int(row["steps"]): {**row, "seconds": 0.0} for row in rows_of(runner)})
        results.append([*runner.alg.actor.parameters(), *runner.env.get_observations().values(), torch.rand(3)])
        lengths.append([len(notes) for notes in by_evaluation(noted, runner.env)])
        noted.clear()
    assert lengths == [[4, 2], [1, 4, 1]]  # at the end a quarter of the training's steps, half of them to warm up
    assert list(rows[0]) == [64, 80] and list(rows[1]) == [32, 64, 80]
    assert str(rows[0][64]) == str(rows[1][64])  # NaN among them
    assert all(torch.equal(one, other) for one, other in zip(*results, strict=True))


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
    for tag in [*(f"Evaluation/{name}" for name in UNITS if "electrical" not in name), "Loss/critic_gradient_norm"]:
        scalars, name = events.Scalars(tag), tag.split("/")[1]
        assert [event.step for event in scalars] == [0, 1, 2]
        assert [event.value for event in scalars] == pytest.approx([row[name] for row in rows], rel=1e-5, nan_ok=True)
    assert rows[1]["seconds"] < rows[2]["seconds"]


def test_a_table_of_another_version(tmp_path):
    """A resumed run goes on with the columns that its table has."""
    file = tmp_path / "evaluations.csv"
    file.write_text("steps,height,gone\n1,0.3,5\n")
    append_row(file, {"steps": 2, "peak_force": 200.0, "height": 0.25})
    assert file.read_text().splitlines()[2] == "2,0.25,nan"


def test_falls_do_not_synchronize_worlds(make_task):
    """Trunks in the ground end episodes at once, and time-outs are staggered as in the air; ages are those observed."""
    length = {"env.episode_length_s": 0.025}  # five steps
    evaluation = make_task("a1_multihead_two_rates", 1, **length).make_evaluation(5, "none")
    task, ages = evaluation.task, torch.zeros(5)
    task.steps_before.copy_(torch.arange(5))
    phase = task.observations.policy_columns("position_phase")[0]
    for step in range(1, 12):
        task.sim.qpos[:] = torch.tensor([0, 0, 0.03, 1.0, 0, 0, 0, *[0.0, 0.8, -2.6] * 4])
        task.sim.qpos[3:, 2] = 2.0
        seen = evaluation.step(torch.zeros(5, 24))["policy"][:, phase]
        assert task.state.reset_buf[:3].all() and (task.base_pos[:, 2] > 0.2).all()
        assert task.state.reset_buf[3:].tolist() == [(world + step) % 5 == 0 for world in (3, 4)]
        ages = (ages + 1) * ~task.state.reset_buf
        assert task.episode_length_buf.tolist() == ages.tolist() and torch.equal(seen, ages % 4 / 4)


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
    assert rows[0] is None and len(rows[1]) == 3 and str(rows[1]) == str(rows[2])  # further evaluations change no other


def test_policies_are_evaluated_as_they_are_used(make_runner, noted):
    """Layers that act otherwise in training, such as dropout, do not in evaluations, and go on as before."""
    runner, modes = make_runner(**{"evaluation.interval": 16}), []
    runner.alg.actor.mlp[0].register_forward_hook(lambda layer, *_: modes.append(layer.training))
    runner.learn(1)
    changes = [first for first, second in pairwise(modes) if first != second]
    assert modes[0] and changes == [True] and runner.alg.actor.training


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
    noted.clear()  # of the step that a training tries
    settings = {"num_envs": 4, "num_samples": 8, "perturbation": ""}
    for seed in (7, 7, 8):
        evaluating = TrainingEvaluator(task, lambda obs: torch.zeros(len(obs), 12), settings, seed)
        numbers = [evaluating.evaluate()[0] for _ in range(2)]
        assert numbers[0] != numbers[1]
    notes = [noted[start : start + 4] for start in (0, 4, 8)]
    seen = [torch.stack([torch.cat([note.commands, note.obs["policy"]], dim=1) for note in each]) for each in notes]
    assert torch.equal(seen[0], seen[1]) and not torch.equal(seen[0], seen[2])
    assert len(seen[0][:, :, :3].flatten().unique()) == 4 * 4 * 3  # commands are drawn anew in every step
    assert len(set(notes[0][0].task.steps_before.tolist())) > 1


@pytest.mark.parametrize(("chosen", "expected"), [("", "low"), ("doubled", "doubled")])
def test_environments(make_runner, noted, chosen, expected):
    """Worlds are perturbed as the training's or as chosen; further environments are measured and logged apart."""
    also = {"evaluation.also": ["high", "none"], "evaluation.also_from": 30, "evaluation.interval": 16}
    also |= {"evaluation.perturbation": chosen, "runner.logger": "tensorboard"}
    runner = make_runner(perturbation="low", **also)
    runner.learn(3)
    tasks = [notes[0].task for notes in by_evaluation(noted, runner.env)]
    assert [tasks.index(task) for task in tasks] == [0, 0, 2, 3, 0, 2, 3]
    for task, name in zip([runner.env, *tasks[1:4]], ("low", expected, "high", "none"), strict=True):
        assert all(get(task.cfg, path) == value for path, value in perturb(name).items())
    rows = {name: rows_of(runner, f"evaluations{name}.csv") for name in ("", "_high", "_none")}
    assert [[row["steps"] for row in each] for each in rows.values()] == [[16, 32, 48], [32, 48], [32, 48]]
    assert len({row["height"] for each in rows.values() for row in each}) == 7
    runner.logger.writer.flush()
    events = EventAccumulator(runner.log_dir).Reload().Scalars("Evaluation_high/height")
    assert [event.value for event in events] == pytest.approx([row["height"] for row in rows["_high"]], rel=1e-5)


def test_unknown_environment(make_runner, tmp_path):
    """It is refused at once, with the nearest name, and nothing is written."""
    assert "unknown evaluation.also 'hihg'; did you mean 'high'?" in error_of(
        make_runner, **{"evaluation.also": ["low", "hihg"]}
    )
    line = error_of(make_runner, **{"evaluation.perturbation": "hihg"})
    assert line.startswith("unknown evaluation.perturbation 'hihg'; did you mean 'high'?")
    assert not list(tmp_path.iterdir())


def test_mean_level_is_noted(make_runner):
    """On rough ground a row says how far training has come; four worlds start on levels 0 to 3."""
    ground = {"terrain.mesh_type": "heightfield", "terrain.border_size": 1.0}
    runner = make_runner(env=ground, **{"evaluation.interval": 16})
    runner.learn(1)
    header, row = (Path(runner.log_dir) / "evaluations.csv").read_text().splitlines()
    assert header == f"{COLUMNS},terrain_level" and row.endswith(",1.5")
    assert runner.env.terrain.levels.tolist() == [0, 1, 2, 3]
