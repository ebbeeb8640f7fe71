"""Robots, terms, parameters and grounds of a user: refusals by name, and a ground that needs no change of tasks."""

import math

import numpy as np
import pytest
import torch
from support.settings import error_of

from legged_torque.deploy.export import unknown_parts
from legged_torque.envs.base.asset import nominal_pose
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.base.observations import ObservationTerm
from legged_torque.envs.robots.a1 import A1Cfg
from legged_torque.motors.config import by_joint
from legged_torque.sim.randomization import RandomParameter
from legged_torque.terrain.height_map import HeightMap
from legged_torque.terrain.rough import TERRAINS, RoughGround
from legged_torque.terrain.terrain import Terrain
from legged_torque.utils.mirroring import SCALAR
from legged_torque.viewer.drawing import Drawing

LEGS = ("FR", "FL", "RR", "RL")


def test_gains_by_joint():
    """Numbers go by a part of the joints' names; joints without one and names without a joint are refused."""
    names = [f"{leg}_{part}_joint" for leg in LEGS for part in ("hip", "calf")]
    assert by_joint("gains", 3.0, names) == [3.0] * 8
    assert by_joint("gains", {"hip": 1.0, "calf": 2.0}, names) == [1.0, 2.0] * 4
    assert by_joint("gains", {"FR_hip": 5.0, "hip": 1.0, "calf": 2.0}, names)[:3] == [5.0, 2.0, 1.0]
    assert "gains lacks the joint 'FR_calf_joint'" in error_of(by_joint, "gains", {"hip": 1.0}, names)
    unused = {"hip": 1.0, "FR_hip": 5.0, "calf": 2.0}
    assert "'FR_hip' in gains has no effect" in error_of(by_joint, "gains", unused, names)
    assert "did you mean" in error_of(by_joint, "gains", {"FR_hipp_joint": 1.0}, names)


def test_order_of_the_pose():
    """A pose's order is that of all vectors of joints; one that the file's limbs cannot be put in is refused."""
    assert nominal_pose({"a": 1.0, "b": 2.0}, ["a", "b"]) == [1.0, 2.0]
    message = error_of(nominal_pose, {"b": 2.0, "a": 1.0}, ["a", "b"])
    assert "cannot be put in the order of init_state.default_joint_angles" in message and message.endswith(": a, b")


def test_robot_without_mirrored_legs(make_task):
    """It can be simulated, but neither learns from mirror images nor has terms on pairs of legs."""
    settings = {"asset.mirrored_legs": []}
    assert "rewards.scales.symmetry needs asset.mirrored_legs" in error_of(make_task, "a1_torque", 1, **settings)
    swing = {**settings, "rewards.scales.symmetry": 0.0, "rewards.scales.single_stance": 0.5}
    assert "rewards.scales.single_stance needs asset.mirrored_legs" in error_of(make_task, "a1_torque", 1, **swing)
    task = make_task("a1_torque", 1, **settings, **{"rewards.scales.symmetry": 0.0})
    task.step(torch.zeros(1, 12))
    assert "'FR_hip_joint' has no counterpart" in error_of(lambda: task.mirror)


@pytest.mark.parametrize(
    ("term", "message"),
    [
        (("command", (2, 3), SCALAR), "two observation terms are called 'command'"),
        (("phase", (2, 2), SCALAR), "observation 'phase' has 2 values, 2 scales and 1 in its mirror image"),
        (("phase", (2, 2), None, [1, 2, 3]), "observation 'phase' has 2 values, 3 scales and 2 in its mirror image"),
        (("phase", (2,), SCALAR), "observation 'phase' has the shape (2,), not (2, size)"),
        (("phase", (1, 2), None), "observation 'phase' has the shape (1, 2), not (2, size)"),
        (("image", (2, 2, 2), None), "observation 'image' has the shape (2, 2, 2), not (2, size)"),
        (("own", (2, 2, 2), SCALAR), "observation 'own' has 4 values, 4 scales and 1 in its mirror image"),
        (("own", (2,), None), "observation 'own' has the shape (2,), not (2, ...)"),
        (("phase", None, None), "observation 'phase' must be a tensor, not None"),
        (
            ("late", (2, 1), None),
            "the sensed observation 'late' must be float32 (2, 1) on cpu, not float32 (2,)",
        ),
    ],
)
def test_observation_terms_that_do_not_fit(term, message):
    """A name twice, other shapes and another number of scales or mirrored values are refused, also of "own" groups."""
    name, shape, *rest = term
    more = {"own": {"group": "group"}, "late": {"sensed": lambda: torch.zeros(2)}}.get(name, {})

    class Robot(LeggedRobot):
        def observation_terms(self):
            own = ObservationTerm(name, lambda: shape and torch.zeros(shape), *rest, **more)
            return [*super().observation_terms(), own]

    cfg = A1Cfg()
    cfg.env.num_envs = 2
    assert error_of(Robot, cfg).startswith(message)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"value": torch.ones(2, 1)}, "value must be a function, as lambda: ..., not Tensor"),
        ({"scale": math.nan}, "scale must be finite"),
        ({"scale": ["a"]}, "scale must be a number, not ['a']"),
        ({"noise": [0.1, 0.2]}, "noise must be a number, not [0.1, 0.2]"),
        ({"noise": -0.1}, "noise must be at least 0, not -0.1"),
    ],
)
def test_numbers_of_observation_terms(changes, message):
    """Scales and noise that are none are refused by name; numbers of numpy and torch are numbers."""
    settings = {"value": lambda: torch.ones(2, 1), "mirror": SCALAR}
    assert message in error_of(lambda: ObservationTerm("mine", **settings | changes))
    scales = [ObservationTerm("mine", **settings, scale=scale).scale for scale in (torch.tensor(2.0), np.ones(1))]
    assert scales == [2.0, [1.0]]


@pytest.mark.parametrize("hook", ["observation_terms", "action_terms"])
def test_no_terms(hook):
    """A policy that sees or does nothing is refused."""
    cfg = A1Cfg()
    cfg.env.num_envs = 2
    assert f"{hook}() must return" in error_of(type("Robot", (LeggedRobot,), {hook: lambda self: []}), cfg)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda task: RandomParameter("mass", task.sim.field("body_mass"), [2], {}),
            "'mass' is the model's 'body_mass'",
        ),
        (lambda task: RandomParameter("own", torch.ones(2, 2), [0, 1], {}, mirror=SCALAR), "'own' must have 2 numbers"),
        (lambda task: RandomParameter("gain", task.p_gains, [0], {}), "'stiffness' and 'gain' write the same number"),
        (
            lambda task: RandomParameter("calf_mass", "body_mass", [4], {"add": [-0.5, 0.5]}),
            "'calf_mass' can be -0.274 with the ranges given; it must be at least 0.01",
        ),
        (
            lambda task: RandomParameter("calf_spin", "body_inertia", [12], {"scale": [0.0, 1.0]}),
            "'calf_spin' can be 0 with the ranges given; it must be greater than 0",
        ),
        (lambda task: RandomParameter("gravity", task.p_gains, [0], {}), "two random parameters are called 'gravity'"),
        (lambda task: RandomParameter("thigh_mass", "body_mass", [3, 6], {"scale": [0.5, 0.9]}), "'thigh_mass'"),
        (
            lambda task: RandomParameter("sway", "dof_damping", [6, 0], {"add": [0.0, 1.0]}),
            "does not read 'dof_damping' of the trunk's free joint",
        ),
        (lambda task: RandomParameter("mass", "body_mas", [2], {}), "did you mean 'body_mass'?"),
        *(
            (
                lambda task, columns=columns, field=field: RandomParameter("mass", field or task.p_gains, columns, {}),
                f"'mass' must be different numbers from 0 to {last}, one or more, not {columns}",
            )
            for columns in ([], [-1], [0, 0], [99], [1.5])
            for field, last in (("body_mass", 13), (None, 11))
        ),
        (
            lambda task: RandomParameter("gain", task.p_gains, [0], {}, add_unit=[1.0, 2.0]),
            "add_unit of random parameter 'gain' must be one number or 1, one per column, not [1.0, 2.0]",
        ),
    ],
)
def test_parameters_that_do_not_fit(make, message):
    """One that changes the model unseen, has a name twice, no such numbers, or a mirror image that does not fit."""

    class Robot(LeggedRobot):
        def random_parameters(self):
            return [*super().random_parameters(), make(self)]

    cfg = A1Cfg()
    cfg.env.num_envs, cfg.domain_rand.randomize_parameters = 2, True
    assert message in error_of(lambda: Robot(cfg).mirror)
    if "columns" in message or "did you mean" in message:  # whether or not anything is drawn
        cfg.domain_rand.randomize_parameters = False
        assert message in error_of(Robot, cfg)


class Raised(Terrain):
    """Ground that is 0.1 m higher for the task than in the physics."""

    def height_above(self, points):
        """Return the height above it."""
        return points[..., 2] - 0.1

    def move_to_origin(self, mask, base_pos):
        """Start one metre to the side."""
        base_pos[:, 1] += mask.float()


def test_a_ground_comes_without_touching_tasks(make_task, monkeypatch):
    """Heights in rewards and observations are those above it, and episodes start where it says."""
    monkeypatch.setitem(TERRAINS, "raised", Raised)
    task = make_task("a1_torque", 4, **{"terrain.mesh_type": "raised"})
    torch.testing.assert_close(task.base_height, task.base_pos[:, 2] - 0.1)
    torch.testing.assert_close(task._reward_base_height(), (task.base_pos[:, 2] - 0.403).square())
    torch.testing.assert_close(task.get_observations()["critic"][:, 48], task.base_pos[:, 2] - 0.1)
    assert (task.base_pos[:, 1] == 1.0).all()


class Hills(Terrain):
    """Ground with a map of its own, but without tiles."""

    def __init__(self, settings, num_envs, device):
        self.map = HeightMap(np.zeros((41, 41), np.float32), 0.5, (-10.0, -10.0), device)


def test_a_ground_without_tiles(make_task, monkeypatch):
    """It is drawn as a plane, and exports say that they lack it."""
    monkeypatch.setitem(TERRAINS, "hills", Hills)
    task = make_task("a1_torque", 1, **{"terrain.mesh_type": "hills"})
    assert Drawing.of_task(task).ground is None
    assert unknown_parts(task, {"actions": {"terms": []}}) == ["the ground Hills is not described"]


def test_a_ground_of_other_tiles(make_task, monkeypatch):
    """Exports do not describe a kind of rough ground by the settings of ours."""
    monkeypatch.setitem(TERRAINS, "heightfield", type("Rougher", (RoughGround,), {}))
    task = make_task("a1_rough_position", 1)
    assert unknown_parts(task, {"actions": {"terms": []}}) == ["the ground Rougher is not described"]


@pytest.mark.parametrize(
    ("setting", "value", "nearest"), [("motors.chain", ["idael"], "ideal"), ("terrain.mesh_type", "plan", "plane")]
)
def test_unknown_rooms(make_task, setting, value, nearest):
    """A name that does not exist is refused with the nearest one."""
    line = error_of(make_task, "a1_torque", 1, **{setting: value})
    given = value if isinstance(value, str) else value[0]
    assert f"unknown {setting} '{given}'; did you mean '{nearest}'?" in line
