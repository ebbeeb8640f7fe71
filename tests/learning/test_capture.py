"""CUDA graphs as a setting: when they run, capture and replay, and the check that they change no number."""

import math

import pytest
import torch
from support.scripts import run_here
from support.settings import error_of, get_cfgs

from legged_torque.envs import task_registry
from legged_torque.sim import graph
from legged_torque.utils.config import set_by_path
from tools.capture import compare_capture, warm_up

SMALL = ["--task=a1_position", "--device=cpu", "--num_envs=2", "--set=runner.num_steps_per_env=4"]


@pytest.fixture(scope="module")
def make_runner(make_task):
    """Factory of runners with short rollouts of small tasks; settings of the training go by dotted path."""

    def make(name="a1_position", seed=0, **overrides):
        _, train_cfg = task_registry.get_cfgs(name)
        for path, value in {"runner.num_steps_per_env": 4, **overrides}.items():
            set_by_path(train_cfg, path, value)
        return task_registry.make_alg_runner(make_task(name, seed=seed), train_cfg=train_cfg, log_root=None)[0]

    return make


def networks(runner):
    """All parameters of actor and critic."""
    alg = runner.alg
    return {**alg.actor.state_dict(prefix="actor."), **alg.critic.state_dict(prefix="critic.")}


@pytest.fixture
def calls(monkeypatch):
    """A graph as on a GPU, with what it does noted in place of a GPU's work."""
    noted = []

    class Recorded:
        """A captured graph."""

        def replay(self):
            noted.append("replayed")

    class NotedGraph(graph.CudaGraph):
        """Captures by name only."""

        def _capture(self):
            noted.append("captured")
            return Recorded()

    monkeypatch.setattr(graph, "is_capturing", lambda device: False)
    return NotedGraph(lambda: noted.append("run"), "cuda:0"), noted


def test_graph_runs_captures_and_replays(calls):
    """The first call runs, the second captures, all replay from then on; a reset starts over."""
    function, noted = calls
    for _ in range(3):
        function()
    assert noted == ["run", "captured", "replayed", "replayed"]
    noted.clear()
    function.reset()
    for _ in range(2):
        function()
    assert noted == ["run", "captured", "replayed"]


def test_disabled_graph_runs(calls):
    """Nothing is captured while it is disabled, and nothing replayed that was captured before."""
    function, noted = calls
    function.enabled = False
    for _ in range(3):
        function()
    assert noted == ["run"] * 3
    function.enabled = True
    function()
    function.enabled = False
    function()
    assert noted[3:] == ["captured", "replayed", "run"]


def test_graph_inside_another_one_runs(calls, monkeypatch):
    """While another graph is being captured, a function runs and so becomes part of it."""
    function, noted = calls
    monkeypatch.setattr(graph, "is_capturing", lambda device: True)
    for _ in range(3):
        function()
    assert noted == ["run"] * 3


@pytest.mark.parametrize(
    ("capture", "steps", "enabled"), [(True, 4, [True] * 3), (False, 4, [False] * 3), (True, 65, [False, True, True])]
)
def test_capture_is_a_setting(make_runner, tmp_path, capture, steps, enabled):
    """It holds for rollouts, steps and updates, and after loading; rollouts too long for a graph go step by step."""
    runner = make_runner(**{"runner.capture": capture, "runner.num_steps_per_env": steps})
    path = str(tmp_path / "model_0.pt")
    runner.save(path)
    runner.load(path)
    assert [
        graph.enabled for graph in (runner.rollout_graph, runner.env.step_graph, runner.alg.update_graph)
    ] == enabled


def test_training_without_capture_is_the_same(make_runner):
    """The same bits come out."""
    runners = [make_runner(**{"runner.capture": capture}) for capture in (True, False)]
    for runner in runners:
        torch.manual_seed(0)
        runner.learn(1)
    assert all(torch.equal(networks(runners[0])[key], value) for key, value in networks(runners[1]).items())


def test_capture_on_the_command_line():
    """``--set`` switches it off; it is on or off, nothing else."""
    assert get_cfgs()[1].runner.capture is True
    assert get_cfgs("--set=runner.capture=False")[1].runner.capture is False
    assert "runner.capture" in error_of(get_cfgs, "--set=runner.capture=2")


@pytest.fixture
def pair(make_runner):
    """Two runners with different pasts, ready to be compared."""
    runners = [make_runner("a1_multihead", seed=seed, **{"runner.capture": bool(seed)}) for seed in range(2)]
    for runner in runners:
        warm_up(runner)
    return runners


def test_comparison_of_equal_runners(pair):
    """From the same start, all that is compared is equal on a CPU, whatever was before."""
    differences = compare_capture(*pair, seed=3)
    assert {"observations critic", "actions", "rewards", "returns", "change of actor", "loss kl"} <= differences.keys()
    for difference in differences.values():
        assert (difference.largest, difference.relative, difference.rms, difference.repeated) == (0.0,) * 4
        assert difference.within(0.0)


def set_rewards(runner):
    """Let rewards be negative, as they are at the start."""
    runner.env.rewards.only_positive = False


def set_clip(runner):
    """Clip the policy's steps at once."""
    runner.alg.clip_param = 0.01


def set_nan(runner):
    """Spoil the rollout's observations."""
    runner.env.default_dof_pos.fill_(math.nan)


@pytest.mark.parametrize(
    ("change", "unequal", "equal"),
    [
        (set_rewards, {"rewards", "returns"}, {"actions", "change of actor", "change of critic", "loss value"}),
        (set_clip, {"change of actor", "loss surrogate"}, {"rewards", "actions"}),
        (set_nan, {"observations policy", "observations critic", "actions"}, {"change of actor"}),
    ],
)
def test_comparison_of_unequal_runners(pair, change, unequal, equal):
    """A runner that does something else is told, by the quantities in which it differs."""
    change(pair[1])
    differences = compare_capture(*pair, seed=3)
    assert not any(differences[name].within(1e-2) for name in unequal)
    assert all(differences[name].within(0.0) for name in equal)


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        ("--iterations=2 --tolerance=0", 0, ""),
        ("--iterations=0", 2, "--iterations must be at least 1, not 0"),
        ("--tolerance=-1", 2, "--tolerance must be at least 0, not -1"),
        ("--tolerance=nan", 2, "--tolerance must be at least 0, not nan"),
        ("--load_run=x", 2, "unknown option '--load_run=x'"),
    ],
)
def test_check_capture(tmp_path, words, status, message):
    """The script compares, or tells the mistake in a line."""
    found, output, error = run_here("check_capture.py", *SMALL, *words.split(), root=tmp_path)
    assert found == status and message in error
    if status == 0:
        assert output.count("change of actor") == 2 and output.endswith("all within the tolerance of 0\n")
        assert error == "" and not list(tmp_path.iterdir())


def test_check_capture_tells_a_difference(tmp_path, monkeypatch):
    """Beyond the tolerance, the exit status is not 0 and the quantities are named."""
    monkeypatch.setattr("tools.capture.Difference.within", lambda self, tolerance: False)
    status, output, _ = run_here("check_capture.py", *SMALL, root=tmp_path)
    assert str(status).startswith("beyond the tolerance of 0.01: observations policy of iteration 0, ")
    assert "all within" not in output
