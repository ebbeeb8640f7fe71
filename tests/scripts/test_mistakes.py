"""Mistakes on the command lines of scripts: one line, exit status 2, and nothing is written."""

import re

import pytest
from support.scripts import ROOT, SMALL, assert_light, assert_told_in_one_line, contents, run_here

from legged_torque.utils.cli import run_script

MISTAKES = [
    ("--task=a1_positon", "unknown task 'a1_positon'; did you mean 'a1_position'?"),
    ("--set=algorithm.num_mini_batches=9", "algorithm.num_mini_batches is 9, more than the samples of a rollout"),
    ("--device=gpu", "unknown device 'gpu'; did you mean 'cpu'?"),
    ("--device=cuda:99", "there is no device 'cuda:99'; available: cpu"),
    ("--num_env=3", "unknown option '--num_env'; did you mean '--num_envs'?"),
    ("--resume --load_run=2026", "unknown run '2026'"),
    ("--resume --checkpoint=7", "unknown checkpoint '7'; allowed: 0, 1, 2"),
    ("--resume --experiment_name=nothing", "there is no run with a checkpoint in"),
    ("--resume", "the run has all of its 2 iterations; to go on: "),
    ("--resume --experiment_name=not_yaml", "config.yaml' is not valid YAML"),
    ("--resume --experiment_name=no_config", "has no config.yaml"),
    ("--resume --experiment_name=half_checkpoint", "model_2.pt' is not a readable checkpoint"),
    ("--resume --experiment_name=a1_position --task=a1_torque", "is of task 'a1_position', not 'a1_torque'"),
    ("--set=asset.mirrored_legs=[[FR,FR]] --set=algorithm.symmetry_cfg.use_data_augmentation=true", "no counterpart"),
    ("--experiment_name=\udcff", "is not UTF-8"),
    ("--log_root=/dev/null", "cannot write '/dev/null/a1_position/"),
    (f"--run_name={'x' * 300}", "File name too long"),
    ("--task=a1_torque_gravity --set=pretraining.file=/proc/x/y.pt", "cannot write '/proc/x/y.pt'"),
    ("--set=obs_groups.actor=[polic]", "did you mean 'policy'?"),
    ("--load_run=2026", "--load_run and --checkpoint need --resume"),
    (
        "--motors=real --set=motors.urdf.knee_speed=30",
        "motors.urdf.knee_speed must be at most motors.urdf.no_load_speed",
    ),
]


@pytest.mark.parametrize(("words", "message"), MISTAKES, ids=[words for words, _ in MISTAKES])
def test_mistakes_when_training(root, words, message):
    """Exit status 2, one line that names the mistake and the nearest valid name, and nothing is written."""
    before = contents(root)
    result = run_here("train.py", *SMALL, *re.split(r" (?=--)", words), root=root)
    assert_told_in_one_line(result, message)
    assert contents(root) == before


@pytest.mark.parametrize(
    ("script", "words", "message"),
    [
        ("play.py", "--terrain=stairs", "unknown kind of terrain 'stairs'; did you mean 'stairs_up'?"),
        ("evaluate.py", "--motors=rael", "unknown motors 'rael'; did you mean 'real'? allowed: ideal, real"),
        ("play.py", "--compare=logs", "--compare needs --viewer web"),
        ("play.py", "--level=0.5", "--level needs --terrain: the kinds of rough ground"),
        ("play.py", "--compare=logs --viewer=web", "the run 'logs' has no config.yaml"),
        ("play.py", "--agent=zero --load_run=x", "--agent zero has no run"),
        ("play.py", "--grid=9 --num_envs=4", "--grid 9 needs as many worlds, but --num_envs is 4"),
        ("play.py", "--grid=4 --viewer=web", "--grid is for videos, which --viewer web does not make"),
        ("evaluate.py", "--terrain stairs_pu", "unknown kind of terrain 'stairs_pu'; did you mean 'stairs_up'?"),
        ("evaluate.py", "--terrain flat --level 0.5 1.01", "a level must be from 0 to 1, not 1.01"),
        ("evaluate.py", "--terrain flat --level nan", "a level must be from 0 to 1, not nan"),
        ("evaluate.py", "--terrain flat --command 0 0 0", "must have a speed of 0.1 m/s or more and a yaw rate of 0"),
        ("evaluate.py", "--terrain flat --steps=5", "--steps is not for --terrain"),
        ("evaluate.py", "--level 0.5", "--level needs --terrain"),
        ("evaluate.py", "--terrain flat --level 0 --set terrain.measure_heights=true", "does not fit this task"),
        ("evaluate.py", "--steps=0", "--steps must be at least 1, not 0"),
        ("benchmark.py", "--rounds=0", "--rounds must be at least 1, not 0"),
        (
            "benchmark.py",
            "--num_envs 2 4 --profile=trace.json",
            "--profile writes one trace: give one number of worlds",
        ),
        ("evaluate.py", "--all_checkpoints --terrain all", "--all_checkpoints takes neither --terrain nor"),
        ("evaluate.py", "--all_checkpoints --json=/dev/null/a", "cannot write '/dev/null/a': Not a directory"),
        ("evaluate.py", "--steps=1 --json=/dev/full", "cannot write '/dev/full': No space left on device"),
        ("export.py", "--out=/dev/null", "cannot write '/dev/null/policy.yaml'"),
        ("play.py", "--video=/dev/null/a.mp4", "cannot write '/dev/null/a.mp4'"),
    ],
)
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
