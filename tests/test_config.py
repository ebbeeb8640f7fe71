"""Settings: the registry, inheritance, overrides, presets, run folders, and small helpers that need no simulator."""

import argparse
import copy
import ctypes.util
import inspect
import os
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml

from legged_torque.envs import task_registry
from legged_torque.envs.a1.a1_config import A1Cfg, A1CfgPPO
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.utils import rendering, runs
from legged_torque.utils.args import Parser, add_task_args, add_train_args, apply_args, resolve_device, run_script
from legged_torque.utils.config import BaseConfig, section_keys, set_by_path, to_dict, update_from_dict
from legged_torque.utils.errors import UserError, unknown_name
from legged_torque.utils.math import quat_from_euler, quat_rotate_inverse
from legged_torque.utils.task_registry import TaskRegistry, num_iterations

TASKS = ["a1_position", "a1_torque", "a1_torque_curriculum", "a1_torque_multihead", "a1_multihead"]


def parse(*words):
    """The namespace that train.py makes of a command line, on the CPU."""
    parser = Parser("test")
    add_task_args(parser)
    add_train_args(parser)
    return parser.parse_args(["--device=cpu", *words])


def get_cfgs(*words, task="a1_position", run_config=None):
    """A task's settings, changed by a command line."""
    args = parse(*words)
    if run_config is not None:
        args.run_config = run_config
    return task_registry.get_cfgs(task, args)


def error_of(function, *args, **kwargs):
    """The line that a mistake is told with."""
    with pytest.raises(UserError) as error:
        function(*args, **kwargs)
    assert "\n" not in str(error.value)
    return str(error.value)


def get(section, path):
    """A setting by its dotted path."""
    for key in path.split("."):
        section = section[key] if isinstance(section, dict) else getattr(section, key)
    return section


# ---- registry and inheritance ----------------------------------------------------------------------------------------


def test_registered_tasks():
    """The five approaches are there, each with settings of its own."""
    assert task_registry.names() == TASKS
    classes = {name: task_registry.get_task_class(name).__name__ for name in TASKS}
    assert classes == {
        "a1_position": "LeggedRobot",
        "a1_torque": "TorqueRobot",
        "a1_torque_curriculum": "TorqueCurriculumRobot",
        "a1_torque_multihead": "MultiHeadRobot",
        "a1_multihead": "MultiHeadRobot",
    }
    for name in TASKS:
        env_cfg, train_cfg = task_registry.get_cfgs(name)
        assert env_cfg.env.num_actions == (24 if name.endswith("multihead") else 12)
        assert train_cfg.runner.experiment_name == name


@pytest.mark.parametrize("name", ["a1_positon", "a1-position", "A1_position"])
@pytest.mark.parametrize("function", ["get_task_class", "get_cfgs", "make_env"])
def test_unknown_task(function, name):
    """The nearest task is proposed and all are listed."""
    line = error_of(getattr(task_registry, function), name)
    assert line.startswith(f"unknown task '{name}'; did you mean 'a1_position'? allowed: ")
    assert line.split("allowed: ")[1].split(", ") == sorted(TASKS)


def test_name_without_a_near_match():
    """Nothing is proposed where nothing is near."""
    assert str(unknown_name("task", "xyz", ["b", "a"])) == "unknown task 'xyz'; allowed: a, b"


def test_settings_are_independent_copies():
    """Changing what the registry hands out changes neither the registry nor the classes."""
    first_env, first_train = task_registry.get_cfgs("a1_torque")
    before = copy.deepcopy((to_dict(first_env), to_dict(first_train)))
    first_env.rewards.scales.torques = 1.0
    first_env.commands.ranges.lin_vel_x[0] = -9.0
    first_env.init_state.default_joint_angles["FR_hip_joint"] = 9.0
    first_env.asset.penalize_contacts_on.append("hip")
    first_train.actor.hidden_dims.append(1)
    first_train.algorithm.gamma = 0.5
    second = task_registry.get_cfgs("a1_torque")
    assert (to_dict(second[0]), to_dict(second[1])) == before
    cfg = A1Cfg()
    cfg.commands.ranges.lin_vel_x[0] = -9.0
    cfg.init_state.default_joint_angles["FR_hip_joint"] = 9.0
    assert A1Cfg.init_state.default_joint_angles["FR_hip_joint"] == -0.1
    assert A1Cfg.commands.ranges.lin_vel_x == [-1.0, 1.0]
    assert A1CfgPPO.actor.hidden_dims == [512, 256, 128]


class VariantCfg(A1Cfg):
    """A variant as a user of legged_gym writes it."""

    class control(A1Cfg.control):
        stiffness = 40.0
        new_gain = 3

    class rewards(A1Cfg.rewards):
        class scales(A1Cfg.rewards.scales):
            torques = -1e-4
            action_rate = 0.0


def flatten(values, path=""):
    """Nested dictionaries as one of dotted paths."""
    result = {}
    for key, value in values.items():
        result |= flatten(value, f"{path}{key}.") if isinstance(value, dict) and value else {f"{path}{key}": value}
    return result


def test_variant_changes_only_its_entries():
    """A class that inherits differs from its parent in what it names, and in nothing else."""
    variant, parent = flatten(to_dict(VariantCfg())), flatten(to_dict(A1Cfg()))
    assert {key: value for key, value in variant.items() if key not in parent or parent[key] != value} == {
        "control.stiffness": 40.0,
        "control.new_gain": 3,
        "rewards.scales.torques": -1e-4,
        "rewards.scales.action_rate": 0.0,
    }
    assert parent.keys() <= variant.keys()
    assert A1Cfg.control.stiffness == 20.0 and not hasattr(A1Cfg.control, "new_gain")


def test_variant_is_built(make_task):
    """A registered variant becomes a task with its settings; a reward scale of 0 is no term."""
    registry = TaskRegistry()
    registry.register("variant", LeggedRobot, VariantCfg(), A1CfgPPO())
    env_cfg, _ = registry.get_cfgs("variant", parse("--num_envs=2"))
    task, cfg = registry.make_env("variant", argparse.Namespace(device="cpu"), env_cfg)
    assert task.cfg is cfg is env_cfg and task.num_envs == 2
    assert "action_rate" not in task.reward_names
    reference = make_task("a1_position", 2)
    assert set(reference.reward_names) == {*task.reward_names, "action_rate"}
    torch.testing.assert_close(
        task._pd_torques(torch.zeros(2, 12)), 40.0 * (task.default_dof_pos - task.dof_pos) - 0.5 * task.dof_vel
    )


def test_reward_scale_without_a_term():
    """A scale that names no term is refused when the task is built."""

    class Cfg(VariantCfg):
        class rewards(VariantCfg.rewards):
            class scales(VariantCfg.rewards.scales):
                torqes = -1.0

    line = error_of(LeggedRobot, Cfg(), "cpu")
    assert line.startswith("unknown reward term 'torqes'; did you mean 'torques'?")


def test_sections_in_order_of_definition():
    """Entries come in the order in which they are written, inherited ones first, methods and private names not."""

    class Base(BaseConfig):
        b = 1
        _hidden = 2

        class a:
            z = 1

        def method(self):
            """Not an entry."""

    class Child(Base):
        c = 3
        b = 4

    assert section_keys(Child()) == ["b", "a", "c"]
    assert to_dict(Child()) == {"b": 4, "a": {"z": 1}, "c": 3}
    assert inspect.isclass(Child.a) and not inspect.isclass(Child().a)


# ---- overrides -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "text", "value"),
    [
        ("rewards.scales.torques", "-1e-4", -1e-4),
        ("rewards.scales.torques", "-2.5E-7", -2.5e-7),
        ("rewards.scales.torques", "-3", -3.0),
        ("rewards.curriculum.tracking_lin_vel.t_end", "1e6", 1_000_000),
        ("env.num_actions", "24", 24),
        ("control.refresh_torques", "false", False),
        ("control.refresh_torques", "True", True),
        ("commands.ranges.lin_vel_x", "[-2, 1e-1]", [-2.0, 0.1]),
        ("asset.penalize_contacts_on", "[calf, 'thigh']", ["calf", "thigh"]),
        ("asset.penalize_contacts_on", "[]", []),
        ("init_state.default_joint_angles.FR_hip_joint", "-0.2", -0.2),
        ("asset.foot_name", "1e3", "1e3"),
        ("actor.hidden_dims", "[64, 32]", [64, 32]),
        ("algorithm.learning_rate", "1e-4", 1e-4),
        ("algorithm.schedule", "fixed", "fixed"),
        ("runner.run_name", "7", "7"),
        ("runner.run_name", "a=b", "a=b"),
        ("seed", "7", 7),
        ("actor.distribution_cfg.init_std", "2", 2.0),
    ],
)
def test_overrides(path, text, value):
    """``--set`` changes the one entry that its path leads to, in the type that the entry has."""
    changed, default = get_cfgs(f"--set={path}={text}"), get_cfgs()
    owner = 0 if path.split(".")[0] in section_keys(changed[0]) else 1
    result = get(changed[owner], path)
    assert result == value and type(result) is type(value)
    if isinstance(value, list):
        assert [type(item) for item in result] == [type(item) for item in value]
    for new, old in zip(changed, default, strict=True):
        new, old = flatten(to_dict(new)), flatten(to_dict(old))
        assert {key for key in old if new.get(key) != old[key]} <= {path} and new.keys() == old.keys()


def test_last_override_wins():
    """Overrides are applied from left to right."""
    assert get_cfgs("--set=seed=1", "--set=env.num_envs=5", "--set=seed=2")[1].seed == 2


@pytest.mark.parametrize(
    ("item", "message"),
    [
        (
            "rewards.scales.torqes=1",
            "key 'rewards.scales.torqes'; did you mean 'rewards.scales.torques'? allowed: rewards",
        ),
        ("rewards.scale.torques=1", "unknown config key 'rewards.scale'; did you mean 'rewards.scales'?"),
        ("reward.scales.torques=1", "unknown config section 'reward'; did you mean 'rewards'?"),
        ("sed=1", "unknown config section 'sed'; did you mean 'seed'?"),
        ("algorithm.learning_rat=1", "did you mean 'algorithm.learning_rate'?"),
        ("init_state.default_joint_angles.FR_hip=0", "did you mean 'init_state.default_joint_angles.FR_hip_joint'?"),
        ("rewards.scales.torques.x=1", "config key 'rewards.scales.torques' is a value, it has no entry 'x'"),
        ("rewards.scales=1", "config key 'rewards.scales' is a section with entries"),
        ("env.num_envs", "--set takes KEY=VALUE, not 'env.num_envs'"),
        ("env.num_envs=2.5", "config key 'env.num_envs' takes a value like 64, not 2.5"),
        ("env.num_envs=many", "config key 'env.num_envs' takes a value like 64, not 'many'"),
        ("env.num_envs=true", "config key 'env.num_envs' takes a value like 64, not True"),
        ("env.num_envs=[4]", "config key 'env.num_envs' takes a value like 64, not [4]"),
        ("control.refresh_torques=1", "config key 'control.refresh_torques' takes a value like True, not 1"),
        ("control.refresh_torques=maybe", "config key 'control.refresh_torques' takes a value like True, not 'maybe'"),
        ("rewards.scales.torques=false", "config key 'rewards.scales.torques' takes a value like -0.0002, not False"),
        ("commands.ranges.lin_vel_x=1", "config key 'commands.ranges.lin_vel_x' takes a value like [-1.0, 1.0], not 1"),
        ("commands.ranges.lin_vel_x=[a, 1]", "'commands.ranges.lin_vel_x[0]' takes a value like -1.0, not 'a'"),
        ("env.num_envs=[4", "the value '[4' is not valid YAML"),
    ],
)
def test_bad_overrides(item, message):
    """One line names the entry, what it takes and what was given."""
    assert message in error_of(get_cfgs, f"--set={item}")


def test_set_by_path():
    """Values that are not text are taken too, and must have the right type."""
    cfg, _ = task_registry.get_cfgs("a1_position")
    set_by_path(cfg, "commands.ranges.lin_vel_x", [0, 2])
    set_by_path(cfg, "rewards.scales", {"torques": -1, "collision": -2.0})
    assert cfg.commands.ranges.lin_vel_x == [0.0, 2.0]
    assert (cfg.rewards.scales.torques, cfg.rewards.scales.collision) == (-1.0, -2.0)
    assert cfg.rewards.scales.base_height == -30.0
    assert "'env.num_envs' takes a value like" in error_of(set_by_path, cfg, "env.num_envs", 2.5)
    assert "did you mean 'rewards.scales.torques'" in error_of(set_by_path, cfg, "rewards.scales", {"torque": 1})


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--max_iterations=0"], "--max_iterations must be at least 1, not 0"),
        (["--max_iterations=-1"], "--max_iterations must be at least 1, not -1"),
        (["--preset=papr"], "unknown preset 'papr'; did you mean 'paper'? allowed: paper, parallel"),
        (["--device=cup"], "unknown device 'cup'; did you mean 'cpu'?"),
        (["--device=cuda:99"], "there is no device 'cuda:99'; available: cpu"),
        (["--num_env=4"], "unknown option '--num_env=4'; did you mean '--num_envs'?"),
        (["--num_envs=x"], "argument --num_envs: invalid int value: 'x'"),
        (["--num_envs"], "argument --num_envs: expected one argument"),
    ],
)
def test_bad_options(words, message):
    """One line names the option and the nearest valid one."""
    assert message in error_of(get_cfgs, *words)


@pytest.mark.parametrize("device", [None, "auto", "cpu"])
def test_devices(device):
    """The CPU is taken where it is asked for, and where there is nothing else."""
    best = "cuda:0" if torch.cuda.is_available() else "cpu"
    assert resolve_device(device) == ("cpu" if device == "cpu" else best)


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [(UserError("a mistake"), 2, "error: a mistake\n"), (KeyboardInterrupt(), 130, "interrupted\n")],
)
def test_status_of_scripts(error, status, line, capsys):
    """A user's mistake ends a script with status 2, Ctrl-C with 130, either with one line."""

    def main():
        raise error

    with pytest.raises(SystemExit) as stop:
        run_script(main)
    assert stop.value.code == status
    assert capsys.readouterr() == ("", line)


# ---- presets and precedence ------------------------------------------------------------------------------------------

TABLE_II = {
    "algorithm.learning_rate": 1e-4,
    "algorithm.gamma": 0.99,
    "algorithm.num_learning_epochs": 5,
    "algorithm.lam": 0.9,
    "algorithm.clip_param": 0.1,
    "algorithm.entropy_coef": 5e-4,
    "algorithm.max_grad_norm": 5.0,
    "algorithm.schedule": "fixed",
    "runner.num_steps_per_env": 2000,
    "runner.total_steps": 110_000_000,
    "actor.distribution_cfg.init_std": 1.0,
}


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("device", ["cpu", "gpu"])
def test_paper_preset_is_table_ii(task, device, monkeypatch):
    """16 worlds of 2000 steps, minibatches of 1000 samples, 110e6 steps, and every other line of the table."""
    args = parse("--preset=paper")
    if device == "gpu":  # where the number of worlds is not that for CPUs
        args.device = "cuda:0"
        monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    env_cfg, train_cfg = task_registry.get_cfgs(task, args)
    assert env_cfg.env.num_envs == 16
    assert {path: get(train_cfg, path) for path in TABLE_II} == TABLE_II
    assert 16 * 2000 / train_cfg.algorithm.num_mini_batches == 1000
    assert num_iterations(SimpleNamespace(num_envs=16), train_cfg) == 3438  # 110e6 / 32000 = 3437.5


@pytest.mark.parametrize("task", TASKS)
def test_parallel_preset_is_the_default(task):
    """Section 7 (c) of the design: 4096 worlds on a GPU, rollouts of 24 steps, an adaptive learning rate."""
    default, named = get_cfgs(task=task), get_cfgs("--preset=parallel", task=task)
    assert [to_dict(cfg) for cfg in default] == [to_dict(cfg) for cfg in named]
    env_cfg, train_cfg = task_registry.get_cfgs(task)
    expected = {
        "runner.num_steps_per_env": 24,
        "algorithm.num_mini_batches": 4,
        "algorithm.learning_rate": 1e-3,
        "algorithm.schedule": "adaptive",
        "algorithm.desired_kl": 0.01,
        "algorithm.lam": 0.95,
        "algorithm.max_grad_norm": 1.0,
        "algorithm.clip_param": 0.2,
        "runner.total_steps": 110_000_000,
    }
    assert env_cfg.env.num_envs == 4096
    assert {path: get(train_cfg, path) for path in expected} == expected


LAYERS = [
    ("--preset=paper", {"env.num_envs": 16, "algorithm.clip_param": 0.1, "seed": 1, "runner.logger": "tensorboard"}),
    ("run", {"env.num_envs": 5, "algorithm.clip_param": 0.3, "seed": 5, "runner.logger": "none"}),
    ("--num_envs=6 --seed=6 --logger=tensorboard", {"env.num_envs": 6, "seed": 6, "runner.logger": "tensorboard"}),
    ("--set=env.num_envs=7 --set=seed=7 --set=algorithm.clip_param=0.7", {"env.num_envs": 7, "seed": 7}),
]


@pytest.mark.parametrize("count", range(len(LAYERS) + 1))
def test_precedence(count):
    """A preset yields to a resumed run's settings, these to options, and options to ``--set``."""
    expected = {"env.num_envs": 64, "algorithm.clip_param": 0.2, "seed": 1, "runner.logger": "tensorboard"}
    words, run_config = [], None
    for text, values in LAYERS[:count]:
        expected |= values
        if text == "run":
            env_cfg, train_cfg = task_registry.get_cfgs("a1_position")
            env_cfg.env.num_envs, train_cfg.seed = 5, 5
            train_cfg.algorithm.clip_param, train_cfg.runner.logger = 0.3, "none"
            run_config = {"env": to_dict(env_cfg), "train": to_dict(train_cfg)}
        else:
            words = [*text.split(), *words]  # the order on the command line does not matter
    if count == len(LAYERS):
        expected["algorithm.clip_param"] = 0.7
    env_cfg, train_cfg = get_cfgs(*words, run_config=run_config)
    found = {path: get(env_cfg if path.startswith("env.") else train_cfg, path) for path in expected}
    assert found == expected


def test_number_of_worlds_suits_the_device(monkeypatch):
    """Without a wish, a GPU simulates thousands of worlds and a CPU as many as it can in seconds."""
    assert get_cfgs()[0].env.num_envs == 64
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    args = parse()
    args.device = "auto"
    assert task_registry.get_cfgs("a1_position", args)[0].env.num_envs == 4096


# ---- run folders -----------------------------------------------------------------------------------------------------


@pytest.fixture
def log_root(tmp_path):
    """Three runs, of which the middle one is the newest with a checkpoint, and things that are no checkpoints."""
    for run, files in {
        "2026-01-01_00-00-00": ["model_2.pt", "model_10.pt", "model_9.pt"],
        "2026-01-02_00-00-00_wide": ["model_3.pt", "model_4.pt.part", "model_best.pt", "policy.pt"],
        "2026-01-03_00-00-00": ["config.yaml", "model_1.pt.part"],
    }.items():
        (tmp_path / run).mkdir()
        for file in files:
            (tmp_path / run / file).touch()
    return tmp_path


@pytest.mark.parametrize(
    ("load_run", "name"),
    [
        (None, "2026-01-02_00-00-00_wide"),
        ("2026-01-01_00-00-00", "2026-01-01_00-00-00"),
        ("{root}/2026-01-03_00-00-00", "2026-01-03_00-00-00"),
    ],
)
def test_find_run(log_root, load_run, name):
    """The newest run that has a checkpoint, one by its name, or one by its path."""
    assert runs.find_run(log_root, load_run and load_run.format(root=log_root)) == log_root / name


def test_find_run_that_does_not_exist(log_root):
    """The nearest run is proposed; an experiment without runs says that there is nothing to load."""
    line = error_of(runs.find_run, log_root, "2026-01-02_00-00-00")
    assert line.startswith("unknown run '2026-01-02_00-00-00'; did you mean '2026-01-0")
    for folder in (log_root / "nothing", log_root / "2026-01-03_00-00-00"):
        assert str(folder) in error_of(runs.find_run, folder, None)


@pytest.mark.parametrize(("number", "name"), [(None, "model_10.pt"), (9, "model_9.pt"), (2, "model_2.pt")])
def test_find_checkpoint(log_root, number, name):
    """The last checkpoint is that of the highest number, not that of the last name."""
    run = log_root / "2026-01-01_00-00-00"
    assert runs.find_checkpoint(run, number) == run / name
    assert runs.checkpoint_numbers(run) == [2, 9, 10]


def test_find_checkpoint_that_does_not_exist(log_root):
    """All checkpoints are listed; half-written and foreign files are none."""
    line = error_of(runs.find_checkpoint, log_root / "2026-01-01_00-00-00", 1)
    assert line.startswith("unknown checkpoint '1'") and line.endswith("allowed: 10, 2, 9")
    assert runs.checkpoint_numbers(log_root / "2026-01-02_00-00-00_wide") == [3]
    empty = log_root / "2026-01-03_00-00-00"
    assert error_of(runs.find_checkpoint, empty, None) == f"there is no checkpoint in '{empty}'"


def test_run_folders_sort_by_time(tmp_path):
    """A new run's folder is named by its time, then by its name, and is not created yet."""
    plain, named = runs.new_run_dir(tmp_path, ""), runs.new_run_dir(tmp_path, "wide")
    assert plain.parent == named.parent == tmp_path and not any(tmp_path.iterdir())
    assert plain.name > "2026-01-01_00-00-00" and len(plain.name) == len("2026-01-01_00-00-00")
    assert named.name.startswith(plain.name[:10]) and named.name.endswith("_wide")


@pytest.mark.parametrize("task", TASKS)
def test_config_file_round_trip(task, tmp_path):
    """What a run has written gives the same settings again, of the same types; versions of all packages are there."""
    words = ["--preset=paper", "--set=rewards.scales.torques=-1e-7", "--set=actor.hidden_dims=[8, 4]", "--run_name=7"]
    env_cfg, train_cfg = get_cfgs(*words, task=task)
    runs.save_config(tmp_path / "run", {"task": task, "env": to_dict(env_cfg), "train": to_dict(train_cfg)})
    config = runs.load_config(tmp_path / "run")
    loaded = get_cfgs(task=task, run_config=config)
    for new, old in zip(loaded, (env_cfg, train_cfg), strict=True):
        new, old = flatten(to_dict(new)), flatten(to_dict(old))
        assert new == old
        assert {key: type(value) for key, value in new.items()} == {key: type(value) for key, value in old.items()}
    assert config["task"] == task
    assert config["versions"]["torch"] == torch.__version__
    assert config["versions"]["numpy"] == np.__version__
    assert {"python", "legged_torque", "mujoco", "mujoco-warp", "warp-lang", "rsl-rl-lib"} <= config["versions"].keys()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("task: [a1", "is not valid YAML"),
        ("task: a1\n\tenv: 3", "is not valid YAML"),
        ("\x00\x01", "is not valid YAML"),
        ("", "lacks the entries task, env and train"),
        ("just words", "lacks the entries task, env and train"),
        ("- task\n- env\n- train", "lacks the entries task, env and train"),
        ("task: a1_position\nenv: {}", "lacks the entries task, env and train"),
        (None, "has no config.yaml"),
    ],
)
def test_broken_config_file(text, message, tmp_path):
    """A file that is missing, not YAML or without the entries is named in one line."""
    if text is not None:
        (tmp_path / "config.yaml").write_text(text)
    line = error_of(runs.load_config, tmp_path)
    assert message in line and str(tmp_path) in line


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"env": {"num_env": 3}}, "unknown config key 'env.num_env'; did you mean 'env.num_envs'?"),
        ({"rewards": {"scales": {"torques": "x"}}}, "config key 'rewards.scales.torques' takes a value like -0.0002"),
        ({"rewards": {"scales": 3}}, "config key 'rewards.scales' is a section with entries"),
        ({"rewards": None}, "config key 'rewards' is a section with entries"),
        ({3: 4}, "unknown config key '3'"),
    ],
)
def test_config_that_does_not_fit(values, message):
    """Entries of a resumed run that do not exist or have another type are refused by name."""
    cfg, _ = task_registry.get_cfgs("a1_position")
    assert message in error_of(update_from_dict, cfg, values)


# ---- small helpers ---------------------------------------------------------------------------------------------------


def rotation_matrices(roll, pitch, yaw):
    """Rotations about the world's x, then y, then z axis."""
    result = []
    for r, p, y in zip(roll, pitch, yaw, strict=True):
        about_x = np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
        about_y = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
        about_z = np.array([[np.cos(y), -np.sin(y), 0], [np.sin(y), np.cos(y), 0], [0, 0, 1]])
        result.append(about_z @ about_y @ about_x)
    return np.array(result)


def quaternion_matrices(quat):
    """Rotation matrices of quaternions (w, x, y, z)."""
    w, x, y, z = quat.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def test_quaternions_from_angles():
    """Roll, pitch and yaw are rotations about the world's axes in this order."""
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, (3, 50))
    quat = quat_from_euler(*torch.tensor(angles)).numpy()
    np.testing.assert_allclose(np.linalg.norm(quat, axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(quaternion_matrices(quat), rotation_matrices(*angles), atol=1e-12)


def test_world_vectors_in_the_body_frame():
    """A vector is turned by the transposed rotation matrix."""
    rng = np.random.default_rng(1)
    quat, vec = rng.normal(size=(50, 4)), rng.normal(size=(50, 3))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    expected = np.einsum("nji,nj->ni", quaternion_matrices(quat), vec)
    turned = quat_rotate_inverse(torch.tensor(quat), torch.tensor(vec))
    np.testing.assert_allclose(turned, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("asked", "installed", "gpu", "chosen"),
    [
        (None, ["EGL", "OSMesa"], True, "egl"),
        (None, ["EGL", "OSMesa"], False, "osmesa"),
        (None, ["EGL"], False, "egl"),
        (None, ["OSMesa"], True, "osmesa"),
        ("egl", ["EGL", "OSMesa"], False, "egl"),
        ("OSMesa", ["EGL", "OSMesa"], True, "osmesa"),
        ("egl", ["OSMesa"], True, None),
        ("osmesa", ["EGL"], False, None),
        (None, [], True, None),
        (None, [], False, None),
    ],
)
def test_choice_of_the_renderer(asked, installed, gpu, chosen, monkeypatch):
    """What the user asks for if it is installed; else EGL on a GPU, Mesa without; else none, and a line says why."""
    monkeypatch.setenv("MUJOCO_GL", asked or "")
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: f"lib{name}.so" if name in installed else None)
    monkeypatch.setattr(rendering, "Path", lambda path: SimpleNamespace(exists=lambda: gpu))
    reason = rendering.choose_offscreen_renderer()
    assert os.environ["MUJOCO_GL"] == (chosen or "disable")
    if chosen:
        assert reason is None
    else:
        assert "is not installed" in reason and "apt-get install libosmesa6" in reason and "\n" not in reason
        assert asked is None or asked in reason


def test_yaml_needs_no_tags(tmp_path):
    """The configuration file is plain YAML that any program reads."""
    env_cfg, train_cfg = get_cfgs("--run_name=x")
    runs.save_config(tmp_path, {"task": "a1_position", "env": to_dict(env_cfg), "train": to_dict(train_cfg)})
    text = (tmp_path / "config.yaml").read_text()
    assert "!!" not in text and yaml.safe_load(text)["train"]["runner"]["run_name"] == "x"


def test_apply_args_needs_only_what_a_script_offers():
    """Scripts without training options, such as play.py, leave training settings alone."""
    env_cfg, train_cfg = task_registry.get_cfgs("a1_position")
    before = to_dict(train_cfg)
    parser = Parser("test")
    add_task_args(parser)
    apply_args(env_cfg, train_cfg, parser.parse_args(["--device=cpu", "--num_envs=3"]))
    assert env_cfg.env.num_envs == 3 and to_dict(train_cfg) == before


def test_runs_of_the_same_second_do_not_share_a_folder(tmp_path):
    """Every run gets a folder of its own, numbered where the name is taken."""
    folders = [runs.claim_run_dir(tmp_path / "logs" / "2026-11-21_10-00-00") for _ in range(3)]
    assert [folder.name for folder in folders] == [f"2026-11-21_10-00-00{end}" for end in ("", "_2", "_3")]
    assert all(folder.is_dir() for folder in folders)


def test_tuples_are_lists():
    """A variant may write its ranges as tuples: they come back from a file as the lists that they are then."""

    class Variant(BaseConfig):
        limits = (-0.5, 1.0)

    cfg = Variant()
    assert cfg.limits == [-0.5, 1.0]
    update_from_dict(cfg, {"limits": [0.0, 2.0]})
    assert cfg.limits == [0.0, 2.0]
