"""Random numbers of a resumed run: they go on where the checkpoint was saved, and never repeat the run's start."""

from types import SimpleNamespace

import pytest
import torch
from support.random_stream import upcoming
from support.settings import error_of, parse

from legged_torque.envs import task_registry
from legged_torque.learning.random_state import random_state
from legged_torque.utils.task_registry import set_seed

WORDS = ["--task=a1_torque", "--num_envs=2", "--seed=3", "--set=runner.num_steps_per_env=3", "--logger=none"]
WORDS += ["--set=algorithm.num_mini_batches=1", "--set=actor.hidden_dims=[8]", "--set=critic.hidden_dims=[8]"]
WORDS += ["--set=runner.save_interval=1"]


def start(log_root, *words):
    """Seed and build as train.py does; what ``words`` add may be to resume."""
    args = parse(*WORDS, *words)
    env_cfg, train_cfg = task_registry.get_cfgs(args.task, args)
    set_seed(train_cfg.seed)
    env, _ = task_registry.make_env(args.task, args, env_cfg)
    return task_registry.make_alg_runner(env, args.task, args, train_cfg, log_root)[0]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of two iterations, and which numbers were next at its start and after each checkpoint."""
    root = tmp_path_factory.mktemp("logs")
    runner = start(root)
    run = SimpleNamespace(root=root, runner=runner, start=upcoming(), numbers={}, saving_draws=[])
    save = runner.save

    def noted_save(path, infos=None):
        before = torch.get_rng_state()
        save(path, infos)
        run.saving_draws.append(not torch.equal(torch.get_rng_state(), before))
        run.numbers[runner.current_learning_iteration] = upcoming()

    runner.save = noted_save
    runner.learn(2, init_at_random_ep_len=True)
    run.next = torch.rand(5)
    (run.folder,) = root.iterdir()
    return run


def test_resumed_runs_go_on_and_never_repeat_the_start(trained):
    """Numbers are those that came after the checkpoint was saved; the seed alone leads back to the run's start."""
    start(trained.root)
    assert torch.equal(upcoming(), trained.start)
    for words, expected in (([], trained.next), (["--checkpoint=1"], trained.numbers[1])):
        start(trained.root, "--resume", f"--load_run={trained.folder.name}", *words)
        assert torch.equal(upcoming(), expected) and not torch.isclose(upcoming(), trained.start).any()


def test_saving_draws_nothing(trained):
    """A run goes on alike whether it saves or not."""
    assert trained.saving_draws == [False] * 3


def test_loading_alone_leaves_the_stream(trained):
    """play.py and others keep the numbers of their own seed; only resuming takes those of the checkpoint."""
    runner = start(trained.root)
    torch.manual_seed(9)
    infos = runner.load(str(trained.folder / "model_2.pt"))
    drawn = torch.rand(5)
    torch.manual_seed(9)
    assert torch.equal(drawn, torch.rand(5))
    runner.continue_random_numbers(infos)
    assert torch.equal(torch.rand(5), trained.next)


def test_every_process_takes_its_own(trained, monkeypatch):
    """A process takes the state of its number; one that the run did not have keeps its own numbers."""
    runner = trained.runner
    states = []
    for seed in (20, 21):
        torch.manual_seed(seed)
        states.append(random_state("cpu"))
    torch.manual_seed(22)
    expected = {2: upcoming()}
    for rank in range(2):
        torch.manual_seed(20 + rank)
        expected[rank] = torch.rand(5)
    for rank in (0, 1, 2):
        torch.manual_seed(22)
        monkeypatch.setenv("WORLD_SIZE", "3")
        monkeypatch.setenv("RANK", str(rank))
        runner.continue_random_numbers({"random_states": states})
        assert torch.equal(torch.rand(5), expected[rank])


@pytest.mark.parametrize("states", [None, [{}], [{"cpu": torch.zeros(3, dtype=torch.uint8)}], 5])
def test_a_checkpoint_without_usable_states(trained, tmp_path, states):
    """Resuming from it is refused in one line."""
    folder = tmp_path / "run"
    folder.mkdir()
    state = torch.load(trained.folder / "model_1.pt", weights_only=True)
    if states is None:
        del state["infos"]["random_states"]
    else:
        state["infos"]["random_states"] = states
    torch.save(state, folder / "model_1.pt")
    assert "random_states" in error_of(start, tmp_path, "--resume")
