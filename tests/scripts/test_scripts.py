"""The scripts as a user runs them: mistakes are told in one line, and training, stopping, resuming and playing fit."""

import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import yaml
from support.scripts import ROOT, SMALL, assert_light, assert_told_in_one_line, contents, run_here
from support.settings import COMBINATIONS, OTHER_ROBOTS, ROUGH, TASKS
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from legged_torque.utils.runs import checkpoint_file, checkpoint_numbers


def start(script, *words, root):
    """Start a script in the folder ``root``, a process of its own without what the tests have set for themselves."""
    environment = {key: value for key, value in os.environ.items() if key != "MUJOCO_GL"}
    environment |= {"PYTHONUNBUFFERED": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(ROOT / "scripts" / script), *words]
    return subprocess.Popen(
        command, cwd=root, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def finish(process):
    """Wait for a process; return exit status, standard output, standard error."""
    with process:
        output, error = process.communicate(timeout=300)
    return process.returncode, output, error


MISTAKES = [
    ("--task=a1_positon", "unknown task 'a1_positon'; did you mean 'a1_position'?"),
    ("--set=rewards.scales.torqes=-1", "config key 'rewards.scales.torqes'; did you mean 'rewards.scales.torques'?"),
    ("--set=control.stifness=1", "unknown config key 'control.stifness'; did you mean 'control.stiffness'?"),
    ("--set=controls.stiffness=1", "unknown config section 'controls'; did you mean 'control'?"),
    ("--set=control.stiffness", "--set takes KEY=VALUE, not 'control.stiffness'"),
    ("--set=control.stiffness=stiff", "config key 'control.stiffness' takes a value like 20.0, not 'stiff'"),
    ("--set=control.decimation=2.5", "config key 'control.decimation' takes a value like 4, not 2.5"),
    ("--set=control.decimation=0", "control.decimation must be from 1 to 1000, not 0"),
    ("--set=control.decimation=[", "the value '[' is not valid YAML"),
    ("--set=sim.dt=0", "sim.dt must be greater than 0"),
    (
        "--set=commands.ranges.lin_vel_x=[1, -1]",
        "commands.ranges.lin_vel_x must be [minimum, maximum], not [1.0, -1.0]",
    ),
    ("--set=asset.file=a1.xml", "a1.xml"),
    ("--set=algorithm.num_mini_batches=9", "algorithm.num_mini_batches is 9, more than the samples of a rollout"),
    ("--device=gpu", "unknown device 'gpu'; did you mean 'cpu'?"),
    ("--device=cuda:99", "there is no device 'cuda:99'; available: cpu"),
    ("--preset=papr", "unknown preset 'papr'; did you mean 'paper'?"),
    ("--logger=tensorbord", "unknown runner.logger 'tensorbord'; did you mean 'tensorboard'?"),
    ("--num_env=3", "unknown option '--num_env=3'; did you mean '--num_envs'?"),
    ("--resum", "unknown option '--resum'; did you mean '--resume'?"),
    ("resume", "unknown option 'resume'"),
    ("--num_envs=0", "num_envs must be from 1 to 10000000, not 0"),
    ("--num_envs=-1", "num_envs must be from 1 to 10000000, not -1"),
    ("--num_envs=few", "argument --num_envs: invalid int value: 'few'"),
    ("--max_iterations=0", "--max_iterations must be at least 1, not 0"),
    ("--resume --load_run=2026", "unknown run '2026'"),
    ("--resume --checkpoint=7", "unknown checkpoint '7'; allowed: 0, 1, 2"),
    ("--resume --checkpoint=last", "argument --checkpoint: invalid int value: 'last'"),
    ("--resume --experiment_name=nothing", "there is no run with a checkpoint in"),
    ("--resume", "the run has 2 iterations already; raise --max_iterations"),
    ("--resume --experiment_name=not_yaml", "config.yaml' is not valid YAML"),
    ("--resume --experiment_name=no_mapping", "config.yaml' lacks the entries task, env and train"),
    ("--resume --experiment_name=no_entries", "config.yaml' lacks the entries task, env and train"),
    ("--resume --experiment_name=no_config", "has no config.yaml"),
    ("--resume --experiment_name=unknown_key", "unknown config key 'env.num_env'; did you mean 'env.num_envs'?"),
    ("--resume --experiment_name=wrong_type", "'rewards.scales.torques' takes a value like -0.0002, not 'little'"),
    ("--resume --experiment_name=no_section", "config key 'env' is a section with entries, not the value 3"),
    ("--resume --experiment_name=text_checkpoint", "model_2.pt' is not a readable checkpoint"),
    ("--resume --experiment_name=half_checkpoint", "model_2.pt' is not a readable checkpoint"),
    ("--resume --experiment_name=a1_position --task=a1_torque", "is of task 'a1_position', not 'a1_torque'"),
    # words of older YAML, and values that would only fail somewhere deep inside
    ("--set=env.num_envs=1:30", "config key 'env.num_envs' takes a value like 2, not '1:30'"),
    ("--set=domain_rand.push_robots=on", "config key 'domain_rand.push_robots' takes a value like False, not 'on'"),
    ("--set=asset.mirrored_legs=[[FR]]", "asset.mirrored_legs must be pairs [right, left], not ['FR']"),
    ("--num_envs=3000000000", "num_envs must be from 1 to 10000000"),
    ("--preset=", "the value of --preset is empty"),
    ("--perturbation=", "the value of --perturbation is empty"),
    ("--log_root=/dev/null", "cannot write '/dev/null/a1_position/"),
    (f"--run_name={'x' * 300}", "File name too long"),
    ("--task=a1_torque_gravity --set=pretraining.file=/proc/x/y.pt", "cannot write '/proc/x/y.pt'"),
    ("--set=env.num_envs=", "env.num_envs"),
    ("--set=env.num_envs=null", "env.num_envs"),
    ("--set=env.num_envs=2026-99-99", "2026-99-99"),
    ("--set=init_state.pos=[0, 0]", "init_state.pos"),
    ("--set=algorithm.num_mini_batches=0", "algorithm.num_mini_batches"),
    ("--set=algorithm.num_learning_epochs=0", "algorithm.num_learning_epochs"),
    ("--set=runner.save_interval=0", "runner.save_interval"),
    ("--set=actor.activation=relo", "relo"),
    ("--set=actor.class_name=MPLModel", "MPLModel"),
    ("--set=actor.hidden_dims=[]", "actor.hidden_dims"),
    ("--set=actor.distribution_cfg.class_name=Gauss", "actor.distribution_cfg.class_name"),
    ("--set=actor.distribution_cfg.std_type=lg", "unknown actor.distribution_cfg.std_type 'lg'; did you mean 'log'?"),
    ("--set=algorithm.max_learning_rate=0", "algorithm.max_learning_rate must be greater than 0"),
    ("--set=pretraining.file=policy.pt", "pretraining.file is set, but nothing starts from it"),
    ("--set=actor.distribution_cfg.init_std=0", "actor.distribution_cfg.init_std must be greater than 0"),
    ("--set=obs_groups.actor=[polic]", "did you mean 'policy'?"),
    ("--set=algorithm.schedule=adaptiv", "did you mean 'adaptive'?"),
    ("--set=env.num_actions=24", "env.num_actions must be 12 for LeggedRobot, not 24"),
    ("--seed=99999999999999999999999", "seed must be an integer of 64 bits"),
    ("--run_name=a/b", "runner.run_name must be a name, not the path 'a/b'"),
    ("--load_run=2026", "--load_run and --checkpoint need --resume"),
    ("--resume --preset=paper", "--preset cannot be given with --resume"),
    ("--set=asset.terminate_after_contacts_on=[trnk]", "did you mean 'trunk'?"),
]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A folder whose logs hold a run of ``a1_position`` and broken copies of it, one experiment each."""
    root = tmp_path_factory.mktemp("root")
    status, _, error = run_here("train.py", *SMALL, "--set=runner.save_interval=1", "--run_name=good", root=root)
    assert (status, error) == (0, "")
    (run,) = (root / "logs" / "a1_position").iterdir()
    config = (run / "config.yaml").read_text()
    broken = {
        "not_yaml": "task: [a1_position",
        "no_mapping": "walk",
        "no_entries": "task: a1_position",
        "unknown_key": config.replace("num_envs:", "num_env:"),
        "wrong_type": config.replace("torques: -0.0002", "torques: little"),
        "no_section": re.sub(r"^env:\n(  .*\n)+", "env: 3\n", config, flags=re.MULTILINE),
    }
    for name, text in broken.items():
        copy = shutil.copytree(run, root / "logs" / name / run.name)
        assert text != config
        (copy / "config.yaml").write_text(text)
    (shutil.copytree(run, root / "logs" / "no_config" / run.name) / "config.yaml").unlink()
    checkpoint = (run / "model_2.pt").read_bytes()
    for name, content in {"text": b"this is no checkpoint\n", "half": checkpoint[: len(checkpoint) // 2]}.items():
        copy = shutil.copytree(run, root / "logs" / f"{name}_checkpoint" / run.name)
        for number in (0, 1, 2):
            (copy / f"model_{number}.pt").write_bytes(content)
    return root


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
        ("play.py", "--task=a1_positon", "unknown task 'a1_positon'; did you mean 'a1_position'?"),
        ("play.py", "--load_run=2026", "unknown run '2026'"),
        ("play.py", "--checkpoint=7", "unknown checkpoint '7'; allowed: 0, 1, 2"),
        ("play.py", "--experiment_name=not_yaml", "config.yaml' is not valid YAML"),
        ("play.py", "--experiment_name=text_checkpoint", "model_2.pt' is not a readable checkpoint"),
        (
            "play.py",
            "--experiment_name=a1_position --task=a1_multihead",
            "is of task 'a1_position', not 'a1_multihead'",
        ),
        ("play.py", "--num_envs=0", "num_envs must be from 1 to 10000000, not 0"),
        ("play.py", "--steps=0", "--steps must be at least 1, not 0"),
        ("play.py", "--terrain=stairs", "unknown kind of terrain 'stairs'; did you mean 'stairs_up'?"),
        ("play.py", "--level=0.5", "--level needs --terrain: the kinds of rough ground"),
        ("play.py", "--compare=logs", "--compare needs --viewer web"),
        ("play.py", "--compare=logs --viewer=web", "the run 'logs' has no config.yaml"),
        ("play.py", "--grid=5", "--grid must be 1, 4, 9, 16 or 25, not 5"),
        ("play.py", "--grid=0", "--grid must be 1, 4, 9, 16 or 25, not 0"),
        ("play.py", "--grid=36", "--grid must be 1, 4, 9, 16 or 25, not 36"),
        ("play.py", "--grid=-4", "--grid must be 1, 4, 9, 16 or 25, not -4"),
        ("play.py", "--grid=four", "argument --grid: invalid int value: 'four'"),
        ("play.py", "--grid=9 --num_envs=4", "--grid 9 needs as many worlds, but --num_envs is 4"),
        ("play.py", "--grid=4 --viewer=web", "--grid is for videos, which --viewer web does not make"),
        ("play.py", "--stpes=5", "unknown option '--stpes=5'; did you mean '--steps'?"),
        ("play.py", "--set=control.stifness=1", "did you mean 'control.stiffness'?"),
        (
            "evaluate.py",
            "--all_checkpoints --terrain all",
            "--all_checkpoints takes neither --terrain nor --checkpoint",
        ),
        ("evaluate.py", "--all_checkpoints --json=/dev/null/a", "cannot write '/dev/null/a': Not a directory"),
        ("evaluate.py", "--steps=0", "--steps must be at least 1, not 0"),
        ("evaluate.py", "--load_run=2026", "unknown run '2026'"),
        ("evaluate.py", "--json=/dev", "cannot write '/dev': it is a folder"),
        ("evaluate.py", "--json=/proc/x", "cannot write '/proc/x'"),
        ("evaluate.py", "--command nan 0 0", "argument --command: it must be finite, not nan"),
        ("export.py", "--num_envs=0", "num_envs must be from 1"),
        ("export.py", "--out=/dev/null", "cannot write '/dev/null/policy.yaml'"),
        ("play.py", "--video=/dev/null/a.mp4", "cannot write '/dev/null/a.mp4'"),
    ],
)
def test_mistakes_after_training(root, script, words, message):
    """The other scripts tell mistakes in the same way."""
    before = contents(root)
    result = run_here(script, "--task=a1_position", "--device=cpu", *words.split(), root=root)
    assert_told_in_one_line(result, message)
    assert contents(root) == before


def test_number_of_processes_that_is_none(tmp_path, monkeypatch):
    """What torchrun says by the environment is a mistake of the user's if it makes no sense."""
    monkeypatch.setenv("WORLD_SIZE", "x")
    assert_told_in_one_line(run_here("train.py", *SMALL, root=tmp_path), "WORLD_SIZE, which torchrun sets, must be")
    assert not list(tmp_path.iterdir())


def test_values_of_several_lines(tmp_path):
    """The line of a mistake is one even if a name in it has two."""
    assert_told_in_one_line(run_here("train.py", "--task=a\nb", root=tmp_path), "unknown task 'a")


@pytest.mark.parametrize("script", ["train.py", "play.py", "benchmark.py"])
def test_help(script, tmp_path):
    """``--help`` describes the options."""
    status, output, error = run_here(script, "--help", root=tmp_path)
    assert (status, error) == (0, "")
    assert "--task" in output and "--num_envs" in output and "--device" in output


def test_answers_need_nothing_heavy(tmp_path):
    """Help of every script, lists, and mistakes that settings show come before anything that takes long to import."""
    answers = {
        **{(script.name, "--help"): 0 for script in sorted((ROOT / "scripts").glob("[!_]*.py"))},
        ("train.py", "--list"): 0,
        ("train.py", "--task=a1_positon"): 2,
        ("train.py", "--num_env=3"): 2,
        ("train.py", "--num_envs=few"): 2,
        ("train.py", "--num_envs=0"): 2,
        ("train.py", "--set=control.stifness=1"): 2,
        ("train.py", "--set=sim.dt=0"): 2,
        ("train.py", "--set=algorithm.learning_rate=1"): 2,
        ("train.py", "--set=runner.class_name=Other"): 2,
        ("train.py", "--resume", "--load_run=2026"): 2,
    }
    assert_light(answers, tmp_path)


def test_run_folder(root):
    """A run leaves its checkpoints, events and settings, in a folder named by its time and name."""
    (run,) = (root / "logs" / "a1_position").glob("*_good")
    assert re.fullmatch(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d_good", run.name)
    assert {path.name.split(".tfevents")[0] for path in run.iterdir() if path.is_file()} == {
        "model_0.pt",  # so that the training can be watched at once
        "model_1.pt",
        "model_2.pt",
        "worlds_2.pt",
        "events.out",
        "config.yaml",
    }
    config = yaml.safe_load((run / "config.yaml").read_text())
    assert (config["task"], config["preset"], config["device"], config["max_iterations"]) == (
        "a1_position",
        "parallel",
        "cpu",
        2,
    )
    assert config["env"]["env"]["num_envs"] == 2 and config["train"]["runner"]["num_steps_per_env"] == 4
    assert torch.__version__.startswith(config["versions"]["torch"])


def test_resume_in_a_folder_by_its_path(root, tmp_path):
    """``--load_run`` takes a path, ``--checkpoint`` an earlier checkpoint, and other options still change settings."""
    (run,) = (root / "logs" / "a1_position").glob("*_good")
    words = [f"--load_run={run}", "--checkpoint=1", "--resume", "--max_iterations=2", "--logger=none", "--seed=9"]
    status, output, error = run_here("train.py", "--task=a1_position", "--device=cpu", *words, root=tmp_path)
    assert (status, error) == (0, "")
    assert f"Resuming from {run / 'model_1.pt'}, after 1 iterations.\n" in output
    (new,) = (tmp_path / "logs" / "a1_position").iterdir()
    files = {path.name for path in new.iterdir() if path.is_file()}
    assert files == {"config.yaml", "model_1.pt", "model_2.pt", "worlds_2.pt"}
    state = torch.load(new / "model_2.pt", weights_only=True)
    assert (state["iter"], state["infos"]["total_timesteps"]) == (2, 2 * 2 * 4)
    train = yaml.safe_load((new / "config.yaml").read_text())["train"]
    assert (train["seed"], train["runner"]["logger"], train["runner"]["num_steps_per_env"]) == (9, "none", 4)


def test_learning_curve(root, tmp_path):
    """Every checkpoint is measured, at the number of steps after which it was saved."""
    file = tmp_path / "new" / "curve.json"
    words = ["--task=a1_position", "--device=cpu", "--num_envs=2", "--steps=3", f"--json={file}", "--all_checkpoints"]
    status, output, error = run_here("evaluate.py", *words, root=root)
    assert (status, error) == (0, "") and len(output.splitlines()) == 3
    curve = json.loads(file.read_text())
    assert [point["steps"] for point in curve["points"]] == [0, 8, 16]
    assert (curve["task"], curve["seed"], curve["evaluation"]["seed"]) == ("a1_position", 1, 1001)
    assert all(math.isfinite(value) for point in curve["points"] for value in point.values())


def test_list_of_tasks(tmp_path):
    """``train.py --list`` prints the names of all tasks, one a line, and writes nothing."""
    names = [*TASKS, *COMBINATIONS, *ROUGH, *OTHER_ROBOTS, ""]
    assert run_here("train.py", "--list", root=tmp_path) == (0, "\n".join(names), "")
    assert not list(tmp_path.iterdir())


def test_nobody_reads_on(tmp_path):
    """Output that goes into ``| head`` ends a script without a traceback."""
    process = start("train.py", "--list", root=tmp_path)
    process.stdout.close()
    assert (process.stderr.read(), process.wait()) == ("", 1)
    process.stderr.close()


def test_late_mistake_in_a_process_of_its_own(tmp_path):
    """A mistake that shows only when the simulator is there is one line too, and leaves no folder."""
    result = finish(start("train.py", *SMALL, "--logger=tensorbord", root=tmp_path))
    assert_told_in_one_line(result, "unknown runner.logger 'tensorbord'; did you mean 'tensorboard'?")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("after", [0.0, 0.8])
def test_interrupt_while_starting(tmp_path, after):
    """Ctrl-C before anything runs ends a script by that signal, without a word."""
    process = start("train.py", *SMALL, root=tmp_path)
    while not leaves_interrupts_alone(process.pid):
        time.sleep(0.01)
    time.sleep(after)
    process.send_signal(signal.SIGINT)
    status, output, error = finish(process)
    assert (status, output, error) == (-signal.SIGINT, "", "") and not list(tmp_path.iterdir())


def leaves_interrupts_alone(process):
    """Whether Python has started in a process, which ignores SIGPIPE then, and nothing handles Ctrl-C."""
    status = Path(f"/proc/{process}/status").read_text()
    ignored, caught = (int(re.search(rf"{name}:\s+(\w+)", status)[1], 16) for name in ("SigIgn", "SigCgt"))
    return bool(ignored & 1 << signal.SIGPIPE - 1) and not caught & 1 << signal.SIGINT - 1


def test_train_stop_resume_play(tmp_path):
    """Ctrl-C saves and ends with status 130, resuming goes on with all counters, and playing prints how it walks."""
    task, logs = ["--task=a1_torque_multihead", "--device=cpu"], tmp_path / "logs" / "a1_torque_multihead"
    settings = {
        "runner.num_steps_per_env": 4,
        "env.episode_length_s": 0.06,  # three steps: there are rewards of whole episodes to print
        "control.mixing.update_interval": 8,
        "control.mixing.pd.t_end": 400,
    }
    changes = [f"--set={key}={value}" for key, value in settings.items()]
    process = start("train.py", *task, *changes, "--num_envs=2", "--max_iterations=100000", root=tmp_path)
    for line in process.stdout:
        if "iteration 1 of" in line:
            break
    process.send_signal(signal.SIGINT)
    status, output, error = finish(process)
    assert status == 130 and "Traceback" not in error and "Stopping" in output + error
    (first,) = logs.iterdir()
    beginning, count = checkpoint_numbers(first)
    assert beginning == 0
    checkpoint = checkpoint_file(first, count)
    state = torch.load(checkpoint, weights_only=True)
    assert 2 <= count == state["iter"] and state["infos"]["total_timesteps"] == count * 8
    events = EventAccumulator(str(first)).Reload()
    assert [event.step for event in events.Scalars("Loss/value")] == list(range(count))

    status, output, error = run_here(
        "train.py", *task, "--resume", "--verbose", f"--max_iterations={count + 2}", root=tmp_path
    )
    assert (status, error) == (0, "")
    assert "\033" not in output and " of " not in output.partition("worlds, ")[2]
    (second,) = set(logs.iterdir()) - {first}
    state = torch.load(second / f"model_{count + 2}.pt", weights_only=True)
    assert state["iter"] == count + 2 and state["infos"]["total_timesteps"] == (count + 2) * 8
    assert int(state["infos"]["task"]["total_steps"]) == (count + 2) * 8
    for number in (count, count + 1):
        assert f"Learning iteration {number}/{count + 2}" in output
        assert re.search(rf"Curriculum/mixing_pd: {max(0.0, 1.0 - number * 8 / 400):.4f}", output)
    for name in ("Steps per second", "ETA", "Mean reward", "Tracking/error_xy", "Tracking/error_yaw"):
        assert output.count(f"{name}:") == 2
    for name in ("Curriculum/weight_tracking_lin_vel", "Curriculum/mixing_torque", "Health/diverged_worlds"):
        assert output.count(f"{name}:") == 2
    configs = [yaml.safe_load((run / "config.yaml").read_text()) for run in (first, second)]
    assert configs[0]["env"] == configs[1]["env"] and configs[0]["train"] == configs[1]["train"]
    assert configs[1]["env"]["env"]["num_envs"] == 2 and torch.__version__.startswith(configs[1]["versions"]["torch"])

    status, output, error = run_here("play.py", *task, "--num_envs=2", "--steps=10", root=tmp_path)
    assert status == 0 and "Traceback" not in error
    assert f"model_{count + 2}.pt, after {(count + 2) * 8:,} steps of training:" in output
    for name in ("track_xy", "track_angular", "cost_of_transport", "falls_per_minute"):
        assert math.isfinite(float(re.search(rf"^\s*{name}\s+(\S+)", output, re.MULTILINE).group(1)))
    assert re.match(r"no video: .+", output.splitlines()[-1])  # see test_packaging.py for one


def test_resume_keeps_the_number_of_iterations(root, tmp_path):
    """Without a wish, a resumed run goes on to the number of iterations that it was started for."""
    (run,) = (root / "logs" / "a1_position").glob("*_good")
    words = [f"--load_run={run}", "--checkpoint=1", "--resume", "--logger=none", "--task=a1_position", "--device=cpu"]
    status, _, error = run_here("train.py", *words, root=tmp_path)
    assert (status, error) == (0, "")
    (new,) = (tmp_path / "logs" / "a1_position").iterdir()
    assert checkpoint_numbers(new) == [1, 2]
    config = yaml.safe_load((new / "config.yaml").read_text())
    assert (config["max_iterations"], config["preset"]) == (2, "parallel")
