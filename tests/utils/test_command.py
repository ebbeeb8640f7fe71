"""The console command, completion by the shell, the layout of ``--help`` and the flags that legged_gym's users know."""

import importlib
import re
import runpy
import sys

import pytest
import torch
from support.command import command
from support.scripts import ROOT, assert_told_in_one_line, run_here
from support.settings import error_of, get_cfgs, parse

from legged_torque.envs import task_registry
from legged_torque.envs.base.commands import fix_command
from legged_torque.utils.cli import Parser, add_task_args, option_words, run_script, script_command
from legged_torque.utils.options import Options

SCRIPTS = sorted(path.stem for path in (ROOT / "scripts").glob("[!_]*.py"))


def test_command_runs_scripts():
    """A script's name and its own words; what it prints of other commands is for the same command."""
    status, output, error = command("train", "--help")
    assert (status, error) == (0, "") and output.startswith("usage: legged-torque train ")
    assert "    legged-torque train --task=a1_torque_multihead" in output and "python scripts/train.py" not in output
    assert not output.endswith("}")  # nothing heavy


def test_command_without_a_script():
    """The overview names every script and says what it does; a mistake is one line."""
    status, output, error = command()
    assert (status, error) == (0, "")
    told = dict(re.findall(r"^  (\w+) +(\S.*)$", output.partition("commands:")[2], flags=re.MULTILINE))
    assert sorted(told) == SCRIPTS and told["train"] == "Train a policy" and next(iter(told)) == "train"
    assert_told_in_one_line(command("trian"), "unknown command 'trian'; did you mean 'train'?")


def complete(line, env):
    """What a shell offers after a line."""
    pytest.importorskip("argcomplete")
    variables = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_IFS": "\n"}
    variables |= {"_ARGCOMPLETE_STDOUT_FILENAME": str(env), "_ARGCOMPLETE_SHELL": "bash"}
    status, _, error = command(env=variables)
    assert status == 0, error
    return env.read_text().split()


def test_completion(tmp_path):
    """Names of scripts, then options and tasks of a script, and figures and their options."""
    assert complete("legged-torque pl", tmp_path / "1")[0] == "play"
    assert complete("legged-torque train --task_", tmp_path / "2") == ["--task_file"]
    assert complete("legged-torque train --task a1_torque_mul", tmp_path / "3") == ["a1_torque_multihead"]
    assert complete("legged-torque plot cur", tmp_path / "4") == ["curves"]
    assert complete("legged-torque plot curves --o", tmp_path / "5") == ["--out"]


def test_command_of_other_scripts(monkeypatch, tmp_path):
    """What a script prints for the user to type is how the script itself was started."""
    monkeypatch.setattr(sys, "argv", ["scripts/train.py"])
    monkeypatch.chdir(ROOT)
    assert script_command("play") == "python scripts/play.py"
    monkeypatch.chdir(tmp_path)
    assert script_command("play") == f"python {ROOT}/scripts/play.py"  # as it can be typed there
    monkeypatch.setattr(sys, "argv", ["legged-torque train"])
    assert script_command("play") == "legged-torque play"
    monkeypatch.setattr("legged_torque.utils.cli.SCRIPTS_DIR", ROOT / "legged_torque" / "scripts")
    monkeypatch.setattr(sys, "argv", ["train.py"])
    assert script_command("play") == "python -m legged_torque.scripts.play"


@pytest.mark.parametrize("script", SCRIPTS)
def test_help_has_examples(script, tmp_path):
    """Options are in groups, and the help ends with examples of the script itself."""
    _, output, _ = run_here(f"{script}.py", "--help", root=tmp_path)
    head, _, examples = output.partition("\nexamples:\n")
    assert all(line.startswith(f"    python {ROOT}/scripts/{script}.py") for line in examples.splitlines()) and examples
    if "--set KEY" in head:
        assert head.index("\noptions:\n") < head.index("\ntask and settings:\n") < head.index("\n  --set KEY=VALUE")


def test_examples_are_accepted(tmp_path):
    """The options of the examples of train.py, play.py and evaluate.py exist: their parsers take them."""
    for script in ("train", "play", "evaluate"):
        text = (ROOT / "scripts" / f"{script}.py").read_text().partition("Examples:\n")[2].partition('"""')[0]
        _, output, _ = run_here(f"{script}.py", "--help", root=tmp_path)
        for option in set(re.findall(r"--\w+", text)):
            assert f"  {option}" in output, (script, option)


# ---- flags of legged_gym ---------------------------------------------------------------------------------------------


def test_last_run_and_checkpoint():
    """-1 is the last one; so it is nothing that needs --resume."""
    options = parse("--load_run=-1", "--checkpoint=-1")
    assert options.load_run is None and options.checkpoint is None
    assert "--checkpoint must be at least 0" in error_of(get_cfgs, "--checkpoint=-2")


def test_names_of_the_device():
    """legged_gym's two devices are one here, and must agree."""
    parser = Parser("test")
    add_task_args(parser)
    assert parser.parse_args(["--sim_device=cpu", "--rl_device", "cpu", "--headless"]).device == "cpu"
    parser = Parser("test")
    add_task_args(parser)
    told = error_of(parser.parse_args, ["--sim_device=cuda:0", "--rl_device=cpu"])
    assert told == "these options mean the same, but differ: --sim_device=cuda:0, --rl_device=cpu"
    parser = Parser("test")
    add_task_args(parser)
    assert parser.parse_args(["--device=cpu", "--device=cuda"]).device == "cuda"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--agent=zero --load_run=x", "--agent zero has no run"),
        ("--agent=random --viewer=web", "--agent random has no run"),
        ("--headless --viewer=native", "--headless opens no window"),
        ("--no_video --video=a.mp4", "--no_video prints metrics alone"),
        ("--agent=best", "argument --agent: invalid choice: 'best'"),
    ],
)
def test_play_refuses(words, told, tmp_path):
    """What does not go together is told before anything is loaded."""
    assert_told_in_one_line(run_here("play.py", *words.split(), root=tmp_path), told)
    assert not list(tmp_path.iterdir())


def test_agents(tmp_path, make_task):
    """Robots of a task act without a run: with zeros, or with other numbers from -1 to 1 in every step and world."""
    words = ["--task=a1_position", "--device=cpu", "--num_envs=2", "--steps=3", "--no_video"]
    status, output, error = run_here("play.py", *words, "--agent=random", root=tmp_path)
    assert (status, error) == (0, "") and output.startswith("random actions:\n") and "falls_per_minute" in output
    assert not list(tmp_path.iterdir())
    agent, task = runpy.run_path(str(ROOT / "scripts" / "play.py"))["agent"], make_task("a1_position", 64)
    assert torch.equal(agent("zero", task)(None), torch.zeros(64, 12))
    first, second = (agent("random", task)(None).clone() for _ in range(2))
    assert first.shape == (64, 12) and -1.0 <= first.min() < -0.9 and 0.9 < first.max() <= 1.0
    assert not (first == second).any()


def test_fixed_command():
    """All worlds get it, whenever commands are drawn."""
    env_cfg, _ = task_registry.get_cfgs("a1_position")
    env_cfg.env.num_envs = 3
    fix_command(env_cfg, (0.5, -0.25, 0.125))
    task, _ = task_registry.make_env("a1_position", Options(device="cpu"), env_cfg)
    task.commands.zero_()
    task.command_generator.resample(torch.ones(3, dtype=torch.bool))
    assert task.commands.tolist() == [[0.5, -0.25, 0.125]] * 3


def test_words_for_another_script():
    """Options that are given, each value of a list as an option of its own."""
    options = Options(task="a", task_file=["a.py", "b c.py"])
    words = ["--task_file=a.py", "--task_file=b c.py", "--task=a"]
    assert option_words(options, "task_file", "seed", "set", "task") == words


def test_a_missing_package(capsys):
    """A package that should have come along is told in one line."""
    with pytest.raises(SystemExit, match="2"):
        run_script(lambda: importlib.import_module("nothing.of_this_name"))
    assert capsys.readouterr().err == "error: 'nothing' is not installed; pip install legged_torque brings it along\n"
