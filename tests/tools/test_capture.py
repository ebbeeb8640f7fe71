"""The check that CUDA graphs change no number."""

import math
from functools import partial

import pytest
from support.runners import build_runner
from support.scripts import run_here

from tools.capture import compare_capture, warm_up

SMALL = ["--task=a1_position", "--device=cpu", "--num_envs=2", "--set=runner.num_steps_per_env=4"]


@pytest.fixture
def pair(make_task):
    """Two runners with different pasts, ready to be compared."""
    make = partial(build_runner, make_task, "a1_multihead", **{"algorithm.num_mini_batches": 4})
    runners = [make(seed=seed, **{"runner.capture": bool(seed)}) for seed in range(2)]
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
