"""Contacts between parts of a robot, against plain MuJoCo."""

import mujoco
import numpy as np
import pytest
import torch
import warp
from support.fused import assert_alike, compiled, put, step_fused, step_mujoco
from support.on_device import assert_matches
from support.robot_files import read_robot
from support.settings import error_of

from legged_torque.envs.base.asset import load_asset
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.sim.fused.collision_self import MAX_SELF_CONTACTS
from legged_torque.sim.registry import make_engine
from legged_torque.utils.mjcf import self_pairs

GEOM = mujoco.mjtGeom


def make_spec(edit=None):
    """The specification of a robot with two legs of two joints and a tail of one, all parts of which may collide."""
    spec = read_robot("folding")
    if edit is not None:
        edit(spec)
    return spec


def draw_states(model, num, seed=0):
    """States with joints anywhere in their ranges, moving, under torques."""
    rng = np.random.default_rng(seed)
    qpos = np.tile(model.qpos0, (num, 1))
    qpos[:, 2] = rng.uniform(0.15, 0.5, num)
    qpos[:, 3:7] += rng.normal(0.0, 0.3, (num, 4))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    qpos[:, 7:] = rng.uniform(*model.jnt_range[1:].T, (num, model.nq - 7))
    states = {
        "qpos": qpos,
        "qvel": rng.normal(0.0, 1.0, (num, model.nv)),
        "ctrl": rng.normal(0.0, 10.0, (num, model.nu)),
    }
    states["qacc_warmstart"] = rng.normal(0.0, 30.0, (num, model.nv))
    return {name: values.astype(np.float32).astype(float) for name, values in states.items()}


def touching(model, states):
    """Pairs of geoms of the robot that touch in each state, as plain MuJoCo says."""
    data, found = mujoco.MjData(model), []
    for world in range(len(states["qpos"])):
        data.qpos[:] = states["qpos"][world]
        mujoco.mj_fwdPosition(model, data)
        pairs = data.contact.geom.reshape(-1, 2)
        found.append([tuple(pair) for pair in pairs[(model.geom_bodyid[pairs] > 0).all(axis=1)].tolist()])
    return found


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    """No other test needs these kernels: half of the time to compile them, for few steps."""
    monkeypatch.setattr(warp.config, "optimization_level", 0)


@pytest.fixture(scope="module")
def thrown():
    """The model, states, and what touches in them."""
    model = compiled(make_spec())
    states = draw_states(model, 400)
    return model, states, touching(model, states)


def test_matches_plain_mujoco(thrown):
    """All types of pairs, between legs and of legs with the trunk, push as in plain MuJoCo; a ``<pair>`` as it says."""
    model, states, touches = thrown
    pairs = [pair for found in touches for pair in found]
    kinds = [tuple(sorted(model.geom_type[list(pair)].tolist())) for pair in pairs]
    sphere, capsule, box = int(GEOM.mjGEOM_SPHERE), int(GEOM.mjGEOM_CAPSULE), int(GEOM.mjGEOM_BOX)
    for kind in ((sphere, sphere), (sphere, capsule), (sphere, box), (capsule, capsule), (capsule, box), (box, box)):
        assert kinds.count(kind) >= 4, kind
    named = [frozenset(pair) for pair in zip(model.pair_geom1, model.pair_geom2, strict=True)]
    assert len(named) == 2 and all([frozenset(pair) for pair in pairs].count(pair) > 4 for pair in named)
    limbs = [{model.body(model.geom_bodyid[geom]).name[:2] for geom in pair} for pair in pairs]
    assert min(limbs.count({"tr", "Fs"}), limbs.count({"tr", "Rs"}), limbs.count({"Fs", "Rs"})) > 20
    expected, actual = step_mujoco(model, states), step_fused(model, states)
    assert_matches(model, states, actual, expected)
    error = np.abs(actual[0] - expected[0]).max(axis=1)
    assert np.median(error) < 5e-6 and np.quantile(error, 0.98) < 5e-4
    without = compiled(make_spec(lambda spec: [setattr(g, "contype", 0) for g in spec.geoms if g.name != "floor"]))
    touched = np.array([bool(found) for found in touches])
    assert (np.abs(step_mujoco(without, states)[0] - expected[0]).max(axis=1)[touched] > 0.1).mean() > 0.9


def add_beads(number):
    """Add spheres to the front shin that touch only each other's like on the rear shin, not the floor."""

    def add(spec):
        for body, count in (("Fshin", number), ("Rshin", 1)):
            for i in range(count):
                bead = spec.body(body).add_geom(name=f"{body}{i}", type=GEOM.mjGEOM_SPHERE, size=(0.2, 0, 0), mass=0.01)
                bead.contype, bead.conaffinity, bead.pos = 4, 4, (0.003 * i, 0.0, -0.05)

    return add


def test_geoms_that_the_floor_lets_through():
    """They touch each other as well, and their sensors see it."""
    model = compiled(make_spec(add_beads(3)))
    states = draw_states(model, 40, seed=1)
    expected = step_mujoco(model, states)
    beads = [i - 1 for i in range(model.ngeom) if model.geom_contype[i] == 4]
    assert (expected[2][:, beads].sum(axis=1) >= 6).mean() > 0.9
    assert_alike(model, states, step_fused(model, states), expected)


def test_too_many_contacts_are_reported():
    """Of more contacts than there is room for the first ones count, and a warning says so."""
    for number, warning in ((1, None), (MAX_SELF_CONTACTS + 1, "NARROWPHASE")):
        model = compiled(make_spec(add_beads(number)))
        sim = make_engine("fused", model, 8, "cpu", 100, 50)
        put(sim, draw_states(model, 8, seed=1))
        sim.step()
        sim.flag_diverged()
        assert torch.isfinite(sim.qvel).all()
        said = sim.check_buffers()
        assert said is None if warning is None else warning in said


def settings_of(file, on):
    """Settings of a task with this robot."""
    cfg = LeggedRobotCfg()
    cfg.asset.file, cfg.asset.self_collisions = str(file), on
    cfg.init_state.default_joint_angles = dict.fromkeys(("F1", "F2", "R1", "R2", "tail"), 0.0)
    return cfg


def test_option(tmp_path, thrown):
    """Whatever the file lets collide, parts of the robot touch each other only if the settings want it."""
    (tmp_path / "robot.xml").write_text(make_spec(lambda spec: setattr(spec.body("tail"), "name", "")).to_xml())
    on, off = (load_asset(settings_of(tmp_path / "robot.xml", value)) for value in (True, False))
    assert on.notes == [note for note in on.notes if "asset.self_collisions" not in note]
    pairs = len(self_pairs(on.mj_model))
    assert f"{pairs} pairs of parts that could collide do not; asset.self_collisions=True lets them" in off.notes
    _, states, touches = thrown
    assert pairs > 20 and touching(on.mj_model, states) == touches and not any(touching(off.mj_model, states))
    floor = [step_mujoco(asset.mj_model, states)[2] for asset in (on, off)]
    assert (floor[1] > 0).any() and floor[0].sum() > floor[1].sum() and not (floor[0] < floor[1]).any()


def test_option_without_effect(tmp_path):
    """A file that lets no parts collide is refused, when the settings want it."""
    file = tmp_path / "robot.xml"

    def part(spec):
        for geom in spec.geoms[1:]:
            geom.contype = 0
        for pair in list(spec.pairs):
            spec.delete(pair)

    file.write_text(make_spec(part).to_xml())
    assert "asset.self_collisions is on, but in" in error_of(load_asset, settings_of(file, True))


def test_pairs_are_mujocos(thrown):
    """Pairs of bodies that a file excludes, parents with their children, and parts of one body are none."""
    model, states, _ = thrown
    everywhere = {frozenset(pair) for pair in self_pairs(model).tolist()}
    some = compiled(make_spec(lambda spec: spec.add_exclude(bodyname1="Fshin", bodyname2="Rshin")))
    assert len(everywhere) - len(self_pairs(some)) == 3  # shin and foot of both, but for the <pair>
    for one, other in (("hull", "Fthigh"), ("Fthigh", "Fshin"), ("hull", "head"), ("Fshin", "Ffoot")):
        assert frozenset((model.geom(one).id, model.geom(other).id)) not in everywhere
    seen = {frozenset(pair) for found in touching(some, states) for pair in found}
    assert len(seen) > 10 and seen <= {frozenset(pair) for pair in self_pairs(some).tolist()}
