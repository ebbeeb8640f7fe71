"""Motor models, as their formulas by hand in torch, in numpy and in the kernel of torques; MuJoCo's DC motor."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
import yaml
from support.control import HIGH_UP, NOMINAL, REAL_MOTORS, TORQUE_LIMIT, pd_by_hand, time_out
from support.settings import error_of, torques_in_torch

from legged_torque.envs import task_registry
from legged_torque.envs.base.asset import load_asset
from legged_torque.envs.base.legged_robot import IN_TORCH, LeggedRobot
from legged_torque.envs.robots.a1 import A1Cfg
from legged_torque.motors import models
from legged_torque.motors.model_config import MODELS
from legged_torque.motors.motor import Joints
from legged_torque.motors.twin import MotorTwin
from legged_torque.sim.randomization import Randomization
from legged_torque.utils.config import update_from_dict
from legged_torque.utils.options import Options

NAMES = ["hip", "thigh", "calf"]
WORLDS, STEPS, DECIMATION, DT, PEAK = 40, 6, 2, 0.005, 30.0
POSE = np.array([0.1, 0.8, -1.5])
TABLES = yaml.safe_load(Path(__file__).with_name("motors.yaml").read_text("utf-8"))
CONSTANTS = TABLES["constants"]


def by_hand(model, wanted, pos, vel):
    """Torques of all steps from a model's formula. Shapes: (steps, worlds, joints)."""
    if model == "drive":
        return wanted - np.array([0.5, 1.0, 0.0]) * vel + 20.0 * (POSE - pos)
    if model == "friction":
        dry = 1.6 + 0.05 * np.abs(wanted) + 0.8 * np.exp(-np.square(10.0 * vel))
        return wanted - dry * np.tanh(2.0 * vel) - 0.16 * vel
    if model == "quantize":
        return np.rint(wanted / [0.5, 0.01, 3.0]) * [0.5, 0.01, 3.0]
    torques, state = np.zeros_like(wanted), np.zeros(wanted.shape[1:])
    voltage = np.ones((wanted.shape[1], 1))
    for step, (asked, speed) in enumerate(zip(wanted, vel, strict=True)):
        if model == "lag":
            state = torques[step] = asked + np.exp(-DT / np.array([1e-9, 0.002, 0.02])) * (state - asked)
        elif model == "muscle":
            limit = PEAK * np.array([0.3, 1.0, 0.7])
            state = 0.4 * state + 0.6 * np.tanh(asked / limit)
            torques[step] = limit * (state - np.abs(state) * speed / 21.0)
        elif model == "thermal":
            rated, decay = np.array([5.0, 12.0, 40.0]), np.exp(-DT / 0.02)
            most = [np.interp(np.sqrt(state[:, j]), [0.8 * r, r], [max(PEAK, r), r]) for j, r in enumerate(rated)]
            torques[step] = np.clip(asked, -np.transpose(most), np.transpose(most))
            state = decay * state + (1.0 - decay) * torques[step] ** 2
        else:
            if step % DECIMATION == 0 and step:
                power = (torques[step - DECIMATION : step] * vel[step - DECIMATION : step]).sum(axis=2).mean(axis=0)
                voltage = 1.0 - np.clip(power / 2000.0, 0.0, 1.0)[:, None]
            knees, ends = np.array([13.5, 10.0, 8.0]) * voltage, np.array([30.0, 30.0, 8.0]) * voltage
            share = np.clip((ends - np.abs(speed)) / np.maximum(ends - knees, 1e-9), 0.0, 1.0)
            most = np.where(np.sign(asked) == np.sign(speed), 20.2 * share, 23.4)
            torques[step] = np.sign(asked) * np.minimum(np.abs(asked), most)
    return torques


def joints(worlds=WORLDS):
    """Three joints on a CPU."""
    limits, actions = torch.tensor([[-PEAK] * 3, [PEAK] * 3]), torch.zeros(worlds, 3)
    pose = torch.tensor(POSE, dtype=torch.float32)
    gains = (torch.full((worlds, 3), 20.0), torch.full((worlds, 3), 0.5))
    return Joints(NAMES, limits, torch.zeros(3), actions, DT, DECIMATION, pose, gains, "motors.own")


def settings(model, **constants):
    """Settings of a model."""
    cfg = MODELS[model]()
    update_from_dict(cfg, constants, "motors.own")
    cfg.check("motors.own")
    return cfg


def described(motors, pose=POSE, names=NAMES, peak=PEAK):
    """What the twin reads of ``policy.yaml``."""
    description = {"joint_order": names, "nominal_pose": dict(zip(names, pose, strict=True)), "motors": motors}
    description["timing"] = {"decimation": DECIMATION, "physics_frequency": 1.0 / DT}
    description["gains"] = {name: dict.fromkeys(names, 1.0) for name in ("stiffness", "damping")}
    return description | {"torque_limits": {name: [-peak, peak] for name in names}}


def twin_of(model, constants):
    """One motor in numpy."""
    return MotorTwin(described({"own": {"model": model, **constants}}))


@wp.kernel(module="unique", enable_backward=False)
def evaluate_all(
    # In:
    curve: models.Curve,
    drive: models.Drive,
    lag: models.Lag,
    friction: models.Friction,
    thermal: models.Thermal,
    quantize: models.Quantize,
    muscle: models.Muscle,
    wanted: wp.array2d[float],
    pos: wp.array2d[float],
    vel: wp.array2d[float],
    # Out:
    torques: wp.array3d[float],
):
    """Compute the torques of all models for the same joints, so that one compilation serves all of them."""
    i, j = wp.tid()
    tau, q, qd = wanted[i, j], pos[i, j], vel[i, j]
    torques[0, i, j] = models.curve_torque(curve, i, j, 0, tau, q, qd)
    torques[1, i, j] = models.drive_torque(drive, i, j, 0, tau, q, qd)
    torques[2, i, j] = models.lagging_torque(lag, i, j, 0, tau, q, qd)
    torques[3, i, j] = models.friction_torque(friction, i, j, 0, tau, q, qd)
    torques[4, i, j] = models.derated_torque(thermal, i, j, 0, tau, q, qd)
    torques[5, i, j] = models.quantized_torque(quantize, i, j, 0, tau, q, qd)
    torques[6, i, j] = models.muscle_torque(muscle, i, j, 0, tau, q, qd)


def draw(*shape):
    """Torques, positions and speeds, some at rest."""
    rng = np.random.default_rng(0)
    wanted, pos, vel = (rng.uniform(-size, size, shape).astype(np.float32) for size in (40.0, 2.0, 40.0))
    vel[:, ::4] *= 0.002
    return wanted, pos, vel


@pytest.fixture(scope="module")
def computed():
    """Torques by way of computing and model. Shapes: (steps, worlds, joints)."""
    wp.init()
    wanted, pos, vel = draw(STEPS, WORLDS, 3)
    found = {(way, model): np.zeros_like(wanted) for way in ("torch", "kernel", "numpy") for model in CONSTANTS}
    in_torch, in_kernel = (
        {model: settings(model, **own).build(joints()) for model, own in CONSTANTS.items()} for _ in range(2)
    )
    reads, out = [link.kernel_reads() for link in in_kernel.values()], torch.zeros(7, WORLDS, 3)
    twins = {model: [twin_of(model, own) for _ in range(WORLDS)] for model, own in CONSTANTS.items()}
    for step in range(STEPS):
        inputs = [torch.tensor(values[step]) for values in (wanted, pos, vel)]
        if step % DECIMATION == 0:
            for link in (*in_torch.values(), *in_kernel.values()):
                link.finish_step()
        wp.launch(evaluate_all, (WORLDS, 3), [*reads, *map(wp.from_torch, (*inputs, out))], device="cpu")
        for number, model in enumerate(CONSTANTS):
            found["torch", model][step] = in_torch[model].apply(*inputs, step % DECIMATION)
            found["kernel", model][step] = out[number]
            for world, twin in enumerate(twins[model]):
                if step % DECIMATION == 0:
                    twin.begin()
                found["numpy", model][step, world] = twin.apply(*(values[step, world] for values in (wanted, pos, vel)))
    return found


@pytest.mark.parametrize("model", CONSTANTS)
@pytest.mark.parametrize("way", ["torch", "kernel", "numpy"])
def test_formula(computed, way, model):
    """Each way gives the torques of the formula, to a millionth of the largest one."""
    expected = by_hand(model, *(values.astype(float) for values in draw(STEPS, WORLDS, 3)))
    np.testing.assert_allclose(computed[way, model], expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


def test_as_mujoco_s_dc_motor():
    """A curve with the line of a DC motor has the torque of MuJoCo's at full voltage, with its limit of the torque."""
    constant, resistance, volts, most = 0.8, 0.9, 24.0, 15.0  # [N m/A], [ohm], [V], [N m]
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    body.add_joint(name="joint", type=mujoco.mjtJoint.mjJNT_HINGE)
    body.add_geom(size=[0.1, 0.1, 0.1])
    actuator = spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT, target="joint")
    actuator.set_to_dcmotor([constant, constant], resistance, saturation=[most, 0.0, 0.0])
    model = spec.compile()
    data = mujoco.MjData(model)
    knee, no_load = (volts - most * resistance / constant) / constant, volts / constant
    curve = {"knee_speed": knee, "no_load_speed": no_load, "driving_torque": most, "braking_torque": most}
    twin = twin_of("curve", curve)
    for speed in np.linspace(-40.0, 29.0, 24):
        data.ctrl, data.qvel = volts, speed
        mujoco.mj_forward(model, data)
        assert twin.apply(np.full(3, 100.0), POSE, np.full(3, speed)) == pytest.approx(data.actuator_force[0], abs=1e-5)


@pytest.mark.parametrize(
    ("model", "constants", "made"),
    [("drive", {"damping": 0.05}, 0.0), ("friction", {"viscous_friction": 0.03, "static_friction": 0.2}, 0.1)],
)
def test_energy_balance(model, constants, made):
    """What damping and friction take from a turning body is what it loses; motors make what was asked of them."""
    body = mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="0.002" gravity="0 0 0"><flag energy="enable"/></option><worldbody><body>'
        '<joint name="joint"/><geom size="0.1" mass="3"/></body></worldbody>'
        '<actuator><motor joint="joint"/></actuator></mujoco>'
    )
    data, twin, lost, work = mujoco.MjData(body), twin_of(model, constants), 0.0, 0.0
    data.qvel = 12.0
    mujoco.mj_forward(body, data)
    start = data.energy[1]
    for _ in range(200):
        data.ctrl, before = twin.apply(np.full(3, made), POSE, np.full(3, data.qvel[0]))[0], data.qvel[0]
        motor = twin.before_friction(data.ctrl)[0] if model == "friction" else 0.0
        mujoco.mj_step(body, data)
        moved = (before + data.qvel[0]) / 2.0 * 0.002
        friction = 0.05 * before if model == "drive" else 0.2 * np.exp(-((before / 0.1) ** 2)) + 0.03 * before
        lost, work = lost + friction * moved, work + motor * moved
    mujoco.mj_forward(body, data)
    assert start + work - data.energy[1] == pytest.approx(lost, rel=1e-6) and lost > 0.5 * start
    assert work == pytest.approx(made * data.qpos[0], rel=0.01, abs=1e-9)


@pytest.mark.parametrize("in_torch", [False, True], ids=["kernel", "torch"])
def test_encoder(make_task, in_torch):
    """PD law, drive and policy have steps of position and speed; friction, behind the encoder, and critic true ones."""
    steps = {"motors.encoder.position_resolution": 0.05, "motors.encoder.velocity_resolution": {"hip": 0.5, "joint": 2}}
    chain = {"motors.chain": ["delay", "drive", "encoder", "friction"], "motors.drive.damping": 0.3}
    settings = {"motors.friction.viscous_friction": 0.1, "control.decimation": 1, **HIGH_UP, **steps, **chain}
    task = make_task("a1_position", 20, **settings)
    if in_torch:
        torques_in_torch(task)
    twin = MotorTwin(described(task.motors.describe(), NOMINAL, task.dof_names))
    step = np.array([0.5, 2.0, 2.0] * 4, np.float32)
    for _ in range(3):
        q, qd = task.dof_pos.numpy().copy(), task.dof_vel.numpy().copy()
        seen, seen_qd = np.round(q / np.float32(0.05)) * np.float32(0.05), np.round(qd / step) * step
        obs = task.get_observations()
        np.testing.assert_allclose(obs["policy"][:, 9:21], seen - NOMINAL, atol=1e-6)
        np.testing.assert_allclose(obs["policy"][:, 21:33], 0.05 * seen_qd, atol=1e-6)
        np.testing.assert_allclose(obs["critic"][:, 21:33], 0.05 * qd, atol=1e-6)
        actions = np.random.default_rng(0).normal(size=(20, 12))
        task.step(torch.tensor(actions, dtype=torch.float32))
        wanted = pd_by_hand(actions, seen, seen_qd)
        expected = wanted - 0.3 * seen_qd - 0.1 * qd
        np.testing.assert_allclose(task.torques, expected, rtol=1e-6, atol=2e-5)
        np.testing.assert_allclose(twin.apply(wanted[0], q[0], qd[0]), expected[0], rtol=1e-6, atol=2e-5)
        np.testing.assert_allclose(twin.measured(q[0], qd[0]), [seen[0], seen_qd[0]], rtol=1e-6)
    assert "one encoder" in error_of(MotorTwin, described({"a": {"model": "encoder"}, "b": {"model": "encoder"}}))


def test_draws_and_resets():
    """A constant is drawn as one number per world, of all joints; state goes with an episode."""
    cfg = settings("curve", **CONSTANTS["curve"], draws={"voltage": {"set": [0.8, 1.1]}})
    link = cfg.build(joints(200))
    drawn = Randomization(link.random_parameters(), lambda *_: None, 200, "cpu")
    drawn.seeds.random_(generator=torch.Generator().manual_seed(0))
    drawn.draw(torch.ones(200, dtype=torch.bool))
    voltage = link.values.voltage
    assert (voltage == voltage[:, :1]).all() and 0.8 <= voltage.min() < 0.81 and 1.09 < voltage.max() <= 1.1
    speeds = torch.full((200, 3), 24.0)
    torques = link.apply(torch.full((200, 3), 40.0), speeds, speeds, 0)
    expected = 20.2 * ((30.0 * voltage - 24.0) / (16.5 * voltage)).clamp(0.0, 1.0)
    torch.testing.assert_close(torques[:, 0], expected[:, 0])
    link.reset(torch.arange(200) < 100)
    assert (link.values.power[:100] == 0.0).all() and (link.values.power[100:, 0] > 0.0).any()


@pytest.mark.parametrize(("model", "constants", "message"), TABLES["beyond"])
def test_draws_beyond_the_bounds_of_a_constant(make_task, model, constants, message):
    """They are refused where anything is drawn; those that reach the bounds are not."""
    settings = {f"motors.{model}.{name}": value for name, value in constants.items()}
    settings |= {"motors.chain": ["delay", "ideal", model]}
    make_task("a1_position", 1, **settings)
    settings["domain_rand.randomize_parameters"] = True
    if message:
        assert message in error_of(make_task, "a1_position", 1, **settings)
    else:
        make_task("a1_position", 1, **settings)


@pytest.mark.parametrize(("task", "choice", "joint", "speed", "most"), TABLES["choices"])
def test_choices(task, choice, joint, speed, most):
    """The motors of a robot have the torques of their sources."""
    cfg = task_registry.get_cfgs(task, Options(device="cpu", motors=choice))[0]
    pose = cfg.init_state.default_joint_angles
    twin = MotorTwin(described(cfg.motors.describe(), list(pose.values()), list(pose), peak=200.0))
    torques = twin.apply(np.full(len(pose), 1000.0), np.zeros(len(pose)), np.full(len(pose), speed))
    assert torques[list(pose).index(joint)] == pytest.approx(most, rel=1e-6, abs=1e-6)


def test_the_control_law_keeps_its_drive():
    """Damping that a policy was trained with stays with other motors; what a policy cannot have is refused."""
    for choice, rest in (("ideal", ["ideal"]), ("real", ["ideal", "urdf"])):
        motors = task_registry.get_cfgs("a1_torque_damped", Options(device="cpu", motors=choice))[0].motors
        assert motors.chain == ["delay", "drive", *rest] and motors.drive.damping == 0.5
    motors.choices["own"] = ["delay", "smooth", "ideal"]  # of which one is not known
    motors.choose("own")
    assert motors.chain == ["delay", "smooth", "drive", "ideal"]
    motors.network.file = "of_the_task.json"
    network = {"model": "network", "activation": "relu", "layers": [[[0.5] * 7]]}
    motors.restore({"network": network, "ideal": {"model": "ideal"}})
    assert motors.chain == ["delay", "network", "ideal"] and motors.describe()["network"].items() >= network.items()
    motors.restore({})
    assert motors.chain == ["delay", "ideal"]
    line = error_of(motors.restore, {"choices": {"model": "ideal"}})
    assert "the policy's task has no motors.choices of the model 'ideal'" in line


def test_armature():
    """With its own motors, joints of the G1 have the inertia of their rotors more; of other robots, the file's."""
    inertia = {}
    for choice in ("ideal", "real"):
        model = load_asset(task_registry.get_cfgs("g1_position", Options(device="cpu", motors=choice))[0]).mj_model
        data, full = mujoco.MjData(model), np.zeros((model.nv, model.nv))
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        inertia[choice] = np.diag(full)[6:] - (0.01 if choice == "ideal" else 0.0)
    rotors = 2 * [0.01018, 0.0251, 0.01018, 0.0251, 2 * 0.00361, 2 * 0.00361]
    np.testing.assert_allclose(inertia["real"] - inertia["ideal"], rotors, atol=1e-9)
    cfg = task_registry.get_cfgs("go2_torque", Options(device="cpu", motors="real"))[0]
    assert cfg.motors.of_joints(list(cfg.init_state.default_joint_angles)) == {}


@pytest.mark.parametrize(("model", "constants", "words"), TABLES["refused"])
def test_refused(model, constants, words):
    """Constants that make no sense are refused by name, in settings and in ``policy.yaml``."""
    lines = [error_of(lambda: settings(model, **constants).build(joints()))]
    if "draws" not in constants:
        lines.append(error_of(twin_of, model, constants))
    assert all(word in line for word in words for line in lines)


STATE = ("qpos", "qvel", "qacc_warmstart", "ctrl", "contact_found", "contact_force")


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("a1_position", {"domain_rand.randomize_parameters": True}),
        ("a1_torque", {"motors.delay.range": [0, 9], "control.decimation": 3}),
        ("a1_multihead", {"motors.delay.range": [1, 2], "motors.delay.unit": "control_steps"}),
        ("a1_torque_multihead", {"motors.delay.range": [2, 6], "motors.delay.jitter": 5, "motors.delay.loss": 0.2}),
        ("a1_multihead_two_rates", {"motors.delay.range": [0, 5], "init_state.pos": [0.0, 0.0, 0.3]}),
        ("a1_torque", REAL_MOTORS | {"motors.delay.range": [0, 3], "domain_rand.randomize_parameters": True}),
    ],
)
def test_as_in_torch(make_task, name, settings):
    """The kernel does what torch does, for delayed actions too."""
    tasks = [make_task(name, 30, **settings) for _ in range(2)]
    torques_in_torch(tasks[1])
    assert not any(IN_TORCH in note for note in tasks[0].notes)
    generator = torch.Generator().manual_seed(0)
    for step in range(12):
        actions = 3.0 * torch.randn(30, tasks[0].num_actions, generator=generator)
        for task in tasks:
            task.total_steps.fill_(25_000_000)
            task.update_curriculum()
            torch.manual_seed(step)
            if step == 6:
                time_out(task, slice(0, 10))
            task.step(actions)
        for field in STATE:
            torch.testing.assert_close(getattr(tasks[0].sim, field), getattr(tasks[1].sim, field), rtol=1e-3, atol=1e-3)
            getattr(tasks[1].sim, field).copy_(getattr(tasks[0].sim, field))  # rounding errors do not add up
    assert tasks[0].contacts.any()


class Doubled(LeggedRobot):
    """Overrides the torques in torch only."""

    def _compute_torques(self, actions):
        return 2.0 * super()._compute_torques(actions)


def test_overrides_count():
    """A class that overrides the method gets its own torques, and a note says what that costs."""
    cfg = A1Cfg()
    cfg.env.num_envs, cfg.control.decimation, cfg.init_state.pos = 2, 1, HIGH_UP["init_state.pos"]
    task = Doubled(cfg)
    q, qd = task.dof_pos.numpy().copy(), task.dof_vel.numpy().copy()
    task.step(torch.full((2, 12), 0.3))
    expected = np.clip(2.0 * pd_by_hand(0.3, q, qd), -TORQUE_LIMIT, TORQUE_LIMIT)
    np.testing.assert_allclose(task.torques, expected, atol=1e-4)
    assert any(IN_TORCH in note for note in task.notes)


def test_override_of_one_task_counts(make_task):
    """So does a function that replaces the method of a task after steps, and what it replaced when it is put back."""
    task = make_task("a1_torque_multihead", 2, **HIGH_UP, **{"control.decimation": 1})
    actions = torch.ones(2, 24)
    task.step(actions)
    task._compute_torques = lambda actions: torch.full((2, 12), 7.0)
    task.step(actions)
    assert (task.torques == 7.0).all()
    del task._compute_torques
    task.step(actions)
    assert not (task.torques == 7.0).any()
