"""Motors from outside of the package: a torque-speed curve, a limit of the rate with state, a delay of torques."""

import numpy as np
import pytest
import torch
import warp as wp
from support.control import HIGH_UP, time_out
from support.settings import error_of, torques_in_torch

from legged_torque.deploy.export import unknown_parts
from legged_torque.envs.approaches.torque import TorqueRobot
from legged_torque.envs.base.legged_robot import IN_TORCH, LeggedRobot
from legged_torque.envs.base.sweep import Sweep
from legged_torque.envs.robots.a1 import A1Cfg
from legged_torque.envs.tasks import A1TorqueCfg
from legged_torque.motors.config import DelayCfg, MotorCfg
from legged_torque.motors.kernel import read
from legged_torque.motors.model_config import EncoderCfg, LagCfg
from legged_torque.motors.models import EncoderModel, ModelMotor
from legged_torque.motors.motor import Motor
from legged_torque.sim.randomization import RandomParameter

# ------------------------------------------------------------------------------------------------ a user's own file


@wp.struct
class Curve:
    """Inputs of :func:`curve_torque`."""

    stall: wp.array[float]
    no_load: wp.array2d[float]


@wp.func
def curve_torque(motor: Curve, world: int, joint: int, substep: int, wanted: float, pos: float, vel: float) -> float:
    """Return the torque inside limits that fall linearly with the speed."""
    most = motor.stall[joint] * wp.max(1.0 - wp.abs(vel) / motor.no_load[world, joint], 0.0)
    return wp.clamp(wanted, -most, most)


class CurveCfg(MotorCfg):
    """Settings of a torque-speed curve."""

    stall: float | dict[str, float] = 33.5  # [N m]
    no_load: float = 20.0  # [rad/s]

    def build(self, joints):
        return CurveMotor(self, joints)


class CurveMotor(Motor):
    """A torque-speed curve with a random no-load speed."""

    kernel = curve_torque

    def __init__(self, cfg, joints):
        super().__init__(cfg, joints)
        self.stall = joints.values("motors.curve.stall", cfg.stall)
        self.no_load = self.buffer("no_load", len(joints.names)).fill_(cfg.no_load)

    def apply(self, wanted, pos, vel, substep):
        most = self.stall * (1.0 - vel.abs() / self.no_load).clamp(min=0.0)
        return wanted.clamp(-most, most)

    def kernel_reads(self):
        return read(Curve, stall=self.stall, no_load=self.no_load)

    def random_parameters(self):
        columns = range(self.no_load.shape[1])
        return [RandomParameter("no_load", self.no_load, columns, {"scale": [0.9, 1.1]}, "rad/s", shared=True)]

    def describe(self):
        return {"stall": self.stall.tolist(), "no_load": self.cfg.no_load}


@wp.struct
class Slew:
    """Inputs of :func:`slew_torque`."""

    most: float
    last: wp.array2d[float]


@wp.func
def slew_torque(motor: Slew, world: int, joint: int, substep: int, wanted: float, pos: float, vel: float) -> float:
    """Return a torque that differs from the last one by at most so much, and keep it."""
    last = motor.last[world, joint]
    torque = wp.clamp(wanted, last - motor.most, last + motor.most)
    motor.last[world, joint] = torque
    return torque


class SlewCfg(MotorCfg):
    """Settings of a limit of the rate."""

    rate: float = 500.0  # [N m/s]

    def build(self, joints):
        return SlewMotor(self, joints)


class SlewMotor(Motor):
    """Limits how fast a torque may change."""

    kernel = slew_torque

    def __init__(self, cfg, joints):
        super().__init__(cfg, joints)
        self.most, self.last = cfg.rate * joints.dt, self.buffer("last", len(joints.names))

    def apply(self, wanted, pos, vel, substep):
        self.last.copy_(wanted.clamp(self.last - self.most, self.last + self.most))
        return self.last.clone()

    def kernel_reads(self):
        return read(Slew, most=self.most, last=self.last)

    def reset(self, mask):
        self.last.masked_fill_(mask.unsqueeze(1), 0.0)


class LateCfg(MotorCfg):
    """Settings of a delay of torques."""

    steps: int = 2  # physics steps

    def build(self, joints):
        return LateMotor(self, joints)


class LateMotor(Motor):
    """Torques that come late, in torch only."""

    def __init__(self, cfg, joints):
        super().__init__(cfg, joints)
        self.before = self.buffer("before", cfg.steps, len(joints.names))

    def apply(self, wanted, pos, vel, substep):
        late = self.before[:, -1].clone()
        self.before.copy_(torch.cat([wanted.unsqueeze(1), self.before[:, :-1]], dim=1))
        return late


class OwnMotorsCfg(A1TorqueCfg):
    """An A1 with motors of its own."""

    class motors:
        chain = ["delay", "curve", "slew"]

        class curve(CurveCfg):
            stall = {"hip": 20.0, "joint": 33.5}

        class slew(SlewCfg):
            pass

        class late(LateCfg):
            pass

        class quick(SlewCfg):
            rate = 4000.0

        class bus(DelayCfg):
            pass


def make(num_envs=3, chain=("delay", "curve", "slew"), **changes):
    """A task with these motors, high up in the air."""
    cfg = OwnMotorsCfg()
    cfg.env.num_envs, cfg.motors.chain, cfg.init_state.pos = num_envs, list(chain), HIGH_UP["init_state.pos"]
    for name, value in changes.items():
        setattr(cfg.domain_rand, name, value)
    torch.manual_seed(0)
    return TorqueRobot(cfg)


# ------------------------------------------------------------------------------------------------ what it does


def by_hand(wanted, vel, last, no_load=20.0):
    """The torque of the curve and of the rate limit, of 500 N m/s in steps of 5 ms."""
    stall = np.where(np.arange(12) % 3 == 0, 20.0, 33.5)
    most = stall * np.maximum(1.0 - np.abs(vel) / no_load, 0.0)
    return np.clip(np.clip(wanted, -most, most), last - 2.5, last + 2.5)


@pytest.mark.parametrize("in_torch", [False, True], ids=["kernel", "torch"])
def test_curve_and_rate(in_torch):
    """Torques are those of both formulas in this order, from physics step to physics step, and start anew at resets."""
    task = make()
    if in_torch:
        torques_in_torch(task)
    last, noted = np.zeros((3, 12)), []
    sim_step = task.sim.step
    task.sim.step = lambda sense: (noted.append(task.dof_vel.numpy().copy()), sim_step(sense))
    generator = torch.Generator().manual_seed(0)
    for step in range(5):
        if step == 3:
            time_out(task, [1])
        actions = 3.0 * torch.randn(3, 12, generator=generator)
        noted.clear()
        task.step(actions)
        for vel in noted:
            last = by_hand(8.0 * actions.numpy(), vel, last)
        ended = task.reset_buf.numpy()
        np.testing.assert_allclose(task.torques.numpy()[~ended], last[~ended], atol=1e-3)
        last[ended] = 0.0
    assert len(noted) == 4 and np.abs(last).max() > 5.0


def test_a_link_without_a_kernel():
    """Torch then computes all torques, with a note; a delay behind other links, and two links of one model."""
    task = make(2, ("curve", "quick", "late"), randomize_parameters=False)
    assert any(IN_TORCH in note for note in task.notes)
    seen = []
    run = task.sim.step
    task.sim.step = lambda sense: (seen.append(task.torques.numpy().copy()), run(sense))
    task.step(torch.full((2, 12), 1.0))
    seen = np.stack(seen)
    assert (seen[:2] == 0.0).all()  # two physics steps late
    np.testing.assert_allclose(seen[2:], 8.0, atol=4.0)
    assert (seen[2] > 0.0).all()
    both = make(2, ("curve", "quick", "slew"))
    both.step(torch.full((2, 12), 1.0))
    np.testing.assert_allclose(both.torques, 8.0, atol=1e-3)  # 2.5 N m per step: 8 after four of them


def test_own_state_and_parameters():
    """State is a part of the worlds' state, parameters are drawn, observed by the critic, and mirrored if known."""
    task = make(50, randomize_parameters=True)
    for _ in range(3):
        task.step(torch.randn(50, 12))
    no_load = task.motors.links["curve"].no_load
    assert (no_load == no_load[:, :1]).all() and 18.0 <= no_load.min() < 18.5 and 21.5 < no_load.max() <= 22.0
    assert "no_load" in task.randomization.sizes
    state = {name: value.clone() for name, value in task.motors.state_dict()["slew"].items()}
    assert state["last"].abs().max() > 1.0
    task.motors.links["slew"].last.zero_()
    kept = task.world_state_dict()
    kept = {**kept, "motors": {**kept["motors"], "slew": state}}
    task.load_world_state_dict(kept)
    assert torch.equal(task.motors.links["slew"].last, state["last"])
    assert task.motors.describe() == {"curve": {"stall": pytest.approx([20.0, 33.5, 33.5] * 4), "no_load": 20.0}}


def test_mistakes():
    """Links that do not exist, occur twice, in the wrong order or in vain are refused by name."""
    assert "unknown motors.chain 'curv'; did you mean 'curve'?" in error_of(make, 1, ("curv",))
    assert "has the link 'slew' twice" in error_of(make, 1, ("slew", "slew"))
    assert "links that act on actions first" in error_of(make, 1, ("curve", "delay"))
    assert "one link that acts on actions at most, not delay, bus" in error_of(make, 1, ("delay", "bus", "curve"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"acts_on": "action"}, "unknown acts_on of Own 'action'; did you mean 'actions'?"),
        ({"apply": Motor.apply}, "Own has no apply"),
        (
            {"apply": lambda motor, wanted, *_: wanted[:, :1]},
            "Own.apply returns must be float32 (3, 12)",
        ),
        ({"reset": lambda motor, mask: motor.buffer("before", 2)}, "Own has the buffer 'before' twice"),
    ],
)
def test_models_that_lack_something(monkeypatch, changes, message):
    """They are refused by name when the task is built, as are settings that build no motor."""
    monkeypatch.setattr(LateCfg, "build", lambda cfg, joints: type("Own", (LateMotor,), changes)(cfg, joints))
    assert message in error_of(lambda: make(3, ["late"]).try_step())
    monkeypatch.setattr(LateCfg, "build", lambda cfg, joints: None)
    assert error_of(make, 3, ["late"]) == "motors.late.build must return a Motor, not None"
    monkeypatch.setattr(LateCfg, "build", MotorCfg.build)
    assert error_of(make, 3, ["late"]) == "late has no build"


def test_torques_of_another_shape():
    """A task's own torques are refused like a motor's."""
    cfg = OwnMotorsCfg()
    cfg.env.num_envs = 2
    kind = type("Own", (TorqueRobot,), {"_compute_torques": lambda task, actions: actions[:, :1]})
    assert "_compute_torques returns must be float32 (2, 12)" in error_of(kind(cfg).try_step)


class HalfLag(ModelMotor):
    """A lag with half of the torque."""

    def apply(self, wanted, pos, vel, substep):
        return 0.5 * super().apply(wanted, pos, vel, substep)


class Biased(EncoderModel):
    """Encoders with an error."""

    def measured(self, pos, vel):
        return pos + 0.1, vel


NOTHING = {"actions": {"terms": []}}  # a description


def test_models_that_inherit_ours(monkeypatch):
    """What they override counts, no kernel of ours replaces it, and no export describes it by ours."""
    monkeypatch.setattr(LagCfg, "build", lambda cfg, joints: HalfLag(cfg, joints))
    monkeypatch.setattr(EncoderCfg, "build", lambda cfg, joints: Biased(cfg, joints))
    task = make(chain=["ideal", "lag"])
    assert IN_TORCH in task.notes[0] and unknown_parts(task, NOTHING) == ["the motor 'lag' has no describe()"]
    task.step(torch.ones(3, 12))
    torch.testing.assert_close(task.torques, torch.full((3, 12), 4.0))  # of 8 N m
    cfg = A1Cfg()
    cfg.env.num_envs, cfg.motors.chain, cfg.control.decimation = 3, ["encoder", "ideal"], 1
    task = LeggedRobot(cfg)
    pos, vel = task.dof_pos.clone(), task.dof_vel.clone()
    task.step(torch.zeros(3, 12))
    wanted = task.p_gains * (task.default_dof_pos - pos - 0.1) - task.d_gains * vel
    torch.testing.assert_close(task.torques, wanted.clamp(-33.5, 33.5))


def test_settings_of_links_that_are_not_in_the_chain(make_task):
    """They have no effect, as a note says."""
    idle = {"motors.friction.coulomb_friction": 0.5, "motors.lag.draws": {"time_constant": {"set": [0.001, 0.003]}}}
    notes = [f"motors.{name} has no effect: motors.chain lacks '{name}'" for name in ("lag", "friction")]
    assert sorted(make_task("a1_torque", 1, **idle).notes) == sorted(notes)


def test_a_delay_of_another_name():
    """Its range keeps its time at another rate, sweeps name its unit, and parts of a control step may be refused."""
    cfg = OwnMotorsCfg()
    cfg.env.num_envs, cfg.motors.chain = 2, ["bus", "curve"]
    assert "give motors.bus.range" in error_of(lambda: Sweep(TorqueRobot(cfg), "action_delay"))
    cfg.motors.bus.range, cfg.motors.bus.unit = [0, 3], "control_steps"
    assert Sweep(TorqueRobot(cfg), "action_delay").unit == "control_steps"
    cfg.set_clocks(100.0, None)
    assert cfg.motors.bus.range == [0, 6]  # 60 ms at most, as at 50 Hz
    cfg.motors.bus.unit, cfg.control.refresh_torques = "physics_steps", False
    assert error_of(TorqueRobot, cfg).startswith("motors.bus.unit must be control_steps")


def test_sata(make_task):
    """Limits and the rate of new actions grow by Gompertz' curve; fatigue is observed, penalized and forgotten."""
    task = make_task("a1_sata", 3, **{"motors.delay.loss": 0.0, **HIGH_UP})
    for age, rate in ((0, 0.5), (24_000 * 4096, 0.5 + 0.5 * np.exp(-1.0)), (10**10, 1.0)):
        task.total_steps.fill_(age)
        task.update_curriculum()
        task.reset()
        act, fatigue, sent = np.zeros((3, 12)), np.zeros((3, 12)), np.zeros((3, 12))
        limit = 33.5 * (0.3 + 0.7 * np.exp(-np.exp(-3e-5 * (age / 4096 - 24_000))))
        for step in range(9):
            if step == 5:
                time_out(task, [1])
            drawn, qd = 6.0 * np.random.default_rng(step).normal(size=(3, 12)), task.dof_vel.numpy().copy()
            number = task.episode_length_buf.numpy().copy()
            task.step(torch.tensor(drawn, dtype=torch.float32))
            is_due = np.floor(rate * number + 1e-5) > np.floor(rate * (number - 1) + 1e-5)
            sent = np.where(is_due[:, None], drawn, sent)
            act = 0.4 * act + 0.6 * np.tanh(5.0 * sent / limit)
            torques = limit * (act - np.abs(act) * qd / 21.0)
            fatigue = 0.9 * (fatigue + 0.005 * np.abs(torques))
            kept = ~task.reset_buf.numpy()
            assert kept.tolist() == [True, step != 5, True]
            np.testing.assert_allclose(task.torques[kept], np.clip(torques, -33.5, 33.5)[kept], rtol=1e-3, atol=1e-3)
            act[~kept] = fatigue[~kept] = sent[~kept] = 0.0
            np.testing.assert_allclose(task.observations.by_term()["fatigue"], fatigue, rtol=1e-3, atol=1e-4)
            wanted = (fatigue * np.abs(5.0 * sent)).sum(axis=1)
            np.testing.assert_allclose(task._reward_fatigue(), wanted, rtol=1e-3, atol=1e-3)
    assert "one muscle" in error_of(make_task, "a1_sata", 1, **{"motors.chain": ["delay", "ideal"]})
    for own in ({"motors.muscle.growth": 0.9}, {"motors.muscle.draws": {"growth": {"set": [0.4, 1.0]}}}):
        assert "motors.muscle.growth and its draws have no effect" in error_of(make_task, "a1_sata", 1, **own)


@pytest.mark.parametrize("in_torch", [False, True], ids=["kernel", "torch"])
def test_torque_perturbation(make_task, in_torch):
    """Each joint gets 2 tanh(offset + of_pos q + of_vel qd) [N m] more, by weights that an episode draws."""
    settings = {"motors.chain": ["delay", "perturbation", "ideal"], "control.decimation": 1, **HIGH_UP}
    task = make_task("a1_torque", 200, **settings)
    link = task.motors.links["perturbation"]
    weights = [weight.numpy() for weight in (link.offset, link.of_pos, link.of_vel)]
    for weight, most in zip(weights, (1.0, 1.0, 0.1), strict=True):
        assert 0.99 * most < weight.max() <= most and -most <= weight.min() < -0.99 * most
        assert abs(np.corrcoef(weight[:, 0], weight[:, 1])[0, 1]) < 0.3
    if in_torch:
        torques_in_torch(task)
    before = weights[0].copy()
    for _ in range(2):
        q, qd = task.dof_pos.numpy().copy(), task.dof_vel.numpy().copy()
        task.step(torch.ones(200, 12))
        expected = 8.0 + 2.0 * np.tanh(weights[0] + weights[1] * q + weights[2] * qd)
        np.testing.assert_allclose(task.torques, expected, atol=1e-5)
    assert np.array_equal(before, weights[0])
    task.reset()
    assert not np.isclose(before, weights[0]).any()


def test_motors_write_in_place(monkeypatch):
    """What a model keeps is not bound to another tensor, which a captured step would not read."""
    monkeypatch.setattr(LateMotor, "apply", lambda motor, *_: setattr(motor, "before", motor.before.clone()))
    line = error_of(make(3, ["late"]).try_step)
    assert line.startswith("write before of LateMotor in place")
