"""The accuracy of the default settings, in states of every kind, against converged plain MuJoCo."""

import math

import mujoco
import numpy as np
import pytest
import torch
from support.fused import compiled, make_a1
from support.scripts import SMALL, run_here

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.sim.registry import ENGINES, make_engine
from tools.accuracy import KINDS, copy_state, make_states, measure_accuracy, open_motors, reference_step

WORLDS = 120
SETTINGS = (LeggedRobotCfg.sim.solver_iterations, LeggedRobotCfg.sim.ls_iterations)


@pytest.fixture(scope="module")
def start():
    """A robot with open motors, a simulator, and states of robots that tread on the spot."""
    model = open_motors(compiled(make_a1()))
    model.opt.tolerance = 1e-8  # MuJoCo's default
    sim, home = make_engine("fused", model, WORLDS, "cpu", *SETTINGS), torch.tensor(model.key_qpos[0])
    sim.qpos.copy_(home)
    phases = torch.linspace(0.0, 6.0, WORLDS)[:, None] + torch.tensor([0.0, 3.1, 3.1, 0.0]).repeat_interleave(3)
    for step in range(60):
        treading = torch.tensor([0.0, 0.15, -0.3]).repeat(4) * torch.sin(0.1 * step + phases).clamp(min=0.0)
        sim.ctrl.copy_(60.0 * (home[7:] + treading - sim.qpos[:, 7:]) - 1.5 * sim.qvel[:, 6:])
        if step < 59:
            sim.step()
    return model, sim, copy_state(sim)


@pytest.mark.parametrize("kind", KINDS)
def test_no_kind_of_state_is_wrong(start, kind):
    """In every kind of state the velocities after one step are right to 1e-3."""
    model, sim, states = start
    made = make_states(kind, model, states, WORLDS, seed=0)
    if kind != "walking":
        assert not all(torch.allclose(made[name], states[name].float()) for name in made)
    accuracy = measure_accuracy(sim, made, *reference_step(model, made))
    assert accuracy.wrong == 0.0 and accuracy.left_out < 0.02 and accuracy.median < 3e-5
    assert accuracy.max < 1e-3 and accuracy.rms <= accuracy.p999 <= accuracy.max


@pytest.mark.parametrize(("friction", "impratio"), [(1.0, 100.0), (0.35, 1000.0)])
def test_slopes_do_not_creep(friction, impratio):
    """On a slope of 15 degrees a standing robot's feet move as far in 10 s as in plain MuJoCo, to 0.1 mm."""
    model = compiled(make_a1())
    slope = math.radians(15.0)
    model.opt.gravity[:] = 9.81 * math.sin(slope), 0.0, -9.81 * math.cos(slope)
    model.geom_friction[:, 0], model.opt.impratio = friction, impratio
    home = model.key_qpos[0].copy()
    feet = [i for i in range(model.ngeom) if model.geom(i).name.endswith("foot")]
    data, other = mujoco.MjData(model), mujoco.MjData(model)
    sim = make_engine("fused", model, 1, "cpu", *SETTINGS)
    data.qpos[:] = home
    sim.qpos[0] = torch.tensor(home)
    places: list = []
    for step in range(2400):
        if step in (400, 2399):
            other.qpos[:] = sim.qpos[0]
            mujoco.mj_kinematics(model, other)
            places.append([each.geom_xpos[feet] for each in (data, other)])
        data.ctrl[:] = 100.0 * (home[7:] - data.qpos[7:]) - 2.0 * data.qvel[6:]
        sim.ctrl.copy_(100.0 * (torch.tensor(home[7:]) - sim.qpos[:, 7:]) - 2.0 * sim.qvel[:, 6:])
        mujoco.mj_step(model, data)
        sim.step()
    creep = np.linalg.norm(np.subtract(*places), axis=2).mean(axis=1)
    assert abs(creep[1] - creep[0]) < 1e-4 and creep[0] < 5e-3


def test_script(tmp_path):
    """The script names the machine and has a row per kind of state and engine; mistakes are refused in a line."""
    assert run_here("train.py", *SMALL, root=tmp_path)[0] == 0
    words = ("--task=a1_position", "--device=cpu", "--num_envs=2", "--steps=3", "--worlds=4")
    status, output, _ = run_here("../tools/accuracy.py", *words, root=tmp_path)
    lines = output.splitlines()
    rows = [line.split("|")[:2] for line in lines if " | " in line][1:]
    assert status == 0 and any(line.startswith("a1_position on CPU") for line in lines)
    assert [[cell.strip() for cell in row] for row in rows] == [[kind, engine] for kind in KINDS for engine in ENGINES]
    assert run_here("../tools/accuracy.py", *words, "--steps=0", root=tmp_path)[0] == 2
