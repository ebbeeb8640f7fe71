"""Files of strangers, made to run code or to do harm: every script refuses them, and what they hold never runs."""

import os
import pickle
import zipfile

import pytest
import torch
import yaml
from support.scripts import LOADING, SMALL, Payload, assert_told_in_one_line, contents, edit_config, load_run, run_here
from support.settings import error_of, get_cfgs, parse

from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.robots.a1 import A1Cfg, A1CfgPPO
from legged_torque.learning import checkpoint
from legged_torque.paper.gravity.pretrained import start_from
from legged_torque.utils.plain_yaml import parse_yaml
from legged_torque.utils.task_registry import TaskRegistry, task_registry

NAMES = (
    "runner.class_name",
    "algorithm.class_name",
    "actor.class_name",
    "actor.distribution_cfg.class_name",
    "critic.class_name",
    "algorithm.symmetry_cfg.data_augmentation_func",
    "pretraining.function",
)
"""Settings that name classes and functions."""


@pytest.mark.parametrize("setting", NAMES)
def test_names_in_a_run(run, harm, setting):
    """A class or function that no registered task names is refused before it is imported; one, by all scripts."""
    edit_config(run, **{setting.replace(".", "__"): "payload:run"})
    before = contents(run.parents[2])
    for script in LOADING if setting == NAMES[0] else ("evaluate.py",):
        assert_told_in_one_line(load_run(script, run), f"unknown {setting} 'payload:run'")
    assert contents(run.parents[2]) == before


def test_names_on_the_command_line(harm):
    """They are refused with the nearest one that is known."""
    for setting in NAMES:
        assert f"unknown {setting} 'payload:run'" in error_of(get_cfgs, f"--set={setting}=payload:run")
    assert "did you mean 'MLPModel'? allowed: MLPModel, " in error_of(get_cfgs, "--set=actor.class_name=MPLModel")
    for name in ("OnPolicyRunner", "rsl_rl.runners:OnPolicyRunner", "payload.run", "os:system", "5"):
        assert "runner.class_name" in error_of(get_cfgs, f"--set=runner.class_name={name}")
    assert error_of(get_cfgs, "--set=actor.class_name=os:system").endswith("register a task to add one")


@pytest.mark.parametrize("words", [[], ["--dry-run"]])
def test_names_in_an_experiment(tmp_path, harm, words):
    """The description of an experiment is refused before anything is started or written, and its listing as well."""
    matrix = {"tasks": ["a1_position"], "environments": {"none": ["none"]}, "seeds": [1]}
    (tmp_path / "theirs.yaml").write_text(yaml.safe_dump(matrix | {"train": {"actor.class_name": "payload:run"}}))
    before = contents(tmp_path)
    result = run_here("experiment.py", "theirs.yaml", "--device=cpu", *words, root=tmp_path)
    assert_told_in_one_line(result, "unknown actor.class_name 'payload:run'")
    assert contents(tmp_path) == before


@pytest.mark.parametrize("script", LOADING)
def test_checkpoint_that_runs_code(run, harm, script):
    """A pickle is not a checkpoint, whether it is one of torch or not."""
    state = torch.load(run / "model_1.pt", weights_only=True) | {"payload": Payload(harm)}
    for save in (torch.save, lambda value, file: file.write_bytes(pickle.dumps(value, protocol=2))):
        save(state, run / "model_1.pt")
        assert_told_in_one_line(load_run(script, run), "model_1.pt' is not a readable checkpoint")


def test_checkpoint_without_an_end(run):
    """A pipe or a device is not read, which would take forever."""
    (run / "model_1.pt").unlink()
    os.mkfifo(run / "model_1.pt")
    (run / "model_2.pt").symlink_to("/dev/zero")
    for words in ([], ["--checkpoint=1"]):
        assert_told_in_one_line(load_run("train.py", run, *words), "is not a readable checkpoint")


def test_checkpoint_that_is_larger_inside(run):
    """Neither compressed archives nor numbers repeated for ever take the memory of their size; no TorchScript."""
    file = run / "model_1.pt"
    with zipfile.ZipFile(file) as whole, zipfile.ZipFile(run / "other.pt", "w", zipfile.ZIP_DEFLATED) as other:
        for name in whole.namelist():
            other.writestr(name, whole.read(name))
        other.writestr("archive/zeros", bytes(10_000_000))
    state = torch.load(file, weights_only=True)
    (run / "other.pt").replace(file)
    assert_told_in_one_line(load_run("evaluate.py", run), "is not a readable checkpoint")
    state["repeated"] = torch.zeros(1).as_strided((2**44,), (0,))
    script = torch.jit.script(torch.nn.Linear(1, 1))
    for save in (lambda: torch.save(state, file), lambda: script.save(str(file))):
        save()
        assert_told_in_one_line(load_run("evaluate.py", run), "model_1.pt' is not a readable checkpoint")


@pytest.mark.parametrize("command", ["export.py", "play.py", "report.py"])
def test_links_out_of_a_run(run, tmp_path, command):
    """What a script writes into a run's folder by default stays there."""
    (tmp_path / "mine").mkdir()
    for name in ("exported_1", "videos", "report"):
        (run / name).symlink_to(tmp_path / "mine")
    result = run_here(command, str(run), root=tmp_path) if command == "report.py" else load_run(command, run)
    assert_told_in_one_line(result, "by a link")
    assert not list((tmp_path / "mine").iterdir())


@pytest.mark.parametrize("script", ["train.py", "evaluate.py"])
def test_checkpoint_of_nothing_but_lists(run, script):
    """Lists inside of lists that no function can follow are reported as well, and what is no dictionary."""
    with zipfile.ZipFile(run / "model_1.pt") as whole:
        parts = {name: whole.read(name) for name in whole.namelist()}
    depth = 100_000
    for content in (b"\x80\x02" + b"]" * depth + b"a" * (depth - 1) + b".", b"\x80\x02K\x01."):
        with zipfile.ZipFile(run / "model_1.pt", "w") as crafted:
            for name, part in parts.items():
                crafted.writestr(name, content if name.endswith("/data.pkl") else part)
        assert_told_in_one_line(load_run(script, run), "model_1.pt'")


def test_checkpoint_for_a_runner_of_rsl_rl(run, harm):
    """A user's task may train with rsl_rl's own runner, whose ``load`` would run what a file holds."""
    registry = TaskRegistry()
    cfg = A1CfgPPO()
    cfg.runner.class_name = "OnPolicyRunner"
    registry.register("own", LeggedRobot, A1Cfg(), cfg)
    env, _ = registry.make_env("own", parse("--num_envs=2"))
    runner, _ = registry.make_alg_runner(env, "own", parse(), log_root=None)
    assert type(runner).__module__.startswith("rsl_rl.")
    torch.save({"payload": Payload(harm)}, run / "model_1.pt")
    with pytest.raises(pickle.UnpicklingError, match="Weights only load failed"):
        runner.load(str(run / "model_1.pt"))


def test_pretrained_policy_that_runs_code(tmp_path, harm):
    """Training does not start from it."""
    torch.save({"actor_state_dict": Payload(harm), "spaces": {}, "report": {}}, tmp_path / "policy.pt")
    words = [*SMALL, "--task=a1_torque_gravity", "--set=pretraining.file=policy.pt", "--logger=none"]
    assert_told_in_one_line(run_here("train.py", *words, root=tmp_path), "is not a readable pre-trained policy")


BOMB = "a: &x0 {k: 1, l: 2}\n" + "".join(f'b{i}: &x{i + 1} {{!!merge "<<": [{f"*x{i}, " * 9}]}}\n' for i in range(9))
TEXTS = {
    "merges": (BOMB, "is not valid YAML"),
    "python": ("!!python/object/apply:payload.run []", "is not valid YAML"),
    "deep": ("[" * 1000 + "]" * 1000, "is nested too deeply"),
    "itself": ("&a [*a]", "is nested too deeply"),
    "twice": ("a: 1\nb: {c: 1, c: 2}", "is not valid YAML: line 2 has the key 'c' a second time"),
    "huge": (f"a: {'9' * 1000}", "is nested too deeply or larger"),
    "many": ("\n".join(["a: &a0 [x]", *(f"b{i}: &a{i + 1} [{f'*a{i}, ' * 9}]" for i in range(12))]), "is nested too"),
}
"""YAML that runs code, hides one value by another, or takes all of the memory or the stack, and what is reported."""


@pytest.mark.parametrize("name", TEXTS)
def test_yaml(run, tmp_path, harm, name):
    """Neither a run, an experiment nor an export is read that is made to do harm."""
    text, told = TEXTS[name]
    assert told in error_of(parse_yaml, text, "it")
    (run / "config.yaml").write_text(text)
    assert_told_in_one_line(load_run("evaluate.py", run), f"config.yaml' {told}")
    (tmp_path / "policy.yaml").write_text(text)
    commands = {"experiment.py": ["policy.yaml", "--dry-run"], "sim2sim.py": ["policy.yaml"]}
    for script, words in commands.items():
        assert_told_in_one_line(run_here(script, *words, root=tmp_path), f"policy.yaml' {told}")


def test_names_that_are_no_names(run):
    """Line ends and the codes of terminals are reported as codes: an error stays one line."""
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(yaml.safe_dump(yaml.safe_load(text) | {"task": "x\nerror: \x1b[2J\u202e"}))
    assert_told_in_one_line(load_run("evaluate.py", run), r"is of task 'x\nerror: \x1b[2J\u202e', not 'a1_position'")


def test_checkpoint_of_another_task(run, trained):
    """It is refused by its task's name."""
    state = torch.load(trained["a1_torque"] / "model_1.pt", weights_only=True)
    checkpoint.write(run / "model_1.pt", state)
    before = contents(run.parents[2])
    for script in LOADING:
        assert_told_in_one_line(load_run(script, run), "is of task 'a1_torque', not 'a1_position'")
    assert contents(run.parents[2]) == before


def test_weights_of_a_pretrained_policy(tmp_path, make_task):
    """Names, shapes and numbers are those of the actor, or else it stays as it was; the first one is named."""
    env = make_task("a1_torque_gravity", num_envs=2)
    runner, _ = task_registry.make_alg_runner(env, "a1_torque_gravity", log_root=None)
    before = {name: value.clone() for name, value in runner.alg.actor.state_dict().items()}
    weights = {name: value + 1.0 for name, value in before.items()}
    name = "mlp.0.weight"
    others = {key: value for key, value in weights.items() if key != name}
    bad = [weights[name].T.contiguous(), weights[name] * float("nan"), "0.5"]
    for damaged in (others, *(weights | {name: value} for value in bad), weights | {"other": torch.zeros(3)}):
        checkpoint.write(tmp_path / "policy.pt", {"actor_state_dict": damaged, "spaces": {}, "report": {}})
        told = error_of(start_from, runner, tmp_path / "policy.pt")
        assert "policy.pt' " in told and ("other" if "other" in damaged else name) in told
        after = runner.alg.actor.state_dict()
        assert all(torch.equal(value, after[key]) for key, value in before.items())


def test_folders(tmp_path):
    """What is kept stays below the folder of logs, and an empty name is none."""
    root = tmp_path / "root"
    root.mkdir()
    told = {"--experiment_name=..": "runner.experiment_name must be", "--run_name=..": "runner.run_name must be"}
    for word, message in {**told, "--log_root=": "empty"}.items():
        assert_told_in_one_line(run_here("train.py", *SMALL, word, root=root), message)
    assert os.listdir(tmp_path) == ["root"] and not os.listdir(root)
