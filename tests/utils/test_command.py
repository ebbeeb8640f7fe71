"""The console command, completion by the shell, the layout of ``--help`` and the flags that legged_gym's users know."""

import importlib
import re
import runpy
import sys

import pytest
import torch
from support.command import command, complete
from support.scripts import ROOT, assert_told_in_one_line, run_here
from support.settings import error_of, get_cfgs, parse

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
    """Options are in groups, and the help ends with examples of the script itself, whose options exist."""
    _, output, _ = run_here(f"{script}.py", "--help", root=tmp_path)
    head, _, examples = output.partition("\nexamples:\n")
    assert all(line.startswith(f"    python {ROOT}/scripts/{script}.py") for line in examples.splitlines()) and examples
    for option in re.findall(r"--\w+", examples) if script != "plot" else ():  # whose figures have their own
        assert f"  {option}" in head, option
    if "--set KEY" in head:
        assert head.index("\noptions:\n") < head.index("\ntask and settings:\n") < head.index("\n  --set KEY=VALUE")


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


def test_words_for_another_script():
    """Options that are given, each value of a list as an option of its own."""
    options = Options(task="a", task_file=["a.py", "b c.py"])
    words = ["--task_file=a.py", "--task_file=b c.py", "--task=a"]
    assert option_words(options, "task_file", "seed", "set", "task") == words


def interrupt():
    """Press Ctrl-C."""
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("main", "status", "line"),
    [
        (
            lambda: importlib.import_module("nothing.of_this_name"),
            "2",
            "error: 'nothing' is not installed; pip",
        ),
        (interrupt, "130", "interrupted"),
    ],
)
def test_ends_of_scripts(main, status, line, capsys):
    """A missing package and Ctrl-C end a script with a line and a status."""
    with pytest.raises(SystemExit, match=status):
        run_script(main)
    error = capsys.readouterr().err
    assert error.startswith(line) and error.count("\n") == 1
