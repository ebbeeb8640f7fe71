"""Task classes as people bring them from legged_gym: what nothing would call or see is refused, the rest works."""

import operator
import re
from pathlib import Path

import pytest
import torch
import yaml
from support.control import IN_THE_AIR
from support.settings import error_of, get_cfgs

from legged_torque.envs import A1Cfg, A1CfgPPO, A1TorqueCfg, LeggedRobot, TorqueRobot
from legged_torque.utils.config import section_keys, successors
from legged_torque.utils.errors import UserError

IDLE = yaml.safe_load(Path(__file__).with_name("hooks.yaml").read_text("utf-8"))["idle"]


def small(**settings):
    """Settings of two robots high above the ground."""
    cfg = A1TorqueCfg()
    cfg.env.num_envs, cfg.init_state.pos = 2, IN_THE_AIR["init_state.pos"]
    for name, value in settings.items():
        setattr(cfg.env, name, value)
    return cfg


def has(owner, path):
    """Whether a dotted path leads to something."""
    try:
        operator.attrgetter(path)(owner)
    except (AttributeError, UserError):
        return False
    return True


def robot(**methods):
    """A task class with further methods."""
    return type("Port", (TorqueRobot,), methods)


def test_methods_that_nothing_calls():
    """All of them are named at once, each with what replaces it or with the nearest hook."""
    message = error_of(robot(**dict.fromkeys(IDLE, lambda self, *arguments: None)), small())
    problems = message.split("; ")
    for name, successor in IDLE.items():
        assert any(name in problem for problem in problems) and successor in message, name


def test_methods_of_ones_own():
    """Helpers, terms with a setting, and hooks that exist are not disturbed; the callback runs at every step."""

    class Counting(TorqueRobot):
        def _init_buffers(self):
            super()._init_buffers()
            self.count = torch.zeros(self.num_envs)

        def _post_physics_step_callback(self):
            self.count += 1

        def _reward_alive(self):
            return self.count

        @property
        def swing_height(self):
            return [scale * self._reward_swing() for scale in self.action_term()]

        def action_term(self):
            return [1.0]

        def _reward_swing(self):
            return self.count

    task = Counting(small())
    for step in range(1, 4):
        task.try_step()  # leaves no trace
        task.step(torch.zeros(2, 12))
        assert task._reward_alive().tolist() == task.swing_height[0].tolist() == [step, step]


def test_a_misspelt_hook_that_only_calls_itself():
    """Asking a base class for its own name makes it no helper."""
    line = error_of(robot(action_term=lambda self: self.action_term()), small())
    assert "Port.action_term is never called; did you mean 'action_terms'?" in line


@pytest.mark.parametrize("value", [None, 1.0, torch.tensor(1.0), torch.ones(2, 1)])
def test_rewards_that_are_not_one_number_for_each_world(value):
    """They are refused by name."""
    line = error_of(robot(_reward_torques=lambda self: value)(small()).try_step)
    assert line.startswith("reward term 'torques' must be ") and "(2,)" in line


@pytest.mark.parametrize("name", ["reset_buf", "commands", "obs_buf", "rew_buf", "count"])
def test_tensors_stay(name):
    """A tensor that a step shares cannot be replaced by another one, as legged_gym's code does; writing it works."""
    bind = robot(
        _init_buffers=lambda self: setattr(self, "count", torch.zeros(2)) or TorqueRobot._init_buffers(self),
        check_termination=lambda self: setattr(self, name, getattr(self, name).clone()),
    )
    task = bind(small())
    message = error_of(task.step, torch.zeros(2, 12))
    assert name in message and "in place" in message
    task.reset_buf |= True
    assert task.state.reset_buf.all()


def test_buffers_of_ones_own():
    """legged_gym's place for them is too early for some tensors, and a line says which is not."""

    def init_buffers(self):
        LeggedRobot._init_buffers(self)
        self.last_torques = torch.zeros_like(self.torques)

    assert "'torques' does not exist yet: tensors of your own belong behind super().__init__()" in error_of(
        robot(_init_buffers=init_buffers), small()
    )


def test_hooks_between_steps():
    """What only an iteration would call, or an overridden step, is tried as well."""
    values = robot(curriculum_values=lambda self: {"level": 0.5})
    assert "'level' of curriculum_values() must be a tensor" in error_of(values(small()).try_step)

    def step(self, actions):
        self.actions = torch.clip(actions, -1.0, 1.0)
        return LeggedRobot.step(self, self.actions)

    assert "in place" in error_of(robot(step=step)(small()).try_step)
    bind = robot(update_curriculum=lambda self: setattr(self, "p_gains", 2.0 * self.p_gains))
    assert "in place" in error_of(bind(small()).try_step)


def test_successors_exist():
    """Settings and methods that replace old names are there, and the old names are not."""
    task, owners = LeggedRobot(small()), (A1Cfg(), A1CfgPPO())
    text = " ".join(text for kind in ("settings", "methods", "attributes") for text in successors(kind).values())
    places = "|".join(name for owner in owners for name in section_keys(owner))
    paths = set(re.findall(rf"\b((?:{places})(?:\.[a-z_]*[a-z])+)\b", text))
    assert len(paths) > 40
    for path in paths:
        assert any(has(owner, path) for owner in (*owners, task)), path
    for name in re.findall(r"\b(?!draw|build)([a-z_]+)\(\)", text):
        assert callable(getattr(task, name)), name
    for name in successors("attributes"):
        assert name in error_of(getattr, task, name)
    old = [path for path in successors("settings") if any(has(owner, path) for owner in owners)]
    assert old == ["terrain.terrain_proportions"]  # a list there, a section here


def test_old_names_on_the_command_line():
    """They are answered with their successors, sections included."""
    successors = {"commands.resampling_time": "resampling_probability", "viewer.pos": "cameras"}
    for path, successor in (successors | {"domain_rand.trunk_mass_offset": "domain_rand.trunk_mass"}).items():
        assert successor in error_of(get_cfgs, f"--set={path}=1")
