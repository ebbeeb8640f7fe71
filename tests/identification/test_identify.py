"""Identification of a leg: known numbers are found, with intervals; what a log does not tell is refused by name."""

import json
import re
import runpy
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import yaml
from support.one_leg import NUMBERS, PERIOD, POSE, TILT, TRUTH, fixed, noisy, one_leg, record, sweep, write_log
from support.scripts import ROOT, run_here
from support.settings import error_of

from legged_torque.envs import task_registry
from legged_torque.envs.base.asset import load_asset
from legged_torque.identification import fit
from legged_torque.identification.fit import Problem
from legged_torque.identification.recording import Recording
from legged_torque.identification.worlds import FIELDS, PARAMETERS, HangingRobots
from legged_torque.runtime.sim_robot import SimRobot
from legged_torque.utils.options import Options, choose_motors


def test_the_trunk_is_fixed(tmp_path):
    """Worlds are where a robot on a fixed, tilted trunk is in plain MuJoCo, in any order of the joints.

    Nothing collides, not even a <pair> of neighbours; torques are limited; what robots did before is forgotten.
    """
    leg = one_leg(tmp_path)
    for file in ("leg.xml", "fixed.xml"):
        tree = ElementTree.parse(tmp_path / file)
        ElementTree.SubElement(
            ElementTree.SubElement(tree.getroot(), "contact"), "pair", geom1="FR_thigh", geom2="FR_calf"
        )
        for motor in tree.iter("motor"):
            motor.set("ctrlrange", "-4 4")
        tree.write(tmp_path / file)
    leg.asset.self_collisions = True
    known, order = record(leg, sweep(1.5)), [2, 0, 1]
    shuffled = [known.joint_order[place] for place in order]
    recording = Recording(shuffled, known.period, TILT, known.commands[..., order], known.measured[..., order])
    robots = HangingRobots(leg, recording, "cpu", 4)
    assert robots.branches == [[1, 2, 0]]
    numbers, seen = np.tile(TRUTH[:, order], (robots.num_worlds, 1, 1)), []
    for scale in (1.0, 2.0, 1.0):
        seen.append(robots.run(scale * numbers, len(known.commands)).numpy().copy())
    for number, atol in enumerate((3e-5, 3e-3)):
        np.testing.assert_allclose(seen[0][:, 5, number], known.measured[:, number][:, order], atol=atol)
    np.testing.assert_array_equal(seen[0][:, 0], seen[0][:, -1])
    np.testing.assert_array_equal(seen[0], seen[2])


def test_joints_that_a_log_lacks(leg):
    """One that would hang limp on the branch of others is refused by name."""
    known = record(leg, sweep(0.1))
    part = Recording(known.joint_order[:2], known.period, TILT, known.commands[..., :2], known.measured[..., :2])
    assert error_of(HangingRobots, leg, part, "cpu").endswith("branches that it has: FR_calf_joint")


def quiet(recording):
    """The same with a tenth of the noise."""
    return replace(recording, measured=recording.measured + 0.1 * (noisy(recording).measured - recording.measured))


@pytest.fixture(scope="module")
def found(leg, tmp_path_factory):
    """What identify.py finds in a log of continuous drives with little noise; what it prints, and its settings."""
    folder, (kind, _, training) = tmp_path_factory.mktemp("found"), task_registry._tasks["go2_torque"]
    recording = quiet(record(leg, sweep(6.0)))
    write_log(folder / "chirp.mcap", recording, "one_leg")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(task_registry._tasks, "one_leg", (kind, leg, training))
        patch.setattr(fit, "GENERATIONS", 2)
        words = ("chirp.mcap", "--json", "found.json", "--device", "cpu")
        status, output, error = run_here("identify.py", *words, root=folder)
        assert status == 0, error
        cfg = task_registry.get_cfgs("one_leg", Options(device="cpu", motors=str(folder / "chirp_motors.yaml")))[0]
    content = json.loads((folder / "found.json").read_text())
    return {name: np.array(value) for name, value in content.items()}, output, cfg


def test_known_numbers(found):
    """Each is within 0.5%, the delay within 0.003 ms; errors are those of noise, not of physics steps.

    Where nothing was fitted, errors are the noise.
    """
    result, output, _ = found
    np.testing.assert_allclose(result["values"][:4], TRUTH[:4], rtol=0.005)
    np.testing.assert_allclose(result["values"][4], 0.005, atol=3e-6)
    errors = np.abs(result["values"] - TRUTH) / result["half_widths"]
    assert errors.max() < 2.2 and (errors < 1.0).sum() >= 11, errors
    np.testing.assert_allclose(result["noise"], [[5e-5] * 3, [0.005] * 3], rtol=0.1)
    before, after = result["held_out"]
    np.testing.assert_allclose(after, [[5e-5] * 3, [0.005] * 3], rtol=0.1)
    assert (before[0] > 20 * after[0]).all()
    assert re.search(r"FR_thigh_joint +0.02[34]\d* \+- 1?\de-0[56] ", output)
    assert re.search(r"delay \d.\d\d \+-", output)


def test_steps_of_physics(leg, monkeypatch):
    """Two fits bring armature and delay, which steps bias most, nearer to the truth than the better one alone."""
    monkeypatch.setattr(fit, "FINER", 2)
    monkeypatch.setattr(fit, "GENERATIONS", 2)
    recording = quiet(record(leg, sweep(6.0)))
    found = fit.identify(leg, recording, "cpu")
    second, *_ = fit.Problem(HangingRobots(leg, recording, "cpu", 2), recording).refine(NUMBERS, lambda: None)
    numbers, half = (np.append(each[0], each[4, 0]) for each in (found.values, found.half_widths))
    errors = [np.linalg.norm((each - NUMBERS[[0, 1, 2, 12]]) / half) for each in (numbers, second[[0, 1, 2, 12]])]
    assert errors[0] < 0.5 * errors[1], errors


def test_settings(found):
    """``--motors`` gives these numbers to trainings, which draw none of them, and to the simulated robot."""
    result, _, cfg = found
    for model in (load_asset(cfg).mj_model, SimRobot(cfg.asset.file, list(POSE), 500.0, motors=cfg.motors).model):
        joints = [getattr(model, field)[6:] for field in FIELDS.values()]
        np.testing.assert_allclose(joints, result["values"][:3], rtol=1e-3)
    assert (cfg.motors.delay.unit, cfg.motors.delay.range) == ("milliseconds", [5, 5])
    assert cfg.domain_rand.keep_fixed == ["dof_armature", "dof_damping", "dof_frictionloss"]
    assert cfg.domain_rand.joint_offset["add"][1] == pytest.approx(0.055, rel=0.05)


def test_a_file_of_motors(tmp_path):
    """A delay below zero is written as none, and what the file fixes adds to what a task does."""
    script = runpy.run_path(str(ROOT / "scripts" / "identify.py"))
    values = dict.fromkeys(PARAMETERS, np.ones(3)) | {"delay": -np.ones(3)}
    text = script["settings_text"](list(POSE), values, 0.005, FIELDS)
    (tmp_path / "found.yaml").write_text(text)
    cfg, _ = task_registry.get_cfgs("a1_torque")
    cfg.domain_rand.keep_fixed = ["gravity", "dof_damping"]
    choose_motors(cfg, str(tmp_path / "found.yaml"))
    fixed = ["gravity", "dof_damping", "dof_armature", "dof_frictionloss"]  # what the task has fixed stays so
    assert cfg.domain_rand.keep_fixed == fixed
    assert yaml.safe_load(text)["motors"]["delay"] == {"unit": "milliseconds", "range": [0, 0]}


def problem_of(leg, recording):
    """The problem of a recording."""
    return fit.Problem(HangingRobots(leg, recording, "cpu"), recording)


def test_intervals(leg):
    """Of 13 numbers in two logs, 23 or more are within their 95% intervals, and not all by far."""
    known, errors = record(leg, sweep(5.0)), []
    for seed in range(2):
        problem = problem_of(leg, noisy(known, seed))
        numbers, _, equations = problem.refine(NUMBERS * 1.01, lambda: None)
        errors.append(np.abs(numbers - NUMBERS) / problem.half_widths(numbers, equations))
    assert (np.array(errors) < 1.0).sum() >= 23 and (np.array(errors) > 0.3).sum() >= 7


STILL, STEADY = sweep(6.0, last=1.0), np.array(list(POSE.values())) + 1e-4 * np.arange(3000)[:, None]
STILL[:, 2] = POSE["FR_calf_joint"]


@pytest.mark.parametrize(
    ("targets", "bias", "problems"),
    [
        (STILL, -0.047, [f"{kind}_friction of FR_calf.* the joint hardly moves" for kind in ("viscous", "coulomb")]),
        (STEADY, -0.047, ["viscous_friction of (FR.*joint) .* told from coulomb_friction of", "delay"]),
        (STEADY, -0.047, ["armature of FR_calf_joint .*: the joint hardly accelerates"]),
        (sweep(6.0, amplitude=0.01), -0.047, ["delay .*: nothing moves fast"]),
        (sweep(6.0), -0.1, ["bias of FR_hip_joint is -0.1 or beyond"]),
    ],
)
def test_refused(leg, targets, bias, problems):
    """A joint at rest, a single low speed, a motion too small, a number at the end of what is searched."""
    problem = problem_of(leg, noisy(record(leg, targets)))
    numbers = np.where(NUMBERS == -0.047, bias, NUMBERS)
    parts = error_of(problem.half_widths, numbers, problem._linearized(numbers)[1]).split("; ")
    assert all(any(re.match(expected, part) for part in parts) for expected in problems), parts
    assert targets is not STILL or all(" of FR_calf_joint is known to +-" in part for part in parts)


sysid = pytest.importorskip("mujoco.sysid", reason="this MuJoCo has no sysid")
pytest.importorskip("colorama", reason="not installed: pip install 'mujoco[sysid]'")
STEP, THIGH = 5e-4, "FR_thigh_joint"


def test_same_as_sysid(leg):
    """Armature and Coulomb friction of the thigh, from its positions."""
    recording, spec, params = record(leg, sweep(2.0)), fixed(leg, STEP), sysid.ParameterDict()
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    for motor, bias in zip(spec.actuators, TRUTH[3], strict=True):
        motor.biastype, motor.biasprm[:3] = mujoco.mjtBias.mjBIAS_AFFINE, (20.0 * bias, -20.0, -0.5)
        motor.ctrllimited = False
    sensed = {"objtype": mujoco.mjtObj.mjOBJ_JOINT, "objname": THIGH}
    spec.add_sensor(name=THIGH, type=mujoco.mjtSensor.mjSENS_JOINTPOS, **sensed)
    for name, high in {"armature": 0.1, "frictionloss": 1.0}.items():
        change = lambda spec, to, name=name: setattr(spec.joint(THIGH), name, to.value[0])  # noqa: E731
        params.add(sysid.Parameter(name, 0.3 * high, min_value=1e-3 * high, max_value=high, modifier=change))
    model, substeps = spec.compile(), round(PERIOD / STEP)
    steps, ticks = np.arange(substeps * len(recording.commands)), np.arange(len(recording.commands))
    sent = np.maximum(steps - round(TRUTH[4, 0] / STEP), 0) // substeps
    control = sysid.TimeSeries(steps * STEP, 20.0 * recording.commands[sent, 1])
    seen = recording.measured[:, 0] + TRUTH[3]
    positions = sysid.TimeSeries.from_names(ticks * PERIOD + STEP, seen[:, 1:2], model)
    start = sysid.create_initial_state(model, seen[0], recording.measured[0, 1], np.zeros(0))
    sequences = sysid.ModelSequences("leg", spec, "sweep", start, control, positions)
    found, _ = sysid.optimize(params, sysid.build_residual_fn(models_sequences=[sequences]), verbose=False)
    numbers, _, _ = Problem(HangingRobots(leg, recording, "cpu"), recording).refine(1.02 * NUMBERS, lambda: None)
    np.testing.assert_allclose(numbers[[1, 7]], found.as_vector(), rtol=0.01)
