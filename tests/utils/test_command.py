"""The console command, completion by the shell, the layout of ``--help`` and the flags that legged_gym's users know."""

import re
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest
import yaml
from support.scripts import ROOT, assert_told_in_one_line, command, complete, run_here
from support.settings import error_of, get_cfgs, parse

from legged_torque.envs import task_registry
from legged_torque.utils.cli import run_script, script_command
from legged_torque.utils.options import Options

SCRIPTS = sorted(path.stem for path in (ROOT / "scripts").glob("[!_]*.py"))


def test_command_runs_scripts():
    """A script's name and its own words; what it prints of other commands is for the same command."""
    status, output, error = command("train", "--help")
    assert (status, error) == (0, "") and output.startswith("usage: legged-torque train ")
    assert "\n    legged-torque train --task=a1_torque " in output and "python scripts/train.py" not in output
    assert not output.endswith("}")  # nothing heavy


def test_command_without_a_script():
    """The overview names every script and says what it does; a mistake is one line."""
    status, output, error = command()
    assert (status, error) == (0, "")
    told = dict(re.findall(r"^  (\w+) +(\S.*)$", output.partition("commands:")[2], flags=re.MULTILINE))
    assert sorted(told) == SCRIPTS and told["train"] == "Train a policy" and next(iter(told)) == "train"
    assert_told_in_one_line(command("trian"), "unknown command 'trian'; did you mean 'train'?")


WORDS = yaml.safe_load(Path(__file__).with_name("completions.yaml").read_text("utf-8"))["words"]
"""What a shell offers for a command line."""


@pytest.mark.parametrize("line", WORDS)
def test_completion_of_values(line, tmp_path):
    """Names of presets, perturbations, ranges, settings and kinds of ground."""
    assert complete(f"legged-torque {line}", tmp_path / "words") == WORDS[line]


def test_list_of_tasks(tmp_path):
    """Every task is once in the list, by robot and ground, on a line of a terminal; a part of the names chooses."""
    _, output, _ = run_here("train.py", "--list", root=tmp_path)
    assert re.findall(r"^[* ] (\w+_\w+) +\S", output, re.MULTILINE) == sorted(task_registry.names(), key=output.index)
    assert max(map(len, output.splitlines())) <= 80
    assert re.findall(r"^\* (\w+) ", output, re.MULTILINE)[0] == Options().task == "a1_torque_multihead"
    _, output, _ = run_here("train.py", "--list", "go2", root=tmp_path)
    groups = dict(re.findall(r"^(go2 .+):\n((?:  .+\n)+)", output, re.MULTILINE))
    assert {title: lines.count("go2_") for title, lines in groups.items()} == {
        "go2 on a plane": 8,
        "go2 on rough ground, blind": 8,
        "go2 on rough ground, with a height scan": 8,
    }
    assert all("_scan" in line for line in groups["go2 on rough ground, with a height scan"].splitlines())
    assert_told_in_one_line(run_here("train.py", "--list", "g02", root=tmp_path), "did you mean 'go2'?")


def test_values_in_a_word_of_their_own(tmp_path):
    """``--set KEY VALUE`` and a misspelt ``--taks=x`` are refused with what they should be."""
    result = run_here("train.py", "--set", "rewards.scales.torques", "-1e-4", root=tmp_path)
    assert_told_in_one_line(result, "give --set rewards.scales.torques=-1e-4")
    assert_told_in_one_line(run_here("train.py", "--taks=a1_torque", root=tmp_path), "did you mean '--task'?")


def test_command_of_other_scripts(monkeypatch, tmp_path):
    """What a script prints for the user to type is how the script itself was started."""
    monkeypatch.setattr(sys, "argv", ["scripts/train.py"])
    for folder, words in {ROOT: "python scripts/play.py", tmp_path: f"python {ROOT}/scripts/play.py"}.items():
        monkeypatch.chdir(folder)
        assert script_command("play") == words
    with monkeypatch.context() as moved:
        moved.setattr("legged_torque.utils.cli.SCRIPTS_DIR", ROOT / "my scripts")
        moved.setattr("legged_torque.utils.cli.__file__", str(tmp_path / "a" / "b" / "cli.py"))
        assert script_command("play") == f"python '{ROOT}/my scripts/play.py'"
    monkeypatch.setattr("legged_torque.utils.cli.SCRIPTS_DIR", ROOT / "legged_torque" / "scripts")
    monkeypatch.setattr(sys, "argv", ["train.py"])
    assert script_command("play") == "python -m legged_torque.scripts.play"


@pytest.mark.parametrize("script", SCRIPTS)
def test_help_has_examples(script, tmp_path):
    """The help begins with examples of the script itself, whose options exist; the task is the first option."""
    _, output, _ = run_here(f"{script}.py", "--help", root=tmp_path)
    examples, _, head = output.partition("\nExamples:\n")[2].partition("\n\n")
    assert "options:" not in examples and "headless" not in output
    assert all(line.startswith(f"    python {ROOT}/scripts/{script}.py") for line in examples.splitlines()) and examples
    for option in re.findall(r"--\w+", examples) if script != "plot" else ():  # whose figures have their own
        assert f"  {option}" in head, option
    if "--set KEY" in head:
        assert head.index("\n  --task TASK") < head.index("\n  --set KEY=VALUE") < head.index("\noptions:\n")


def test_last_run_and_checkpoint():
    """-1 is the last one; so it is nothing that needs --resume."""
    options = parse("--load_run=-1", "--checkpoint=-1")
    assert options.load_run is None and options.checkpoint is None
    assert "--checkpoint must be at least 0" in error_of(get_cfgs, "--checkpoint=-2")


def test_names_of_the_device():
    """legged_gym's two devices are one here, and must agree."""
    assert parse("--sim_device=cpu", "--rl_device", "cpu", "--headless").device == "cpu"
    told = error_of(parse, "--sim_device=cuda:0", "--rl_device=cpu")
    assert told.startswith("these options mean the same, but differ: ") and "--sim_device=cuda:0" in told


def test_agents(tmp_path):
    """Robots of a task act without a run."""
    words = ["--task=a1_position", "--device=cpu", "--num_envs=2", "--steps=3", "--no_video", "--agent=random"]
    status, output, error = run_here("play.py", *words, root=tmp_path)
    assert (status, error) == (0, "") and output.startswith("random actions:\n") and "falls_per_minute" in output
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("reason", "status", "line"),
    [
        (ModuleNotFoundError(name="nothing"), "2", "error: 'nothing' is not installed"),
        (KeyboardInterrupt(), "130", "interrupted"),
    ],
)
def test_ends_of_scripts(reason, status, line, capsys):
    """A missing package and Ctrl-C end a script with a line and a status."""
    with pytest.raises(SystemExit, match=status):
        run_script(Mock(side_effect=reason))
    error = capsys.readouterr().err
    assert error.startswith(line) and error.count("\n") == 1
