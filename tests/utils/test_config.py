"""Settings changed by the command line and which of them wins; nested ones inherit, misspelt ones are refused."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml
from support.settings import TASKS, error_of, get, get_cfgs, parse

from legged_torque.envs import task_registry
from legged_torque.utils.config import BaseConfig, Section, flat, section_keys, to_dict
from legged_torque.utils.task_registry import num_iterations

TABLES = yaml.safe_load(Path(__file__).with_name("config.yaml").read_text("utf-8"))


@pytest.mark.parametrize(("path", "text", "value"), TABLES["overrides"])
def test_overrides(path, text, value):
    """``--set`` changes the one entry that its path leads to, in the type that the entry has."""
    changed, default = get_cfgs(f"--set={path}={text}"), get_cfgs()
    owner = 0 if path.split(".")[0] in section_keys(changed[0]) else 1
    result = get(changed[owner], path)
    assert result == value and type(result) is type(value)
    if isinstance(value, list):
        assert [type(item) for item in result] == [type(item) for item in value]
    for new, old in zip(changed, default, strict=True):
        new, old = flat(to_dict(new)), flat(to_dict(old))
        assert {key for key in old if new.get(key) != old[key]} <= {path} and new.keys() == old.keys()


@pytest.mark.parametrize(("item", "message"), TABLES["mistakes"])
def test_bad_overrides(item, message):
    """One line names the entry, what it takes and what was given."""
    assert message in error_of(get_cfgs, f"--set={item}")


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
    assert {path: get(train_cfg, path) for path in TABLES["Table II"]} == TABLES["Table II"]
    assert 16 * 2000 / train_cfg.algorithm.num_mini_batches == 1000
    assert num_iterations(SimpleNamespace(num_envs=16), train_cfg) == 3438  # 110e6 / 32000 = 3437.5


@pytest.mark.parametrize("task", TASKS)
def test_other_presets(task):
    """The parallel one is the default; the thorough one takes three times the steps, and nothing else."""
    words = ([], ["--preset=parallel"], ["--preset=thorough"])
    default, parallel, thorough = ([to_dict(cfg) for cfg in get_cfgs(*each, task=task)] for each in words)
    assert parallel == default
    default[1]["runner"]["total_steps"] *= 3
    assert thorough == default


def test_precedence():
    """A preset yields to a resumed run's settings, these to options, options to ``--set``, of which the last counts."""
    env_cfg, train_cfg = get_cfgs()
    env_cfg.env.num_envs, train_cfg.seed, train_cfg.algorithm.clip_param = 5, 5, 0.3
    run = {"env": to_dict(env_cfg), "train": to_dict(train_cfg)}
    for words, run_config, expected in (
        (["--preset=paper"], None, (16, 0.1, 1)),
        (["--preset=paper"], run, (5, 0.3, 5)),
        (["--preset=paper", "--num_envs=6"], run, (6, 0.3, 5)),
        (["--set=seed=8", "--set=seed=7", "--preset=paper", "--num_envs=6", "--seed=6"], run, (6, 0.3, 7)),
    ):
        env_cfg, train_cfg = get_cfgs(*words, run_config=run_config)
        assert (env_cfg.env.num_envs, train_cfg.algorithm.clip_param, train_cfg.seed) == expected


def test_misspelt_settings_of_a_training_s_objects(make_task):
    """They are refused where the runner is made."""
    train_cfg = get_cfgs()[1]
    train_cfg.algorithm.learnin_rate = 1e-4
    line = error_of(task_registry.make_alg_runner, make_task("a1_position", 1), train_cfg=train_cfg, log_root=None)
    assert "unknown config key 'algorithm.learnin_rate'; did you mean 'algorithm.learning_rate'?" in line


def test_number_of_worlds_suits_the_device(monkeypatch):
    """Without a wish, a GPU simulates thousands of worlds and a CPU as many as it can in seconds."""
    assert get_cfgs()[0].env.num_envs == 64
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    args = parse()
    args.device = "auto"
    assert task_registry.get_cfgs("a1_position", args)[0].env.num_envs == 4096


class Base(BaseConfig):
    """What all others inherit."""

    class control:
        stiffness = 1.0
        damping = 2.0

        class mixing:
            start = 3.0
            end = 4.0

    class rewards:
        scale = 5.0


class Robot(Base):
    """A robot's settings."""

    class control:
        stiffness = 20.0

        class mixing:
            end = 40.0

    class rewards:
        scale = 6.0


class Approach(Base):
    """An approach's settings, with a section and a setting of its own."""

    class control:
        damping = 9.0

        class ramp(Section):
            time = 0.5

        class mixing:
            start = 30.0

    class rewards:
        scale = 8.0
        temperature: float = 7.0


class Both(Approach, Robot):
    """An approach on a robot."""


class Reverse(Robot, Approach):
    """The same with the robot's settings first."""


def test_sections_of_several_bases_combine():
    """Each base contributes what it says, at every depth; the first base wins, and gives the order of entries."""
    assert to_dict(Both()) == {
        "control": {"stiffness": 20.0, "damping": 9.0, "mixing": {"start": 30.0, "end": 40.0}, "ramp": {"time": 0.5}},
        "rewards": {"scale": 8.0, "temperature": 7.0},
    }
    assert list(to_dict(Both())["control"]) == ["stiffness", "damping", "mixing", "ramp"]
    assert to_dict(Reverse()) == to_dict(Both()) | {"rewards": {"scale": 6.0, "temperature": 7.0}}
    assert to_dict(Approach())["control"]["stiffness"] == to_dict(Base())["control"]["stiffness"] == 1.0


def test_named_bases_change_nothing():
    """legged_gym's explicit way gives the same, also where it names only one of the bases."""

    class Explicit(Approach, Robot):
        class control(Robot.control):
            class mixing(Robot.control.mixing):
                end = 41.0

    class Short(Approach, Robot):
        class control:
            class mixing:
                end = 41.0

    assert to_dict(Explicit()) == to_dict(Short())
    assert Explicit.control.damping == 9.0 and Explicit.control.mixing.start == 30.0


@pytest.mark.parametrize(("text", "told"), TABLES["classes"].items())
def test_misspelt_names_are_refused(text, told):
    """A name that no base has is reported with the nearest one, before anything is built."""
    lines = "\n".join(f" {line}" for line in text.splitlines())
    exec(f"class V(Both):\n{lines}", globals())  # the only way to write a class from a table
    message = error_of(V().check)  # noqa: F821
    assert told in message and "\n" not in message


def test_misspelt_settings_of_objects_are_refused():
    """So are old names, when a task is made of the objects; a link of one's own is none of them."""
    env_cfg, _ = task_registry.get_cfgs("a1_torque")
    env_cfg.motors.own = type(env_cfg.motors.lag)()
    env_cfg.check()
    env_cfg.domain_rand.randomise_parameters, env_cfg.motors.model, env_cfg.motors.own.time = True, "real", 1.0
    said = error_of(task_registry.make_env, "a1_torque", parse(), env_cfg)
    for part in (
        "did you mean 'domain_rand.randomize_parameters'?",
        "'motors.model' is now motors.chain",
        "own.time'",
        "annotate",
    ):
        assert part in said


def test_numbers_of_numpy():
    """They are plain numbers once they are checked, which YAML can write."""
    env_cfg, _ = task_registry.get_cfgs("a1_torque")
    env_cfg.control.torque_scale, env_cfg.init_state.pos = np.float64(5.0), [*np.float64([0.0, 0.0, 0.4])]
    env_cfg.check()
    assert yaml.safe_load(yaml.safe_dump(to_dict(env_cfg)))["init_state"]["pos"] == [0.0, 0.0, 0.4]


def test_reading_old_settings():
    """They are answered with their successors, and what never was is no attribute."""
    env_cfg, _ = task_registry.get_cfgs("a1_torque")
    assert "'control.control_type' is now" in error_of(lambda: env_cfg.control.control_type)
    assert "'rewards.tracking_sigma' is now" in error_of(lambda: env_cfg.rewards.tracking_sigma)
    assert not hasattr(env_cfg.control, "stifness")


class Port(Both):
    """Settings with many mistakes, in sections of both kinds and in a section of a section."""

    class control(Both.control):
        control_type = "P"
        dampin = 1.0

        class mixing(Both.control.mixing):
            strt = 2.0

    class viewer:
        ref_env = 0

    rewards = 3


class PortAgain(Port):
    """A variant of it with one more."""

    class rewards:
        scle = 1.0


def test_all_mistakes_are_told_at_once():
    """Those of bases, of nested classes with and without a base, and legged_gym's names with their successors."""
    message = error_of(task_registry.register, "port", "no:Task", PortAgain(), PortAgain())
    for part in ("control_type", "strt", "viewers", "TorqueRobot", "Port.rewards is a setting", "scle"):
        assert part in message
    assert "did you mean 'damping'?" in message and "'P'" not in message
    assert "port" not in task_registry._tasks
