"""Commands beyond uniform ones: robots that stand, ranges that grow, generators of one's own."""

import math
import sys

import pytest
import torch
from support.control import IN_THE_AIR
from support.scripts import run_here
from support.settings import error_of

from legged_torque.envs import A1TorqueCfg, TorqueRobot, task_registry
from legged_torque.envs.base.commands import UniformCommands
from legged_torque.envs.base.crossing import Grounds
from legged_torque.envs.base.evaluation import evaluation_cfg

OFTEN = {**IN_THE_AIR, "commands.resampling_probability": 0.5}
SQUARE = '''
from legged_torque.envs import A1TorqueCfg, A1TorqueCfgPPO, TorqueRobot, task_registry
from legged_torque.envs.base.commands import UniformCommands

class Square(UniformCommands):
    """Forward and sideways in turns, at a speed that is drawn."""

    def draw(self, mask):
        self.values[:, 1:].masked_fill_(mask.unsqueeze(1), 0.0)

    def follow(self):
        self.values[:, :2].copy_(self.values[:, :2].flip(1))

class SquareCfg(A1TorqueCfg):
    class commands:
        def build(self, task):
            return Square(self, task)

task_registry.register("square", TorqueRobot, SquareCfg(), A1TorqueCfgPPO())
'''


def step(task):
    """Make a control step, and return the worlds whose commands were drawn in it."""
    task.step(torch.zeros(task.num_envs, 12))
    return task.command_generator.is_new.clone()


@pytest.mark.parametrize("heading", [False, True])
def test_standing_share(make_task, heading):
    """Of all draws, the share stands until the next draw, even with a heading to turn to; others do not."""
    task = make_task(
        "a1_torque", 2000, **OFTEN, **{"commands.standing_share": 0.3, "commands.heading_command": heading}
    )
    stood = (task.commands == 0).all(dim=1)
    for _ in range(3):
        assert abs(stood.float().mean() - 0.3) < 4 * math.sqrt(0.3 * 0.7 / 2000)
        drawn, before = step(task), stood
        stood = (task.commands == 0).all(dim=1)
        assert torch.equal(stood[~drawn], before[~drawn]) and not torch.equal(stood, before)
        assert ((task.commands[:, :2] == 0).any(dim=1) == stood).all()


def test_small_commands_become_zero(make_task):
    """As in legged_gym, slow v_x and v_y are 0, as often as a disc has area in the square; yaw rates stay."""
    task = make_task("a1_torque", 4000, **{"commands.zero_below": 0.4})
    speed = task.commands[:, :2].norm(dim=1)
    share = math.pi * 0.4**2 / 4.0
    assert speed[speed > 0].min() >= 0.4 and (task.commands[:, 2] != 0).all()
    assert abs((speed == 0).float().mean() - share) < 4 * math.sqrt(share * (1 - share) / 4000)


@pytest.mark.parametrize(("tracking", "shares"), [(0.85, [0.3, 0.4, 0.5]), (0.75, [0.3, 0.3, 0.3])])
def test_ranges_grow(make_task, monkeypatch, tracking, shares):
    """Each episode's length tracked above 0.8 widens ranges by 0.1, also in worlds anew; evaluations take all."""
    ranges = {"lin_vel_x": [-1.0, 2.0], "lin_vel_y": [0.5, 0.8], "ang_vel_yaw": [-3.0, -1.0]}
    changes = {f"commands.ranges.{name}": value for name, value in ranges.items()}
    changes |= {"commands.curriculum": True, "commands.curriculum_start": 0.3, "env.episode_length_s": 0.1}
    task, other, fewer = (make_task("a1_torque", count, **OFTEN, **changes, seed=count) for count in (300, 300, 200))
    monkeypatch.setattr(task, "_reward_tracking_lin_vel", lambda: torch.full((300,), tracking))
    for share in shares:
        task.command_generator.resample(torch.ones(300, dtype=torch.bool))
        low, high = task.commands.min(dim=0).values, task.commands.max(dim=0).values
        edges = torch.tensor([[-1.0, 2.0], [0.0, 0.3], [-2.0, 0.0]]) * share + torch.tensor([[0.0], [0.5], [-1.0]])
        torch.testing.assert_close(torch.stack([low, high], dim=1), edges, atol=0.06, rtol=0)
        assert (low >= edges[:, 0] - 1e-6).all() and (high <= edges[:, 1] + 1e-6).all()
        assert task.curriculum_values()["command_ranges"].item() == pytest.approx(share)
        for _ in range(5):
            step(task)
    state = task.state_dict()
    other.load_world_state_dict(task.world_state_dict())
    fewer.load_state_dict(state)
    assert torch.equal(fewer.command_generator.span, task.command_generator.span)
    fewer.load_state_dict({name: state[name] for name in ("total_steps", "num_diverged")})  # of an older checkpoint
    assert fewer.curriculum_values()["command_ranges"] == task.curriculum_values()["command_ranges"]
    assert other.curriculum_values()["command_ranges"] == task.curriculum_values()["command_ranges"]
    assert not evaluation_cfg(task.cfg, 2).commands.curriculum
    fixed = {"commands.fixed": [0.0, 0.0, 0.0]}
    assert "curriculum has no effect with commands.fixed" in error_of(make_task, "a1_torque", 1, **changes, **fixed)


class Bound(UniformCommands):
    """Binds a tensor to another one, in its own constructor or in a step."""

    def __init__(self, name, settings, task):
        super().__init__(settings, task)
        self.name, self.phase = name, torch.zeros(task.num_envs)
        if name == "is_new":
            self.is_new = torch.zeros(1, dtype=torch.bool)

    def follow(self):
        setattr(self, self.name, getattr(self, self.name).clone())


@pytest.mark.parametrize("name", ["values", "headings", "low", "is_new", "phase", None])
def test_generators_write_in_place(make_task, name):
    """A tensor that the step holds is not bound to another one, and what builds a generator returns one."""

    class Cfg(A1TorqueCfg):
        class commands:
            def build(self, task):
                return name and Bound(name, self, task)

    message = f"write {name} of Bound in place" if name else "commands.build must return UniformCommands"
    assert message in error_of(TorqueRobot, Cfg())


def test_a_generator_of_ones_own(tmp_path, make_task, monkeypatch):
    """One class in a file of one's own trains by its name; what users hold has the last word, trials refuse it."""
    monkeypatch.setattr(task_registry, "_tasks", dict(task_registry._tasks))
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "square_walk.py").write_text(SQUARE)
    words = ["--task_file=square_walk.py", "--task=square", "--device=cpu", "--num_envs=2", "--logger=none"]
    words += ["--set=runner.num_steps_per_env=4", "--max_iterations=1", "--set=algorithm.num_mini_batches=2"]
    assert run_here("train.py", *words, root=tmp_path)[::2] == (0, "")
    task = make_task("square", 500, **OFTEN)
    before = task.commands.clone()
    drawn = step(task)
    assert torch.equal(task.commands[~drawn], before[~drawn][:, [1, 0, 2]])
    assert (task.commands[drawn][:, [0, 2]] == 0).all() and task.commands[drawn, 1].abs().max() > 0.9
    task.command_generator.hold((0.1, 0.2, 0.3))
    step(task)
    torch.testing.assert_close(task.commands, torch.tensor([[0.1, 0.2, 0.3]] * 500))
    assert "not [0.5]" in error_of(task.command_generator.hold, (0.5,))
    grounds = Grounds.of(["flat"], [0.0])
    assert "commands.build" in error_of(grounds.cfg, task_registry.get_cfgs("square")[0], 1)
