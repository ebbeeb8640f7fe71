"""CUDA graphs as a setting: when they run, capture and replay."""

import pytest
import torch
from support.settings import error_of, get_cfgs

from legged_torque.envs import task_registry
from legged_torque.sim import graph
from legged_torque.utils.config import set_by_path


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


@pytest.mark.parametrize("capture", [True, False])
def test_capture_is_a_setting(make_runner, tmp_path, capture):
    """It holds for steps, rollouts and updates, and after loading; training without is the same training."""
    runner = make_runner(**{"runner.capture": capture})
    path = tmp_path / "model_0.pt"
    runner.save(str(path))
    runner.load(str(path))
    assert [each.enabled for each in (runner._rollout, runner.env.step_graph, runner.alg.update_graph)] == [capture] * 3
    usual = make_runner()
    for each in (runner, usual):
        torch.manual_seed(0)
        each.learn(1)
    assert all(torch.equal(networks(runner)[key], value) for key, value in networks(usual).items())


def test_capture_on_the_command_line():
    """``--set`` switches it off; it is on or off, nothing else."""
    assert get_cfgs()[1].runner.capture is True
    assert get_cfgs("--set=runner.capture=False")[1].runner.capture is False
    assert "runner.capture" in error_of(get_cfgs, "--set=runner.capture=2")


def test_long_rollouts_replay_step_by_step(make_runner):
    """A rollout that is too long for one graph leaves steps and updates theirs."""
    runner = make_runner(**{"runner.num_steps_per_env": 65})
    assert not runner._rollout.enabled and runner.env.step_graph.enabled and runner.alg.update_graph.enabled
