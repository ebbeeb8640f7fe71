"""Gravity pre-training: the pairs, the supervision, the file, and trainings that start from it."""

import json
import math

import pytest
import torch
from settings import error_of, get_cfgs, parse
from test_ppo import make_ppo, record_rollout, state_of
from test_scripts import assert_told_in_one_line, run_here

from legged_torque.control.gravity_pretraining import (
    Pairs,
    act_by_controller,
    exchange_last_actions,
    follow,
    histogram,
    imitation_loss,
    make_controller,
    residual_share,
    select,
    supervise,
)
from legged_torque.control.standing import use_standing_trials
from legged_torque.envs import task_registry
from legged_torque.learning.pretrained import check_spaces, read_pretrained

TASK = "a1_torque_gravity"
SMALL = ["--device=cpu", "--num_envs=16", "--set=pretraining.num_epochs=3", "--set=pretraining.batch_size=64"]
FEW = ["--num_configurations=40", "--num_steps=6"]
WEIGHT = 12.453 * 9.81


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder in which pretrain_gravity.py has made a small policy: the folder, its file, the report, the output."""
    root = tmp_path_factory.mktemp("pretrained")
    words = [*SMALL, *FEW, f"--json={root / 'report.json'}"]
    status, output, error = run_here("pretrain_gravity.py", *words, root=root)
    assert (status, error) == (0, ""), output + error
    file = root / "logs" / "pretrained" / f"{TASK}.pt"
    return root, file, json.loads((root / "report.json").read_text()), output


@pytest.fixture(scope="module")
def teacher():
    """A task of 32 worlds as pre-training has it, its controller, and the settings."""
    env_cfg, train_cfg = get_cfgs("--num_envs=32", task=TASK)
    use_standing_trials(env_cfg, env_cfg.control.decimation)
    torch.manual_seed(0)
    task, _ = task_registry.make_env(TASK, parse(), env_cfg)
    settings = train_cfg.pretraining
    settings.num_configurations, settings.num_steps, settings.batch_size = 50, 8, 100
    return task, make_controller(task), train_cfg


def test_report(made):
    """Every pair is kept or dropped for a reason, each configuration counts once, and errors fall."""
    _, file, report, output = made
    dropped = report["dropped"]
    assert set(dropped) == {"after a fall", "mean torque over 30 N m", "wrench residual over 0.2"}
    assert report["pairs"] + sum(dropped.values()) == 40 * 6 and report["pairs"] > 120
    for numbers in report["histograms"].values():
        assert sum(numbers["counts"]) == 40 * 6 and len(numbers["edges"]) == len(numbers["counts"]) + 1
    assert len(report["rms_error"]["training"]) == len(report["rms_error"]["held_out"]) == 3
    assert report["rms_error"]["training"][2] < report["rms_error"]["training"][0]
    assert report["standing"]["controller"] > 0.8 and 0.0 <= report["standing"]["policy"] <= 1.0
    assert set(report["seconds"]) == {"data", "supervision"}
    assert "Followed 40 of 40 configurations." in output and f"Kept {report['pairs']} of 240 pairs; dropped: " in output
    assert "Epoch 3 of 3: root mean square error training " in output and f"The policy is in {file}" in output
    assert read_pretrained(file)["report"] == report


def test_pairs_are_what_the_controller_does(teacher):
    """Actions are its torques over the scale, in the states that the policy sees; both sets share no configuration."""
    task, controller, train_cfg = teacher
    torch.manual_seed(1)
    settings = train_cfg.pretraining
    collection = collect(task, controller, settings)
    held_out, training = len(collection.held_out.actions), len(collection.training.actions)
    assert held_out + training + sum(collection.dropped.values()) == 50 * 8 == len(collection.mean_torques)
    assert 0 < held_out <= 0.1 * 50 * 8
    for pairs in (collection.training, collection.held_out):
        assert pairs.observations.shape[1] == 45 and (pairs.actions.abs() * 4.0 <= 33.5 + 1e-4).all()
    torques = 4.0 * torch.cat([collection.held_out.actions, collection.training.actions])
    kept = torques.abs().mean(dim=1)
    assert kept.max() <= 30.0
    everything = torch.sort(collection.mean_torques).values
    assert torch.isclose(kept.unsqueeze(1), everything.unsqueeze(0), atol=1e-4).any(dim=1).all()
    standing = collection.training.observations[:, 9:33].abs().sum(dim=1) < 0.5  # near the nominal pose and at rest
    carried = torques[held_out:][standing]
    assert len(carried) == 0 or carried.abs().mean() < 6.0


def test_first_pair_by_hand(teacher):
    """In the air there are no contacts: the action is the posture PD's torque of eq. 8, from the policy's own numbers."""
    task, controller, train_cfg = teacher
    torch.manual_seed(2)
    pairs = collect(task, controller, train_cfg.pretraining).training
    first = pairs.observations[:, 33:].abs().sum(dim=1) == 0.0  # no action before: nothing has touched yet
    observations, actions = pairs.observations[first], pairs.actions[first]
    assert len(actions) >= 30
    expected = -20.0 * observations[:, 9:21] - 0.5 * observations[:, 21:33] / 0.05
    torch.testing.assert_close(4.0 * actions, expected.clamp(-33.5, 33.5), atol=1e-3, rtol=0)


def test_dropped_pairs(teacher):
    """A limit of 0 drops every pair that has any torque, or any residual, and says so."""
    task, controller, train_cfg = teacher
    settings = train_cfg.pretraining
    for name, reason in (("max_mean_torque", "mean torque over 0 N m"), ("max_residual", "wrench residual over 0")):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(settings, name, 0.0)
            torch.manual_seed(3)
            dropped = collect(task, controller, settings).dropped
        assert dropped[reason] > (350 if name == "max_mean_torque" else 10)


def test_residual_share(teacher):
    """A force of the weight is 1, and so is a moment of the weight at the arm of 0.2 m."""
    task, controller, _ = teacher
    decided = controller(task.sim.qpos, task.sim.qvel, task.feet_contact > 0)
    decided.wrench_residual = torch.zeros(32, 6)
    decided.wrench_residual[0, 1] = WEIGHT
    decided.wrench_residual[1, 3] = 0.2 * WEIGHT
    decided.wrench_residual[2] = torch.tensor([0.0, 0.6 * WEIGHT, 0.0, 0.0, 0.0, 0.16 * WEIGHT])
    shares = residual_share(controller, decided)
    torch.testing.assert_close(shares[:4], torch.tensor([1.0, 1.0, 1.0, 0.0]), atol=1e-4, rtol=0)


@pytest.mark.parametrize("history", [1, 2])
def test_last_actions_are_exchanged(history):
    """They are those of other samples, of which each is used once; all else stays."""
    observations = torch.arange(50.0 * 20 * history).view(50, 20 * history)
    torch.manual_seed(0)
    exchanged = exchange_last_actions(observations, 3, history)
    before, after = observations.view(50, history, 20), exchanged.view(50, history, 20)
    assert torch.equal(after[..., :17], before[..., :17])
    assert not torch.equal(after[..., 17:], before[..., 17:])
    order = after[:, 0, 17].argsort()
    assert torch.equal(after[order][..., 17:], before[..., 17:])


def test_supervision(teacher):
    """The loss is the mean square error on pairs and mirror images; learning linear actions makes it small."""
    task, controller, train_cfg = teacher
    actor = task_registry.make_alg_runner(task, train_cfg=train_cfg, log_root=None)[0].alg.actor
    torch.manual_seed(0)
    observations = torch.randn(400, 45)
    pairs = Pairs(observations, -observations[:, 9:21])  # -(q - q_nominal): the same on both sides
    for parameter in list(actor.parameters())[-2:]:
        torch.nn.init.zeros_(parameter)
    torch.testing.assert_close(imitation_loss(task, actor, pairs), pairs.actions.square().mean())
    collection = collect(task, controller, train_cfg.pretraining)
    collection.training, collection.held_out = Pairs(*(part[50:] for part in vars(pairs).values())), pairs.split(50)[0]
    settings = train_cfg.pretraining
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(settings, "num_epochs", 40)
        errors = supervise(task, actor, collection, settings)
    assert len(errors["held_out"]) == 40 and errors["held_out"][0] > 2.0 > 1.5 > errors["held_out"][-1]
    assert errors["training"][-1] < 0.5 * errors["training"][0]


def test_histogram():
    """Values beyond the highest count in the last bin."""
    counts = histogram(torch.tensor([0.1, 0.9, 1.1, 9.0, 100.0]), 10.0, bins=10)
    assert counts == {"edges": [float(i) for i in range(11)], "counts": [2.0, 1.0, *[0.0] * 6, 0.0, 2.0]}


def test_a_policy_is_found_or_made(made):
    """Training starts from the file if there is one, and makes it if there is none, with the same result."""
    root, file, _, _ = made
    few = [f"--set=pretraining.{name}" for name in ("num_configurations=40", "num_steps=6")]
    words = [*SMALL, *few, f"--task={TASK}", "--max_iterations=1", "--set=runner.num_steps_per_env=8"]
    network = read_pretrained(file)["actor_state_dict"]
    changed = file.stat().st_mtime_ns
    status, output, error = run_here("train.py", *words, root=root)
    assert (status, error) == (0, "") and f"Starting from the pre-trained policy '{file}'." in output
    assert file.stat().st_mtime_ns == changed and "Followed" not in output
    made_anew = root / "anew.pt"
    words += [f"--set=pretraining.file={made_anew}", "--run_name=anew"]
    status, output, error = run_here("train.py", *words, root=root)
    assert (status, error) == (0, "") and f"There is no pre-trained policy '{made_anew}' yet; making it." in output
    again = read_pretrained(made_anew)["actor_state_dict"]
    states = [torch.load(run, weights_only=True) for run in sorted(root.glob(f"logs/{TASK}/*/model_1.pt"))]
    assert len(states) == 2
    for key, value in network.items():
        assert torch.equal(again[key], value)
        for state in states:  # the first iterations train the critic alone
            trained = state["actor_state_dict"][key]
            if key == "distribution.log_std_param":
                torch.testing.assert_close(trained, torch.full((12,), math.log(0.5)))
            else:
                assert torch.equal(trained, value)
    for key, value in states[0]["critic_state_dict"].items():
        assert torch.equal(states[1]["critic_state_dict"][key], value)


def test_what_does_not_fit_is_refused(made):
    """The first setting that differs is named, with both values; nothing is trained."""
    root, file, _, _ = made
    words = [*SMALL, f"--task={TASK}", "--max_iterations=1"]
    for setting, told in {
        "control.torque_scale=5": "its control.torque_scale is 4.0, here it is 5.0",
        "env.history_length=2": "its env.history_length is 1, here it is 2",
        "normalization.obs_scales.dof_vel=0.1": "its normalization.obs_scales.dof_vel is 0.05, here it is 0.1",
        "actor.hidden_dims=[64]": "its actor.hidden_dims is [512, 256, 128], here it is [64]",
    }.items():
        result = run_here("train.py", *words, f"--set={setting}", root=root)
        assert_told_in_one_line(result, told)
        assert str(file) in result[2]
    check_spaces(file, *get_cfgs(task="a1_torque"))  # another task with the same spaces may use it


@pytest.mark.parametrize("content", [b"nothing", None])
def test_broken_file(content, tmp_path):
    """A file that is no pre-trained policy is told in one line."""
    file = tmp_path / "policy.pt"
    if content:
        file.write_bytes(content)
    else:
        torch.save({"weights": torch.zeros(3)}, file)
    assert f"'{file}' is not a " in error_of(read_pretrained, file)


def test_a_task_without_pretraining(tmp_path):
    """There is nothing to make for it."""
    result = run_here("pretrain_gravity.py", "--device=cpu", "--task=a1_torque", root=tmp_path)
    assert_told_in_one_line(result, "task 'a1_torque' has no pre-training")


def test_critic_warmup():
    """While only the critic learns, policy and learning rate stay; then both move."""
    alg = make_ppo(schedule="adaptive", desired_kl=1e-6)
    before = state_of(alg)
    alg.learn_actor(False)
    record_rollout(alg)
    alg.update()
    warm = state_of(alg)
    for key, value in before.items():
        assert torch.equal(warm[key], value) == (key.startswith("actor") or key == "lr"), key
    alg.learn_actor(True)
    record_rollout(alg)
    alg.update()
    after = state_of(alg)
    assert all(not torch.equal(after[key], warm[key]) for key in warm if key.startswith("actor"))


def test_negative_warmup():
    """It is refused by its name."""
    words = ("--set=pretraining.critic_warmup_iterations=-1",)
    assert "pretraining.critic_warmup_iterations must be at least 0" in error_of(get_cfgs, *words)
