"""Files of strangers, made to run code or to do harm: every script refuses them, and what they hold never runs."""

import gzip
import json
import os
import pickle
import shutil
import sys
import zipfile

import pytest
import torch
import yaml
from support.scripts import SMALL, assert_told_in_one_line, contents, run_here
from support.settings import error_of, get_cfgs, parse

from legged_torque import resource_path
from legged_torque.deploy.policy import Policy
from legged_torque.deploy.robot import MujocoRobot
from legged_torque.deploy.simulation import Events, Simulation
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.robots.a1 import A1Cfg, A1CfgPPO
from legged_torque.learning import checkpoint
from legged_torque.learning.pretrained import start_from
from legged_torque.paper.report.evaluations import CURVE_METRICS
from legged_torque.utils.config import parse_yaml, set_by_path
from legged_torque.utils.task_registry import TaskRegistry, task_registry

LOADING = {
    "train.py": ["--resume", "--max_iterations=2", "--logger=none"],
    "play.py": ["--steps=1"],
    "evaluate.py": ["--steps=1"],
    "export.py": [],
    "learning_curve.py": ["--steps=1"],
    "physics_accuracy.py": ["--steps=1"],
}
"""Scripts that load a run, and words that make it short."""
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


@pytest.fixture
def harm(tmp_path, monkeypatch):
    """A file that appears when code of a stranger runs: when ``payload`` is imported or a pickle of it is loaded."""
    file = tmp_path / "harm"
    (tmp_path / "payload.py").write_text(f"open({str(file)!r}, 'w')\n\ndef run(*args, **kwargs):\n    pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield file
    assert not file.exists()
    assert "payload" not in sys.modules


class Payload:
    """An object whose pickle creates a file when it is loaded."""

    def __init__(self, file):
        self.file = file

    def __reduce__(self):
        return open, (str(self.file), "w")


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Run folders of one iteration, by task."""
    root = tmp_path_factory.mktemp("trained")
    for task in ("a1_position", "a1_torque"):
        words = [*SMALL, f"--task={task}", "--max_iterations=1", "--logger=none"]
        status, _, error = run_here("train.py", *words, root=root)
        assert (status, error) == (0, "")
    for first in root.glob("logs/*/*/model_0.pt"):  # nothing to fall back on
        first.unlink()
    return {folder.name: next(folder.iterdir()) for folder in (root / "logs").iterdir()}


@pytest.fixture
def run(trained, tmp_path):
    """A copy of the run of a1_position, in a folder of logs."""
    return shutil.copytree(trained["a1_position"], tmp_path / "root" / "logs" / "a1_position" / "2026-01-01_00-00-00")


def load_run(script, run, *words):
    """Load a run with a script, in the folder of its logs."""
    all_words = ["--task=a1_position", "--device=cpu", "--num_envs=2", *LOADING[script], *words]
    return run_here(script, *all_words, root=run.parents[2])


def edit_config(run, **changes):
    """Change settings of a run's training, given with ``__`` in place of dots."""
    config = yaml.safe_load((run / "config.yaml").read_text())
    for path, value in changes.items():
        *sections, key = path.split("__")
        part = config["train"]
        for section in sections:
            part = part[section]
        part[key] = value
    (run / "config.yaml").write_text(yaml.safe_dump(config))


# ------------------------------------------------------------------------------------------------- names of code


@pytest.mark.parametrize("setting", NAMES)
def test_names_in_a_run(run, harm, setting):
    """A class or function that no registered task names is refused by every script before it is imported."""
    edit_config(run, **{setting.replace(".", "__"): "payload:run"})
    before = contents(run.parents[2])
    for script in LOADING:
        assert_told_in_one_line(load_run(script, run), f"unknown {setting} 'payload:run'")
    assert contents(run.parents[2]) == before


@pytest.mark.parametrize("name", ["OnPolicyRunner", "rsl_rl.runners:OnPolicyRunner", "payload.run", "os:system", 5, ""])
def test_other_names(run, harm, name):
    """Neither is one that rsl_rl or Python has, whatever would be done with it."""
    edit_config(run, runner__class_name=name)
    (run / "model_1.pt").write_bytes(pickle.dumps(Payload(harm)))
    for script in LOADING:
        assert_told_in_one_line(load_run(script, run), "runner.class_name")


def test_names_on_the_command_line(harm):
    """They are refused with the nearest one that is known."""
    for setting in NAMES:
        assert f"unknown {setting} 'payload:run'" in error_of(get_cfgs, f"--set={setting}=payload:run")
    assert "did you mean 'MLPModel'? allowed: MLPModel, " in error_of(get_cfgs, "--set=actor.class_name=MPLModel")
    told = error_of(get_cfgs, "--set=actor.class_name=os:system")
    assert told.endswith("register a task to add one")


def test_names_of_a_users_own_task():
    """What a user's task or one of its presets names is known, for every task, and a mistake in it is told."""

    class Cfg(A1CfgPPO):
        class critic:
            class_name = "RNNModel"

        def presets(self):
            return super().presets() | {"cnn": {"critic": {"class_name": "CNNModel"}}}

    registry = TaskRegistry()
    registry.register("theirs", LeggedRobot, A1Cfg(), A1CfgPPO())
    words = "--set=critic.class_name=RNNModel"
    assert "unknown critic.class_name 'RNNModel'" in error_of(registry.get_cfgs, "theirs", parse(words))
    registry.register("own", LeggedRobot, A1Cfg(), Cfg())
    for task in registry.names():
        for name in ("MLPModel", "RNNModel", "CNNModel"):
            _, cfg = registry.get_cfgs(task, parse(f"--set=critic.class_name={name}"))
            assert cfg.critic.class_name == name
    assert "unknown actor.class_name 'RNNModel'" in error_of(
        registry.get_cfgs, "own", parse("--set=actor.class_name=RNNModel")
    )
    Cfg.critic.class_name = "RNModel"
    registry.register("another", LeggedRobot, A1Cfg(), Cfg())
    assert error_of(registry.get_cfgs, "another", parse()).startswith("critic.class_name: ")


@pytest.mark.parametrize("words", [[], ["--dry-run"]])
@pytest.mark.parametrize("setting", NAMES)
def test_names_in_an_experiment(tmp_path, harm, setting, words):
    """The description of an experiment is refused before anything is started or written, and its listing as well."""
    matrix = {"tasks": ["a1_position"], "environments": {"none": ["none"]}, "seeds": [1]}
    (tmp_path / "theirs.yaml").write_text(yaml.safe_dump(matrix | {"train": {setting: "payload:run"}}))
    before = contents(tmp_path)
    result = run_here("experiment.py", "theirs.yaml", "--device=cpu", *words, root=tmp_path)
    assert_told_in_one_line(result, f"unknown {setting} 'payload:run'")
    assert contents(tmp_path) == before


# ------------------------------------------------------------------------------------------------- files that run code


@pytest.mark.parametrize("script", LOADING)
def test_checkpoint_that_runs_code(run, harm, script):
    """A pickle is not a checkpoint, whether it is one of torch or not."""
    state = torch.load(run / "model_1.pt", weights_only=True) | {"payload": Payload(harm)}
    for save in (torch.save, lambda value, file: file.write_bytes(pickle.dumps(value, protocol=2))):
        save(state, run / "model_1.pt")
        assert_told_in_one_line(load_run(script, run), "model_1.pt' is not a readable checkpoint")


@pytest.mark.parametrize("script", ["train.py", "evaluate.py"])
def test_checkpoint_of_nothing_but_lists(run, script):
    """Lists inside of lists that no function can follow are told as well, and what is no dictionary."""
    with zipfile.ZipFile(run / "model_1.pt") as whole:
        parts = {name: whole.read(name) for name in whole.namelist()}
    depth = 100_000
    for content in (b"\x80\x02" + b"]" * depth + b"a" * (depth - 1) + b".", b"\x80\x02K\x01."):
        with zipfile.ZipFile(run / "model_1.pt", "w") as crafted:
            for name, part in parts.items():
                crafted.writestr(name, content if name.endswith("/data.pkl") else part)
        assert_told_in_one_line(load_run(script, run), "model_1.pt'")


def test_checkpoint_that_runs_code_on_the_page(run, harm):
    """The viewer's page refuses it as well, and is never opened."""
    pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    torch.save({"payload": Payload(harm)}, run / "model_1.pt")
    assert_told_in_one_line(load_run("play.py", run, "--viewer=web"), "is not a readable checkpoint")
    edit_config(run, actor__class_name="payload:run")
    assert_told_in_one_line(load_run("play.py", run, "--viewer=web"), "unknown actor.class_name")


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


TEXTS = {
    "python": ("!!python/object/apply:payload.run []", "is not valid YAML"),
    "deep": ("[" * 1000 + "]" * 1000, "is nested too deeply"),
    "less_deep": ("[" * 60 + "]" * 60, "is nested too deeply"),
    "itself": ("&a [*a]", "is nested too deeply"),
    "huge": (f"a: {'9' * 1000}", "is nested too deeply or larger"),
    "long": ("# " + "x" * 1_000_000, "is nested too deeply or larger than settings are"),
    "many": ("\n".join(["a: &a0 [x]", *(f"b{i}: &a{i + 1} [{f'*a{i}, ' * 9}]" for i in range(12))]), "is nested too"),
}
"""YAML that runs code, or takes all of the memory or the stack, and what is told."""


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
    """Line ends and the codes of terminals are told as codes: an error stays one line."""
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(yaml.safe_dump(yaml.safe_load(text) | {"task": "x\nerror: \x1b[2J\u202e"}))
    assert_told_in_one_line(load_run("evaluate.py", run), r"is of task 'x\nerror: \x1b[2J\u202e', not 'a1_position'")


# ------------------------------------------------------------------------------------------------- results


@pytest.fixture
def results(trained, tmp_path):
    """The folder of an experiment with one cell, whose files are a stranger's."""
    folder = tmp_path / "results"
    matrix = {"tasks": ["a1_position"], "environments": {"none": ["none"]}, "seeds": [1]}
    cell = folder / "a1_position-none-s1"
    shutil.copytree(trained["a1_position"], cell / "2026-01-01_00-00-00")
    (folder / "experiment.yaml").write_text(yaml.safe_dump(matrix))
    row = {"steps": 1} | {metric.name: 0.5 for metric in CURVE_METRICS}
    lines = [",".join(row), *(",".join(map(str, row.values())) for _ in range(2))]
    (cell / "2026-01-01_00-00-00" / "evaluations.csv").write_text("\n".join(lines) + "\n")
    return folder


CONFIGS = [
    {"task": "a1_position", "env": "many", "train": [1]},
    {"task": ["a"], "env": {"env": {"num_envs": "9"}}, "train": {"runner": {"num_steps_per_env": [1]}}},
    {"task": {}, "env": {"env": {"num_envs": 1e300}}, "train": {"seed": {}, "runner": 3}, "max_iterations": "x"},
    {"task": "t", "env": {}, "train": {"actor": {"class_name": "payload:run"}}, "versions": ["payload"]},
]


@pytest.mark.parametrize("number", range(len(CONFIGS)))
def test_report(results, harm, number, tmp_path):
    """A report and a figure read settings of a stranger, and take nothing of them but text and numbers."""
    (run,) = results.glob("*/*/")
    (run / "config.yaml").write_text(yaml.safe_dump(CONFIGS[number]))
    deep = "[" * 2000 + "]" * 2000
    texts = {"deep": deep, "inf": '{"metrics": {}, "steps": Infinity}', "list": '{"metrics": []}', "none": "null"}
    for name, text in texts.items():
        (run.parent / f"result_{name}.json").write_text(text)
    result = run_here("report.py", str(results), "--out=report", root=tmp_path)
    assert result[0] == 0 and result[2] == ""
    assert (tmp_path / "report" / "report.md").read_text().count("cannot be read") == len(texts)
    status, _, error = run_here("plot.py", "curves", str(run / "evaluations.csv"), "--out=curve.png", root=tmp_path)
    assert status in (0, 2) and "Traceback" not in error and error.count("\n") == (status == 2)


def test_experiment_names_other_folders(results, tmp_path):
    """Tasks and environments of an experiment name folders: a path is refused."""
    for matrix in ({"tasks": ["../../other"]}, {"environments": {"a/b": ["none"]}}, {"environments": {"a": ["/b"]}}):
        whole = {"tasks": ["a1_position"], "environments": {"none": ["none"]}, "seeds": [1]} | matrix
        (results / "experiment.yaml").write_text(yaml.safe_dump(whole))
        assert_told_in_one_line(run_here("report.py", str(results), "--out=report", root=tmp_path), "must hold names")


@pytest.mark.parametrize(
    "text",
    [
        "[" * 2000 + "]" * 2000,
        '{"task": "a", "seed": 1, "points": 5}',
        '{"task": "a", "seed": Infinity, "points": [{"steps": 1}]}',
        '{"task": {}, "seed": 1, "points": [{"steps": Infinity}]}',
        '{"task": "a", "seed": [], "points": [[]]}',
        '{"histograms": [], "settings": 1, "rms_error": {}, "standing": {}}',
    ],
)
def test_figures(tmp_path, text):
    """Figures are not drawn of JSON that is not what its script writes."""
    (tmp_path / "theirs.json").write_text(text)
    for figure in ("curves", "pretraining"):
        result = run_here("plot.py", figure, "theirs.json", "--out=figure.png", root=tmp_path)
        assert_told_in_one_line(result, "theirs.json'")
    assert not (tmp_path / "figure.png").exists()


def test_curves_that_are_no_text(tmp_path):
    """A compressed file that is damaged or unpacks to too much, and a field longer than any number, are told."""
    (tmp_path / "a.csv.gz").write_bytes(b"\x1f\x8b\x08\x00" + bytes(6) + b"\xff" * 50)
    (tmp_path / "large.csv.gz").write_bytes(gzip.compress(b"\n" * 60_000_000, 1))
    (tmp_path / "a.csv").write_text("task,steps\n" + "9" * 200_000 + ",1\n")
    for name in ("a.csv.gz", "large.csv.gz", "a.csv"):
        result = run_here("plot.py", "curves", name, "--out=figure.png", root=tmp_path)
        assert_told_in_one_line(result, f"cannot read '{name}'")


# ------------------------------------------------------------------------------------------------- exports


@pytest.fixture(scope="module")
def exported(trained, tmp_path_factory):
    """An exported policy."""
    for package in ("onnx", "onnxruntime", "jsonschema"):
        pytest.importorskip(package, reason=f"{package} is not installed: pip install -e .[export]")
    run, folder = trained["a1_torque"], tmp_path_factory.mktemp("export") / "out"
    words = ["--task=a1_torque", "--device=cpu", f"--load_run={run}", f"--out={folder}"]
    assert run_here("export.py", *words, root=folder.parent)[0] == 0
    return folder


def swap_terms(description):
    """Two terms of the same size change places, so that all sizes fit."""
    terms = description["observations"]["terms"]
    terms[0], terms[1] = terms[1], terms[0]


def reorder_joints(description):
    """The joints from the last to the first, which no size tells."""
    description["joint_order"].reverse()


def set_entry(path, value):
    """A change of one entry by its dotted path."""
    return lambda description: set_by_path(description, path, value)


EXPORTS = {
    "swapped terms": (swap_terms, "was exported with other observations"),
    "swapped joints": (reorder_joints, "was exported with other joint_order"),
    "another scale": (lambda d: d["actions"]["terms"][0].update(scale=5.0), "was exported with other actions"),
    "another pose": (set_entry("nominal_pose.FR_hip_joint", 0.2), "was exported with other nominal_pose"),
    "huge limits": (set_entry("torque_limits.FR_hip_joint", [-1e30, 1e30]), "torque_limits.FR_hip_joint.0"),
    "huge speed": (set_entry("initial_state.joint_velocity", [0.0, 1e30]), "initial_state.joint_velocity.1"),
    "huge whole number": (lambda d: d["commands"].update(lin_vel_x=[0, 10**300]), "commands.lin_vel_x.1"),
    "huger one": (lambda d: d["commands"].update(lin_vel_x=[0, 10**400]), "larger than settings are"),
    "endless steps": (
        lambda d: d["timing"].update(decimation=10**8, control_frequency=1e-6, physics_frequency=100.0),
        "timing.decimation",
    ),
    "no number": (set_entry("episode.length", float("nan")), "episode.length is not a finite number"),
    "another folder": (set_entry("network.file", "../out/policy.onnx"), "must be the name of a file beside it"),
    "a class": (lambda d: d.update(task={"class_name": "payload:run"}), "task"),
}


@pytest.mark.parametrize("name", EXPORTS)
def test_exports(exported, harm, tmp_path, name):
    """What does not belong to the network, or to any robot, is refused by name."""
    change, told = EXPORTS[name]
    folder = shutil.copytree(exported, tmp_path / "out")
    description = yaml.safe_load((folder / "policy.yaml").read_text())
    change(description)
    (folder / "policy.yaml").write_text(yaml.safe_dump(description, sort_keys=False))
    result = run_here("sim2sim.py", str(folder), "--steps=2", "--robots=1", root=tmp_path)
    assert_told_in_one_line(result, told)
    assert result[1] == ""


def test_network_that_runs_code(exported, harm, tmp_path):
    """A pickle in place of the network is no network; the file for TorchScript is not even opened."""
    folder = shutil.copytree(exported, tmp_path / "out")
    torch.save(Payload(harm), folder / "policy.pt")
    words = [str(folder), "--steps=2", "--robots=1"]
    assert run_here("sim2sim.py", *words, root=tmp_path)[0] == 0
    torch.save(Payload(harm), folder / "policy.onnx")
    assert_told_in_one_line(run_here("sim2sim.py", *words, root=tmp_path), "is not a readable network")


def test_metrics_that_are_no_numbers(exported):
    """A simulation in which they become infinite is an error."""
    policy = Policy(exported)
    robot = MujocoRobot(resource_path(policy.description["robot"]["file"]), policy.description)
    simulation = Simulation(policy, robot, Events(push_velocity=1e200, push_probability=1.0))
    assert "the simulation has diverged" in error_of(simulation.run, 3, 1)


# ------------------------------------------------------------------------------------------------- mixed up files


def test_checkpoint_of_another_task(run, trained):
    """It is refused by its task's name; an old one, which names none, is judged by the shapes of its weights."""
    state = torch.load(trained["a1_torque"] / "model_1.pt", weights_only=True)
    checkpoint.write(run / "model_1.pt", state)
    before = contents(run.parents[2])
    for script in LOADING:
        assert_told_in_one_line(load_run(script, run), "is of task 'a1_torque', not 'a1_position'")
    assert contents(run.parents[2]) == before
    del state["infos"]["task_name"]
    checkpoint.write(run / "model_1.pt", state)
    status, _, error = load_run("evaluate.py", run)
    assert (status, error) == (0, "")


@pytest.mark.parametrize("damage", ["empty", "missing", "shape", "nan", "text", "more"])
def test_weights_of_a_pretrained_policy(tmp_path, make_task, damage):
    """Names, shapes and numbers are those of the actor, or else it stays as it was; the first one is named."""
    env = make_task("a1_torque_gravity", num_envs=2)
    runner, _ = task_registry.make_alg_runner(env, "a1_torque_gravity", log_root=None)
    before = {name: value.clone() for name, value in runner.alg.actor.state_dict().items()}
    weights = {name: value + 1.0 for name, value in before.items()}
    name = next(name for name in weights if "mlp" in name and name.endswith("weight"))
    if damage == "empty":
        weights, name = {}, next(iter(name for name in before if not name.startswith("distribution")))
    elif damage == "missing":
        del weights[name]
    elif damage == "more":
        weights["other"], name = torch.zeros(3), "other"
    else:
        value = {"shape": weights[name].T.contiguous(), "nan": weights[name] * float("nan"), "text": "0.5"}[damage]
        weights[name] = value
    checkpoint.write(tmp_path / "policy.pt", {"actor_state_dict": weights, "spaces": {}, "report": {}})
    told = error_of(start_from, runner, tmp_path / "policy.pt")
    assert "policy.pt' " in told and name in told
    after = runner.alg.actor.state_dict()
    assert all(torch.equal(value, after[name]) for name, value in before.items())


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--experiment_name=..", "runner.experiment_name must be a name"),
        ("--experiment_name=.", "runner.experiment_name must be a name"),
        ("--run_name=..", "runner.run_name must be a name"),
        ("--log_root=", "empty"),
    ],
)
def test_folders(tmp_path, words, told):
    """What is kept stays below the folder of logs, and an empty name is none."""
    root = tmp_path / "root"
    root.mkdir()
    assert_told_in_one_line(run_here("train.py", *SMALL, words, root=root), told)
    assert os.listdir(tmp_path) == ["root"] and not os.listdir(root)


def test_figure_named_like_a_folder(tmp_path):
    """A figure is not written beside a folder, under a name that was not given."""
    points = [{"steps": 1} | {metric.name: 0.5 for metric in CURVE_METRICS}]
    (tmp_path / "curve.json").write_text(json.dumps({"task": "a", "seed": 1, "points": points}))
    (tmp_path / "figures").mkdir()
    result = run_here("plot.py", "curves", "curve.json", "--out=figures", root=tmp_path)
    assert_told_in_one_line(result, "cannot write 'figures'")
    assert sorted(os.listdir(tmp_path)) == ["curve.json", "figures"]
