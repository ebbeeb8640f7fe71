"""Mistakes on the command lines of scripts: one line, exit status 2, and nothing is written."""

import re
from pathlib import Path

import pytest
import yaml
from support.scripts import ROOT, SMALL, assert_light, assert_told_in_one_line, contents, run_here

from legged_torque.utils.cli import run_script

TABLES = yaml.safe_load(Path(__file__).with_name("mistakes.yaml").read_text("utf-8"))
MISTAKES = [*TABLES["training"], ("--experiment_name=\udcff", "is not UTF-8")]
MISTAKES += [(f"--run_name={'x' * 300}", "File name too long")]


@pytest.mark.parametrize(("words", "message"), MISTAKES, ids=[words for words, _ in MISTAKES])
def test_mistakes_when_training(root, words, message):
    """Exit status 2, one line that names the mistake and the nearest valid name, and nothing is written."""
    before = contents(root)
    result = run_here("train.py", *SMALL, *re.split(r" (?=--)", words), root=root)
    assert_told_in_one_line(result, message)
    assert contents(root) == before


@pytest.mark.parametrize(("script", "words", "message"), TABLES["after training"])
def test_mistakes_after_training(root, script, words, message):
    """The other scripts report mistakes in the same way."""
    before = contents(root)
    result = run_here(script, "--task=a1_position", "--device=cpu", *words.split(), root=root)
    assert_told_in_one_line(result, message)
    assert contents(root) == before


def test_folder_that_is_gone(tmp_path, monkeypatch, capsys):
    """The current folder may have been removed meanwhile."""
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    with pytest.raises(SystemExit) as end:
        run_script(lambda: None)
    assert_told_in_one_line((end.value.code, *capsys.readouterr()), "the current folder has been removed")


def test_number_of_processes_that_is_none(tmp_path, monkeypatch):
    """What torchrun says by the environment is a mistake of the user's if it makes no sense."""
    monkeypatch.setenv("WORLD_SIZE", "x")
    assert_told_in_one_line(run_here("train.py", *SMALL, root=tmp_path), "WORLD_SIZE, which torchrun sets, must be")
    assert not list(tmp_path.iterdir())


def test_answers_need_nothing_heavy(tmp_path):
    """Help of every script, lists, and mistakes that settings show come before anything that takes long to import."""
    answers = {
        **{(script.name, "--help"): 0 for script in sorted((ROOT / "scripts").glob("[!_]*.py"))},
        ("train.py", "--list"): 0,
        ("train.py", "--task=a1_positon"): 2,
        ("train.py", "--num_envs=few"): 2,
        ("train.py", "--set=sim.dt=0"): 2,
        ("train.py", "--set=runner.class_name=Other"): 2,
        ("train.py", "--resume", "--load_run=2026"): 2,
    }
    assert_light(answers, tmp_path)
