"""Metrics by the value of a random parameter, against sums by hand; pushes that fell a robot, and those that do not."""

import math

import numpy as np
import pytest
import torch
from support.robot_files import changed as changed  # a fixture
from support.robot_files import setting
from support.scripts import SMALL, assert_told_in_one_line, run_here
from support.settings import error_of

from legged_torque.envs import task_registry
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.base.metrics import measure
from legged_torque.envs.base.sweep import NUM_PARTS, REST, WATCHED, PushSweep, Sweep
from legged_torque.sim.randomization import RandomParameter
from legged_torque.utils.config import set_by_path
from legged_torque.utils.errors import UserError
from legged_torque.utils.options import CONTACT, PUSH, draw_only

QUICK = {"domain_rand.resampling_probability": 0.2, "env.episode_length_s": 0.3, "commands.resampling_probability": 0.0}


class Payload(LeggedRobot):
    """A robot with a parameter whose ranges are no settings."""

    def random_parameters(self):
        """Add it."""
        return [*super().random_parameters(), RandomParameter("payload", "body_mass", [2], {"scale": [0.5, 2.0]})]


def swept(name, **settings):
    """Worlds that draw one parameter often."""
    cfg = task_registry.get_cfgs("a1_position")[0]
    cfg.motors.chain = cfg.motors.choices["real"]  # whose voltage is drawn in training
    draw_only(cfg, name)
    for path, value in {"env.num_envs": 12, **QUICK, **settings}.items():
        set_by_path(cfg, path, value)
    torch.manual_seed(1)
    return Payload(cfg)


def shaking(task):
    """A policy that acts at random."""
    rng = torch.Generator().manual_seed(3)
    return lambda obs: 2.0 * torch.randn(task.num_envs, task.num_actions, generator=rng)


@pytest.mark.parametrize(
    ("name", "setting", "ends", "tensor"),
    [
        ("motor_strength", {"domain_rand.motor_strength": {"scale": [0.5, 1.5]}}, (0.5, 1.5), "strength"),
        ("contact_stiffness", {"domain_rand.contact_stiffness": {"set": [500.0, 2500.0]}}, (500.0, 2500.0), "solref"),
        ("action_delay", {"motors.delay.range": [0, 3]}, (0, 4), "delay"),
        ("action_delay", {"motors.delay.range": [0, 15], "motors.delay.unit": "milliseconds"}, (0, 4), "delay"),
    ],
)
def test_parts(name, setting, ends, tensor):
    """Mean speed and number of steps of each part are those of the steps in which worlds had such values."""
    task = swept(name, **setting)
    parameters, others = task.events.parameters, task.cfg.domain_rand.randomize_parameters  # not for a delay
    assert not any(others and np.ptp(parameters.range_of(each)[1:]) for each in parameters.sizes if each != name)
    values = {
        "strength": lambda: task.motors.strength[:, 0],
        "solref": lambda: -task.sim.field("geom_solref", [0])[:, 0, 0],
        "delay": lambda: task.motors.links["delay"].queue.drawn[:, 0].floor(),
    }[tensor]
    parts, seen, before = Sweep(task, name), [], []
    policy = shaking(task)

    def noted(obs):
        before.append(values().numpy().copy())
        return policy(obs)

    def on_step(commands):
        parts.add_step(commands)
        velocity = task.state.planar_velocity()[:, :2].norm(dim=1).numpy()
        seen.append((velocity.copy(), task.reset_buf.numpy().copy()))

    measure(task, noted, 40, on_step)
    drawn, speed, ended = np.array(before), np.array([each[0] for each in seen]), np.array([each[1] for each in seen])
    drawn, speed, ended = drawn[1:], speed[1:], ended[1:]  # the first step is not counted
    edges = np.linspace(*ends, (4 if name == "action_delay" else NUM_PARTS) + 1)
    assert parts.edges == pytest.approx(edges.tolist())
    assert name != "action_delay" or parts.unit == "physics_steps"  # of 5 ms
    assert len(np.unique(drawn)) >= 4 and ended.any()
    member = np.digitize(drawn, edges[1:-1]) if name == "action_delay" else np.digitize(drawn, edges) - 1
    for i, part in enumerate(parts.table()):
        counted = (member == i) & ~ended
        expected = speed[counted].mean() if counted.any() else math.nan
        assert part["metrics"]["speed"]["mean"] == pytest.approx(expected, rel=1e-4, nan_ok=True)


def test_a_parameter_that_is_kept(make_task):
    """It is drawn in its range for a sweep, others are kept as before."""
    cfg = task_registry.get_cfgs("a1_position")[0]
    cfg.domain_rand.randomize_parameters, cfg.domain_rand.keep_fixed = True, ["gravity", "trunk_mass"]
    draw_only(cfg, "gravity")
    assert cfg.domain_rand.keep_fixed == ["trunk_mass"]
    rand = {f"domain_rand.{key}": getattr(cfg.domain_rand, key) for key in ("randomize_parameters", "keep_fixed")}
    edges = Sweep(make_task("a1_position", 2, **rand), "gravity").edges
    assert (edges[0], edges[-1]) == (9.51, 10.11)


def test_both_numbers_of_contacts(changed, make_task):
    """They are drawn together: one beside the file's would be of another format."""
    file = changed(setting(".//geom[@solref]", solref="0.02 1"))
    task = swept("contact_stiffness", **{"asset.file": file})
    stiffness, damping = -task.sim.field("geom_solref")[:, 0].T
    torch.testing.assert_close(damping, 72.0 + (stiffness - 900.0) * 0.08)
    assert Sweep(task, "contact_stiffness").edges[0] == 900.0
    one = make_task("a1_position", 2, **{"domain_rand.randomize_parameters": True, "domain_rand.contact_stiffness": {}})
    assert Sweep(one, "contact_damping").edges[0] == 72.0
    assert error_of(Sweep, one, "contact_stiffness").endswith("that of contact_damping: sweep contact_damping")
    neither = {f"domain_rand.{name}": {} for name in CONTACT}
    fixed = make_task("a1_position", 2, **{"domain_rand.randomize_parameters": True, **neither})
    for name in CONTACT:  # as above, a range of its own is enough
        assert error_of(Sweep, fixed, name).endswith(f": give domain_rand.{name} a range with --set")


def test_links_that_do_not_exist(make_task):
    """They are left to the task, which refuses them in a line."""
    cfg = task_registry.get_cfgs("a1_position")[0]
    cfg.motors.chain = ["delay", "idael"]
    draw_only(cfg, "motor_strength")
    assert "unknown motors.chain 'idael'" in error_of(make_task, "a1_position", 1, **{"motors.chain": cfg.motors.chain})


def test_pushes(make_task):
    """Who lies down after a push has fallen; who was at rest has not; impulses are of the whole robot."""
    task = make_task("a1_position", 32, **{f"domain_rand.{PUSH}": [-8.0, 8.0], "domain_rand.push_robots": False})
    pushes, steps = PushSweep(task), round((REST + WATCHED) / task.dt)
    speeds = []

    def on_step(commands):
        before = task.sim.qvel[:, :2].clone()
        pushes.add_step(commands)
        speeds.append((task.sim.qvel[:, :2] - before).norm(dim=1))

    measure(task, lambda obs: torch.zeros(32, task.num_actions), 2 * steps, on_step)  # PD holds the nominal pose
    pushed = torch.stack(speeds)
    when = pushed.any(dim=1).nonzero()[:, 0].tolist()
    assert when == [round(REST / task.dt), round(REST / task.dt) + steps]
    table, mass = pushes.table(), task.sim.mj_model.body_mass.sum()
    counts = np.histogram(pushed[when].numpy(), np.linspace(0.0, 8.0, NUM_PARTS + 1))[0]
    assert [part["pushes"] for part in table] == counts.tolist() and counts.sum() == 64
    assert table[1]["impulse"] == pytest.approx([1.0 * mass, 2.0 * mass], rel=1e-5)
    assert table[0]["fell"]["mean"] == 0.0 and table[-1]["fell"]["mean"] > 0.5


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("motor_strength", {"domain_rand.motor_strength": {}}, "motor_strength is always 1: give domain_rand."),
        ("action_delay", {}, "action_delay is always 0: give motors.delay.range"),
        ("foot_pos", {}, "foot_pos has 12"),
        ("contact_damping", {}, "contact_damping has no draw of its own, but that of contact_stiffness: sweep"),
    ],
)
def test_what_cannot_be_split(name, settings, message):
    """One value, or numbers for each foot."""
    task = swept(name, **settings)
    with pytest.raises(UserError, match=message):
        Sweep(task, name)


def test_script(tmp_path):
    """Mistakes end with one line and status 2; a table is printed and written."""
    assert run_here("train.py", *SMALL, root=tmp_path)[0] == 0
    few = ["--num_envs=4", "--steps=3", "--device=cpu"]
    for words, message in (
        (["--sweep=trunk_mas"], "trunk_mass"),
        (["--sweep=trunk_mass", "--terrain=all"], "--sweep does not take --terrain"),
        ([f"--sweep={PUSH}", f"--set=domain_rand.{PUSH}=[0,0]"], f"{PUSH} is always 0"),
    ):
        assert_told_in_one_line(run_here("evaluate.py", *few, *words, root=tmp_path), message)
    status, output, errors = run_here("evaluate.py", *few, "--sweep=ground_friction", "--json=out.json", root=tmp_path)
    assert status == 0 and "ground_friction []" in output and " nan" not in output, errors
    assert f" {'-':>18} {'-':>18} {'-':>18}\n" in output  # a part that no world is in
