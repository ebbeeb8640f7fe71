"""Parts of a control step that a GPU compiles do the same, once, and stop no term of a user; so do several cores."""

import math
import threading

import pytest
import torch
from support.settings import error_of

from legged_torque.envs.approaches.torque import TorqueRobot
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.envs.tasks import A1TorqueCfg
from legged_torque.sim import compiled as module
from legged_torque.sim.parallel import MIN_WORLDS
from legged_torque.sim.randomization import Randomization, RandomParameter
from legged_torque.utils.progress import TORCH_COMPILES

SETTINGS = {"domain_rand.randomize_parameters": True, "domain_rand.push_robots": True, "noise.add_noise": True}
SETTINGS |= {"domain_rand.push_probability": 0.2, "domain_rand.resampling_probability": 0.2}
HISTORY = {"env.history_length": 3, "motors.delay.range": [1, 6], "sensing.delay.range": [0, 6]}


@pytest.fixture
def graphs(monkeypatch):
    """Compilation as on a GPU, but into the operations that it was traced to: the graphs made, to be counted."""
    made = []

    def backend(graph, inputs):
        assert TORCH_COMPILES.is_set()
        made.append(graph)
        return graph.forward

    torch._dynamo.reset()
    monkeypatch.setattr(module, "SETTINGS", {"backend": backend, "fullgraph": True, "dynamic": False})
    monkeypatch.setattr(module, "can_compile", lambda device: True)
    return made


def compiled_task(task):
    """The task, which compiles as it would on a GPU."""
    task.compile()
    return task


def results(task, num=5):
    """What steps under the same actions give, with a world that diverges and one whose episode ends."""
    torch.manual_seed(3)
    rows = []
    for i in range(num):
        if i == 2:
            task.sim.qvel[1, 7] = math.nan
            task.episode_length_buf[2] = task.max_episode_length - 1
        obs, rewards, dones, extras = task.step(torch.randn(task.num_envs, task.num_actions))
        counted = (task.rewards.terms, task.episode_sums, task.episode_return, task.num_diverged)
        state = (task.base_lin_vel, task.feet_air_time, task.actions, task.last_actions, task.last_dof_vel)
        ends = (dones, extras["time_outs"], task.episode_length_buf, task.total_steps)
        rows.append([value.clone() for value in (obs["policy"], obs["critic"], rewards, *counted, *state, *ends)])
    logged = task.log.read(1.0)
    rows.append([torch.tensor([logged[name] for name in sorted(logged)])])
    return rows


def test_a_compiled_step_is_the_same(make_task, graphs, capsys):
    """All parts are compiled, and give the same bits, also in worlds that end, next to one that diverges."""
    expected, task = (make_task("a1_torque_curriculum", 5, **SETTINGS, **HISTORY) for _ in range(2))
    expected, found = results(expected), results(compiled_task(task))
    assert graphs and "uncompiled" not in capsys.readouterr().err
    assert expected[2][-4][1] and expected[2][-4][2] and not expected[2][-4][0]
    for values, others in zip(found, expected, strict=True):
        assert all(torch.equal(*pair) for pair in zip(values, others, strict=True))


def test_compiled_once(make_task, graphs):
    """One compilation serves steps in every mode of autograd, and resets between them."""
    task = compiled_task(make_task("a1_torque", 3))
    actions = torch.zeros(3, 12)
    task.step(actions)
    made = len(graphs)
    with torch.inference_mode():
        task.step(actions)
    with torch.no_grad():
        task.step(actions)
    task.reset()
    task.step(actions)
    assert len(graphs) == made > 0 and not task.rew_buf.is_inference() and not TORCH_COMPILES.is_set()


class RoughRobot(TorqueRobot):
    """A robot with a reward that only the host can compute."""

    def _reward_rough(self):
        """Its own file, printed. Shape: (num_envs,)."""
        print("rough")
        return torch.full((self.num_envs,), 2.0) + self.contacts.sum(dim=1)


class RoughCfg(A1TorqueCfg):
    """Its settings."""

    class rewards:
        only_positive_rewards = False

        class scales:
            rough: float = 1.0


def make_rough(num_envs=3, kind=RoughRobot):
    """Build it."""
    cfg: LeggedRobotCfg = RoughCfg()
    cfg.env.num_envs = num_envs
    torch.manual_seed(1)
    return kind(cfg)


def test_what_cannot_be_compiled_runs_as_it_is(graphs, capsys):
    """The step is the same, nothing is counted twice, and one line names the term; the other parts are compiled."""
    expected, task = results(make_rough()), compiled_task(make_rough())
    capsys.readouterr()
    found = results(task)
    output, error = capsys.readouterr()
    assert output == "rough\n" * 5 and graphs
    assert error.count("\n") == 1 and "runs uncompiled" in error and "_reward_rough" in error
    for values, others in zip(found, expected, strict=True):
        assert all(torch.equal(*pair) for pair in zip(values, others, strict=True))


class WrongRobot(RoughRobot):
    """A robot that rewards a tensor of its own."""

    def compute_reward(self):
        """Bind the rewards of terms."""
        self.rew_buf = self.rewards.compute(self.total_steps)


def test_mistakes_of_a_user_stay_theirs(graphs, capsys):
    """What a step may not do is named, with and without compilation."""
    task = make_rough(kind=WrongRobot)
    line = error_of(task.step, torch.zeros(3, 12))
    assert line.startswith("write rew_buf of WrongRobot in place")
    assert error_of(compiled_task(task).step, torch.zeros(3, 12)) == line
    assert "runs uncompiled" in capsys.readouterr().err


def test_draws_of_a_step_are_independent(make_task):
    """Commands, pushed initial states and parameters of the same worlds have nothing to do with each other."""
    settings = {f"domain_rand.{name}": [-0.5, 0.5] for name in ("init_lin_vel", "init_roll")}
    settings |= {"domain_rand.push_robots": True, "domain_rand.push_probability": 1.0}
    task = make_task("a1_torque", 3000, **settings, **{"domain_rand.randomize_parameters": True})
    task.reset()
    columns = [task.commands, task.events.init_angles[:, :1], task.sim.qvel[:, :3], task.motor_strength[:, :1]]
    columns += [task.p_gains[:, :1]]
    correlation = torch.corrcoef(torch.cat(columns, dim=1).T) - torch.eye(9)
    assert torch.isfinite(correlation).all() and correlation.abs().max() < 4.5 / math.sqrt(3000)


def test_a_draw_follows_from_its_seeds():
    """The same seeds give the same numbers, world by world, and others give others."""
    field = torch.zeros(6, 2)
    drawn = Randomization([RandomParameter("number", field, [0, 1], {"set": [0.0, 1.0]})], {}.get, 6, "cpu")
    everywhere = torch.ones(6, dtype=torch.bool)
    drawn.seeds.copy_(torch.tensor([1, 2, 3, 1, 2, 4]))
    drawn.draw(everywhere)
    first = field.clone()
    assert torch.equal(first[:2], first[3:5]) and len(first.unique()) == 8
    drawn.draw(everywhere)
    assert torch.equal(field, first)


NUM_ENVS = 4 * MIN_WORLDS + 3  # no number of parts divides it
STEPS = 12


@pytest.fixture
def set_threads():
    """Return a function that sets torch's number of threads until the test ends."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def walk(make_task):
    """States and contact forces of worlds that differ in all that can be drawn, after each of some random actions."""
    task = make_task("a1_torque_multihead", NUM_ENVS, **{"domain_rand.randomize_parameters": True})
    found = []
    for _ in range(STEPS):
        task.step(torch.randn(NUM_ENVS, task.num_actions))
        found.append(torch.cat([task.sim.qpos, task.sim.qvel, task.sim.ctrl, task.sim.contact_force.flatten(1)], dim=1))
    return torch.stack(found)


@pytest.mark.parametrize("threads", [2, 3, 64])
def test_number_of_threads_changes_no_bit(make_task, set_threads, threads):
    """Each world is simulated once, as by one thread, and with parameters of its own."""
    set_threads(1)
    expected = walk(make_task)
    set_threads(threads)
    assert torch.equal(walk(make_task), expected)
    assert (expected[1:] != expected[:-1]).any(dim=2).all() and len(expected[-1].unique(dim=0)) == NUM_ENVS
    waiting = [thread for thread in threading.enumerate() if thread.name.startswith("worlds")]
    assert len(waiting) >= min(threads, NUM_ENVS // MIN_WORLDS) - 1
