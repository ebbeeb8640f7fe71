"""Trainings that start from a pre-trained policy: its file, what fits, and the critic's head start."""

import shutil

import numpy as np
import pytest
import torch
from support.gravity import CONFIGURATIONS, FEW, SMALL, STD, STEPS, TASK, words_of
from support.scripts import assert_told_in_one_line, contents, run_here
from support.settings import error_of, get_cfgs

from legged_torque.envs import task_registry
from legged_torque.paper.gravity import pretraining as gravity_pretraining
from legged_torque.paper.gravity.pretrained import check_making, check_spaces, make_pretrained, read_pretrained


@pytest.fixture(scope="module")
def made(made, tmp_path_factory):
    """A copy of the folder, in which there may be trainings."""
    folder, file, *others = made
    root = shutil.copytree(folder, tmp_path_factory.mktemp("copy") / "root")
    return root, root / file.relative_to(folder), *others


@pytest.fixture(scope="module")
def trained(made):
    """Two trainings of two iterations: one finds the policy, the other one makes it, under another name.

    The first one explores less than the training whose policy it finds; in the second one, the critic has just one
    iteration of its own.

    Returns:
        The file that the second one has made; of each the output, and its checkpoints in the order of time.
    """
    root, file, _, _ = made
    other = root / "new" / "other.pt"
    words = [*SMALL, f"--task={TASK}", "--max_iterations=2", "--logger=none", "--set=evaluation.interval=0"]
    words += ["--set=runner.num_steps_per_env=8", "--set=runner.save_interval=1", "--seed=3"]
    words += words_of(**FEW, num_configurations=CONFIGURATIONS, num_steps=STEPS)
    changes = {
        "found": ["--set=actor.distribution_cfg.init_std=0.5"],
        "made": words_of(file=other, critic_warmup_iterations=1),
    }
    runs = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gravity_pretraining, "STANDING_SECONDS", 0.1)  # not looked at here
        for name, more in changes.items():
            before = contents(file.parent)
            status, output, error = run_here("train.py", *words, *more, f"--run_name={name}", root=root)
            assert (status, error) == (0, ""), output + error
            assert contents(file.parent) == before
            runs.append((output, sorted(root.glob(f"logs/{TASK}/*_{name}/model_[1-9].pt"))))
    return other, *runs


def load(files):
    """The actors of checkpoints: their networks, and the logarithm of their standard deviations."""
    actors = [torch.load(file, weights_only=True)["actor_state_dict"] for file in files]
    return [({name: value for name, value in actor.items() if name != STD}, actor[STD]) for actor in actors]


def same(network, other):
    """Whether two networks are the same to the bit."""
    assert network.keys() == other.keys() and len(network) == 8
    return all(torch.equal(value, other[name]) for name, value in network.items())


def test_a_policy_is_found_or_made(made, trained):
    """The file is used or made, with one result whatever the training's seed, whose random numbers stay."""
    root, file, _, _ = made
    other, (found, found_files), (made_here, made_files) = trained
    assert f"Starting from the pre-trained policy '{file.relative_to(root)}'." in found
    assert "making it" not in found and "Round" not in found
    assert f"There is no pre-trained policy '{other}' yet; making it." in made_here
    assert f"Starting from the pre-trained policy '{other}'." in made_here
    assert made_here.count("--set pretraining.num_configurations=") == 1  # how to make it short
    networks = [read_pretrained(path)["actor_state_dict"] for path in (file, other)]
    for network in networks:
        network.pop(STD)
    assert same(*networks)
    infos = [torch.load(files[0], weights_only=True)["infos"] for files in (found_files, made_files)]
    assert torch.equal(*(info["random_states"][0]["cpu"] for info in infos))


def test_first_iterations_train_the_critic_alone(made, trained):
    """The policy stays for 10 iterations, or as many as given; exploration starts as the training's settings say."""
    network = read_pretrained(made[1])["actor_state_dict"]
    network.pop(STD)
    _, (_, found), (_, made_here) = trained
    assert len(found) == len(made_here) == 2
    for actor, log_std in load(found):
        assert same(actor, network)
        torch.testing.assert_close(log_std, torch.full((12,), -0.6931472))  # of 0.5
    (first, log_std), (second, later_log_std) = load(made_here)
    assert same(first, network) and not same(second, network)
    assert (log_std == 0.0).all() and (later_log_std != 0.0).all()
    critics = [torch.load(file, weights_only=True)["critic_state_dict"] for file in found]
    assert all(not torch.equal(value, critics[1][name]) for name, value in critics[0].items())


def test_a_resumed_training_has_its_policy(trained, tmp_path):
    """It goes on with its own policy and the rest of the critic's iterations, also under the function's former name."""
    _, (_, found), _ = trained
    config = found[0].parent / "config.yaml"
    former = "legged_torque.control.gravity_pretraining:pretrain"
    config.write_text(config.read_text().replace("legged_torque.paper.gravity.pretraining:pretrain", former))
    assert former in config.read_text()
    words = ["--device=cpu", f"--task={TASK}", "--resume", f"--load_run={found[0].parent}", "--max_iterations=4"]
    status, output, error = run_here("train.py", *words, *words_of(critic_warmup_iterations=3), root=tmp_path)
    assert (status, error) == (0, "") and "pre-trained" not in output
    assert not (tmp_path / "logs" / "pretrained").exists()
    files = sorted(tmp_path.glob(f"logs/{TASK}/*/model_*.pt"))
    assert [file.name for file in files] == ["model_2.pt", "model_3.pt", "model_4.pt"]
    (before, _), (third, _), (fourth, _) = load([found[1], *files[1:]])
    assert same(before, third) and not same(third, fourth)


def test_what_does_not_fit_is_refused(made):
    """The first setting that differs is named, with both values, also those of its making; nothing is trained."""
    root, file, _, _ = made
    same = words_of(**FEW, num_configurations=CONFIGURATIONS, num_steps=STEPS)
    before = contents(root)
    for setting, message in {
        "control.torque_scale=5": "its control.torque_scale is 8.0, here it is 5.0",
        "motors.chain=[delay,drive,ideal]": "its motors.chain (control law) is [], here it is ['drive']",
        "motors.drive.damping=1": "its motors.drive.damping is 0.0, here it is 1.0",
        "terrain.measure_heights=true": "its terrain.measure_heights is False, here it is True",
        "terrain.measured_points_y=[0.0, 0.1]": "its terrain.measured_points_y is [-0.5, ",
        "actor.hidden_dims=[64]": "its actor.hidden_dims is [512, 256, 128], here it is [64]",
        "obs_groups.actor=[critic]": "its obs_groups.actor is ['policy'], here it is ['critic']",
        "pretraining.max_residual=2.5": "was made with pretraining.max_residual 3.0, here it is 2.5: remove the file",
    }.items():
        words = [*SMALL, f"--task={TASK}", "--max_iterations=1", *same, f"--set={setting}"]
        result = run_here("train.py", *words, root=root)
        assert_told_in_one_line(result, message)
        assert f"'{file.relative_to(root)}'" in result[2]
    assert contents(root) == before
    check_spaces(file, *get_cfgs(task="a1_torque"))  # another task with the same spaces may use it
    _, train_cfg = get_cfgs(*same, *words_of(critic_warmup_iterations=3, file="x.pt"), task=TASK)
    check_making(file, train_cfg)  # settings of a training that starts from it


def test_settings_that_make_no_sense(tmp_path):
    """They are refused by their names before anything is made, and so is a task without pre-training."""
    result = run_here("pretrain_gravity.py", *SMALL, *words_of(num_configurations=3), root=tmp_path)
    assert_told_in_one_line(result, "pretraining.num_rounds is 4, more than there are configurations")
    result = run_here("pretrain_gravity.py", *SMALL, "--set=obs_groups.actor=[critic]", root=tmp_path)
    assert_told_in_one_line(result, "gravity pre-training needs obs_groups.actor=[policy], not ['critic']")
    result = run_here("pretrain_gravity.py", "--device=cpu", "--task=a1_torque", root=tmp_path)
    assert_told_in_one_line(result, "task 'a1_torque' has no pre-training")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (torch.nn.Linear(1, 1), "pretraining.function must return a network and a dictionary"),
        ((torch.nn.Linear(1, 1), {"loss": np.float64(0.5)}), "takes tensors and plain values only, not float64"),
    ],
)
def test_functions_of_ones_own(monkeypatch, tmp_path, made, message):
    """What they return is kept, unless it is something else, or could not be loaded again."""
    monkeypatch.setattr(gravity_pretraining, "pretrain", lambda *_: made)
    env_cfg, train_cfg = task_registry.get_cfgs(TASK)
    assert message in error_of(make_pretrained, tmp_path / "new" / "a.pt", TASK, env_cfg, train_cfg, "cpu")
    assert not list(tmp_path.rglob("*.pt"))
