"""Tests that every physics engine passes, as far as its capabilities go."""

import mujoco
import numpy as np
import pytest
import torch
from support.control import LEGS, SENSED, WEIGHT, contacts_by_hand
from support.fused import ROBOTS, assert_applied_forces_act, compiled, draw_states, make_a1, put, random, step_mujoco

from legged_torque.sim.engine import CAPABILITIES
from legged_torque.sim.registry import ENGINES, make_engine
from legged_torque.utils.buffers import copy_state
from legged_torque.utils.errors import UserError

FEET = [i for i, name in enumerate(SENSED) if name.endswith("foot")]
LEG_UP = (0.0, 2.6, -0.95)
"""Angles of a leg that points up, away from the floor."""
STATE = ("qpos", "qvel", "ctrl", "contact_found", "contact_force")
USES = {
    "applied_forces": lambda sim: sim.applied_forces(),
    "per_world": lambda sim: sim.field("body_mass"),
    "height_map": lambda sim: make_engine(sim.name, sim.mj_model, 1, height_map=object()),
}
"""Tests that need a capability."""


def steep_capsule_touches(model, data):
    """Whether a capsule touches the floor at more than about 60 degrees.

    MuJoCo turns the contact's tangents along the capsule, MuJoCo Warp falls back to the world's axes there. With a
    pyramidal friction cone this gives another, equally valid approximation, which is no matter of accuracy.
    """
    capsules = (g for g in data.contact.geom.ravel() if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE)
    return any(abs(data.geom_xmat[g][8]) > 0.85 for g in capsules)


class EngineSuite:
    """One engine is a subclass that names it."""

    engine: str
    tolerance: float
    """Of the worst velocity after one step of random torques [m/s, rad/s]; half of them are 100 times as accurate."""
    pushed = "a1"
    """The robot of :data:`ROBOTS` whose bodies and joints are pushed."""
    height: tuple[float, float] = (0.1, 0.3)
    """Heights of trunks [m] from which all contacts are MuJoCo's."""

    def make(self, num_envs, model=None, iterations=(30, 50)):
        """Worlds of the A1, or another robot."""
        return make_engine(self.engine, compiled(make_a1()) if model is None else model, num_envs, "cpu", *iterations)

    def need(self, capability):
        """Leave a test out that needs a capability that the engine lacks."""
        if capability not in ENGINES[self.engine].capabilities:
            pytest.skip(f"{self.engine} lacks {capability}")

    def scattered(self, num_envs, seed=3, lowest=0.2, iterations=(30, 50)):
        """Worlds in different states: low and high, bent and moving."""
        sim, generator = self.make(num_envs, None, iterations), torch.Generator().manual_seed(seed)
        home = torch.tensor(sim.mj_model.key_qpos[0], dtype=torch.float32)
        sim.qpos.copy_(home)
        sim.qpos[:, 2] = torch.linspace(lowest, lowest + 0.2, num_envs)
        sim.qpos[:, 7:] += 0.1 * torch.randn(num_envs, 12, generator=generator)
        sim.qvel.copy_(0.3 * torch.randn(num_envs, 18, generator=generator))
        return sim

    def test_matches_plain_mujoco(self):
        """Over 200 steps of random torques every world moves as plain MuJoCo does from the same state.

        The reference starts anew from the world's state with every step. The tolerance is for the worst step, when
        contacts begin or slip. Positions must agree to the tolerance times the physics step, contacts exactly, their
        forces to 1%.
        """
        tolerance, generator = self.tolerance, torch.Generator().manual_seed(2)
        sim = self.scattered(4, iterations=(100, 50))
        model, references = sim.mj_model, [mujoco.MjData(sim.mj_model) for _ in range(4)]
        errors, in_contact = [], 0
        for step in range(200):
            sim.ctrl.copy_(8.0 * torch.randn(sim.ctrl.shape, generator=generator).clamp(-4.0, 4.0))
            for world, data in enumerate(references):
                data.qpos[:], data.qvel[:], data.ctrl[:] = sim.qpos[world], sim.qvel[world], sim.ctrl[world]
                mujoco.mj_step(model, data)
            sim.step()
            for world, data in enumerate(references):
                if self.engine == "mujoco_warp" and steep_capsule_touches(model, data):
                    continue
                where = f"step {step}, world {world}"
                in_contact += data.ncon > 0
                errors.append(np.abs(sim.qvel[world].numpy() - data.qvel).max())
                assert errors[-1] <= tolerance, where
                np.testing.assert_allclose(sim.qpos[world], data.qpos, rtol=0, atol=0.005 * tolerance, err_msg=where)
                found, force = contacts_by_hand(model, data)
                np.testing.assert_array_equal(sim.contact_found[world], found, err_msg=where)
                error = np.abs(sim.contact_force[world].numpy() - force).max()
                assert error <= 0.01 * max(np.abs(force).max(), WEIGHT), where
        assert np.median(errors) < 0.01 * self.tolerance
        assert len(errors) > 0.85 * 800 and in_contact > 0.5 * 800

    def test_worlds_do_not_interact(self):
        """A world in contact moves to the bit alike next to any neighbours, also next to one that is not finite."""
        torques, trajectories = torch.tensor(random((20, 12), -12.0, 12.0)), []
        for height in (0.15, 5.0, float("nan")):
            sim = self.scattered(2)
            sim.qpos[:, 2] = torch.tensor([height, 0.2])
            touched = 0
            for torque in torques:
                sim.ctrl.copy_(torque)
                sim.step()
                touched += int(sim.contact_found[1].any())
            trajectories.append(torch.cat([sim.qpos, sim.qvel], dim=1))
            assert touched > 5
        assert not torch.equal(trajectories[0][0], trajectories[1][0])
        assert torch.equal(trajectories[0][1], trajectories[1][1]) and torch.equal(*[t[1] for t in trajectories[1:]])

    def test_standing_robot_presses_its_weight(self):
        """Forces on the feet of a standing robot sum up to its weight; other parts and one in the air feel nothing."""
        sim = self.make(3)
        home = torch.tensor(sim.mj_model.key_qpos[0], dtype=torch.float32)
        sim.qpos.copy_(home)
        sim.qpos[2, 2] = 100.0
        for _ in range(320):
            sim.ctrl.copy_(40.0 * (home[7:] - sim.qpos[:, 7:]) - sim.qvel[:, 6:])
            sim.step()
        found, force = sim.contact_found, sim.contact_force
        assert (force[:2, FEET, 2] > 5.0).all() and (sim.qpos[:2, 2] > 0.22).all()
        np.testing.assert_allclose(force[:2, :, 2].sum(dim=1), WEIGHT, rtol=0.02)
        np.testing.assert_allclose(force[:2, :, :2].sum(dim=1), 0.0, atol=0.02 * WEIGHT)
        others = [i for i in range(len(SENSED)) if i not in FEET]
        assert (found[:2][:, FEET] == 1).all() and (found[2] == 0).all() and (force[2] == 0).all()
        assert (found[:2][:, others] == 0).all() and (force[:2][:, others] == 0).all()

    @pytest.mark.parametrize(
        ("height", "leg_angles", "parts"),
        [
            (0.053, LEG_UP, ()),  # the trunk is 0.057 m thick below its origin
            (0.333, (0.0, 0.0, -0.95), ("foot",)),  # 0.2 + 0.2 cos(0.95) + 0.02 = 0.3363 m below the trunk
            (0.213, (0.0, 0.0, -2.6), ("thigh",)),  # its end is 0.217 m below the trunk, the calf's 0.21 m
            (0.207, (0.0, 0.0, -2.6), ("thigh", "calf")),
        ],
    )
    def test_contact_columns(self, height, leg_angles, parts):
        """In world i only leg i reaches the floor, with known parts: exactly these parts' columns say so."""
        sim = self.make(4)
        for world in range(4):
            angles = [LEG_UP] * 4
            angles[world] = leg_angles
            sim.qpos[world] = torch.tensor([0, 0, height, 1, 0, 0, 0, *np.ravel(angles)])
        sim.step()
        for world, leg in enumerate(LEGS):
            touching = {SENSED[i] for i in sim.contact_found[world].nonzero().flatten()}
            assert touching == ({f"{leg}_{part}" for part in parts} or {"trunk"})
            pressed = {SENSED[i] for i in sim.contact_force[world, :, 2].nonzero().flatten()}
            assert pressed and pressed <= touching and (sim.contact_force[world, :, 2] >= 0).all()

    def test_steps_that_do_not_sense(self):
        """Steps without sensing move the worlds bitwise alike; a step that senses after them senses the same."""
        sims = [self.scattered(2) for _ in range(2)]
        for sense, torque in zip((True, False, False, True), random((4, 12), -12.0, 12.0), strict=True):
            for sim, senses in zip(sims, (True, sense), strict=True):
                sim.ctrl.copy_(torch.tensor(torque))
                sim.step(senses)
            assert torch.equal(sims[0].qpos, sims[1].qpos) and torch.equal(sims[0].qvel, sims[1].qvel)
            assert sims[0].contact_force.any()
            if sense:
                assert torch.equal(sims[0].contact_force, sims[1].contact_force)

    @pytest.mark.parametrize("worlds", [[0], [1, 3], [0, 1, 2, 3]])
    def test_reset_touches_only_masked_worlds(self, worlds):
        """A reset puts worlds at rest into the reference pose; the others go on unchanged."""
        sim, twin = (self.scattered(4, lowest=0.1) for _ in range(2))
        torques, mask = torch.tensor(random((8, 4, 12), -12.0, 12.0)), torch.zeros(4, dtype=torch.bool)
        mask[worlds] = True

        def steps(some):
            for torque in some:
                for each in (sim, twin):
                    each.ctrl.copy_(torque)
                    each.step()

        steps(torques[:3])
        assert twin.contact_found.any(dim=1).all()
        sim.reset(mask)
        for name, before in twin.state_dict().items():
            after = sim.state_dict()[name]
            assert torch.equal(after[~mask], before[~mask]), name
            if name in STATE[1:]:
                assert (before[mask] != 0).any() and (after[mask] == 0).all(), name
        np.testing.assert_allclose(sim.qpos[mask], [sim.mj_model.qpos0] * len(worlds), atol=1e-6)
        steps(torques[3:])
        for name in STATE:
            assert torch.equal(getattr(sim, name)[~mask], getattr(twin, name)[~mask]), name

    @pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e30, -1e30, 1e12])
    @pytest.mark.parametrize("field", ["qpos", "qvel", "qacc_warmstart"])
    def test_divergence_is_flagged(self, field, value):
        """One bad number anywhere in the state flags its world and no other, until the flags are cleared."""
        sim = self.make(3)
        sim.qpos[0, :2], sim.qvel[0, 6:], sim.qacc_warmstart[0, 6:] = 1000.0, 100.0, 1e6  # large, but possible
        sim.flag_diverged()
        assert not sim.diverged.any()
        state = getattr(sim, field)
        for entry in (0, state.shape[1] - 1):
            good = state[1, entry].clone()
            state[1, entry] = value
            sim.flag_diverged()
            state[1, entry] = good
            sim.flag_diverged()
            assert sim.diverged.tolist() == [False, True, False]
            sim.diverged.zero_()
            assert not sim.diverged.any()

    @pytest.mark.parametrize("motor", [0, 11])
    def test_a_torque_that_is_no_number(self, motor):
        """A NaN in ``ctrl`` acts as in MuJoCo, which stops all motors of that world, and flags the world."""
        sim = self.make(3)
        model, states = sim.mj_model, draw_states(sim.mj_model, 3, self.height)
        states["ctrl"][1, motor] = np.nan
        put(sim, states)
        sim.step()
        sim.flag_diverged()
        assert sim.diverged.tolist() == [False, True, False]
        np.testing.assert_allclose(sim.qvel, step_mujoco(model, states)[0], rtol=0, atol=self.tolerance)

    @pytest.mark.parametrize(
        "mask", [torch.ones(2, dtype=torch.bool, device="meta"), torch.ones(2), torch.ones(3, dtype=torch.bool)]
    )
    def test_masks_that_do_not_fit(self, mask):
        """A mask of another device, type or shape is refused, and nothing is reset."""
        sim = self.scattered(2)
        before = sim.qpos.clone()
        for use in [sim.reset] + [sim.update_constants] * ("per_world" in sim.capabilities):
            with pytest.raises(UserError, match=r"must be bool \(2,\) on cpu, not"):
                use(mask)
        assert torch.equal(sim.qpos, before)

    def test_a_reset_removes_bad_numbers(self):
        """A world that was not finite goes on after a reset as one that always was, to the bit."""
        sims = [self.scattered(3) for _ in range(2)]
        sims[0].qvel[1, 7] = float("nan")
        for sim in sims:
            sim.step()
            sim.reset(torch.tensor([False, True, False]))
            sim.step()
        assert torch.isfinite(sims[0].qvel).all() and torch.equal(sims[0].qvel, sims[1].qvel)

    def test_state_goes_on(self):
        """Another engine of the same kind goes on from the state of the first as that does, to the bit."""
        first, second = self.scattered(4), self.scattered(4, seed=9)
        if "per_world" in first.capabilities:
            first.field("body_mass")[:, 1] = torch.tensor([3.0, 4.0, 5.0, 6.0])
            first.update_constants(torch.ones(4, dtype=torch.bool))
            second.field("body_mass")
        for _ in range(5):
            first.step()
        first.diverged[2] = True
        kept = {name: tensor.clone() for name, tensor in first.state_dict().items()}
        copy_state(second.state_dict(), kept)
        assert second.diverged.tolist() == [False, False, True, False]
        for sim in (first, second):
            for _ in range(5):
                sim.step()
        for name, tensor in first.state_dict().items():
            assert torch.equal(tensor, second.state_dict()[name]), name
        assert not torch.equal(first.qpos, kept["qpos"])

    @pytest.mark.parametrize("capability", USES)
    def test_what_lacks_is_refused(self, capability):
        """An engine's capabilities are known ones; one that it lacks is refused by both names."""
        sim = self.make(1)
        assert sim.capabilities <= set(CAPABILITIES)
        if capability not in sim.capabilities:
            with pytest.raises(UserError, match=f"'{self.engine}' lacks the capability '{capability}'"):
                USES[capability](sim)

    def test_applied_forces(self):
        """Wrenches on all bodies and forces on all degrees of freedom act as in MuJoCo, until a reset."""
        self.need("applied_forces")
        model = compiled(ROBOTS[self.pushed]())
        states = draw_states(model, 20, self.height)
        sim = self.make(20, model, iterations=(100, 50))
        assert_applied_forces_act(sim, model, states)
        mask = torch.arange(20) == 3
        sim.reset(mask)
        for applied in sim.applied_forces():
            assert (applied[mask] == 0.0).all() and applied[~mask].any() == applied.any()

    def test_parameters_per_world(self):
        """Worlds with rows of their own move as MuJoCo's models with these numbers; writing them acts at once."""
        self.need("per_world")
        model = compiled(make_a1())
        states = {name: values.repeat(3, axis=0) for name, values in draw_states(model, 1, self.height).items()}
        tables = {
            "dof_damping": random((3, 18), 0.0, 2.0) * (np.arange(18) > 5),
            "body_mass": random((3, 14), 0.5, 5.0),
            "geom_friction": random((3, 18, 3), 0.3, 1.0),
            "dof_armature": random((3, 18), 0.01, 0.05) * (np.arange(18) > 5),
            "gravity": random((3, 3), -9.0, 3.0),
        }
        sim = self.make(3, model, iterations=(100, 50))
        for name, values in tables.items():
            sim.field(name).copy_(torch.tensor(values))
        for _ in range(2):
            put(sim, states)
            sim.step()
            for world in range(3):
                for name, values in tables.items():
                    getattr(model.opt if name == "gravity" else model, name)[:] = values[world]
                expected = step_mujoco(model, states)[0][0]
                np.testing.assert_allclose(sim.qvel[world], expected, rtol=0, atol=2e-3)
            assert np.abs(np.diff(sim.qvel.numpy(), axis=0)).max(axis=1).min() > 0.1
            tables["dof_damping"] = 0.5 * tables["dof_damping"]
            sim.field("dof_damping").mul_(0.5)

    def test_derived_constants(self):
        """Inverse weights follow masses and armatures, in the worlds of the mask, as by mj_setConst."""
        self.need("per_world")
        model = compiled(ROBOTS["crab"]())
        sim, mask = self.make(3, model), torch.tensor([True, False, True])
        sim.field("body_mass")[:, 1:] *= torch.tensor(random((3, model.nbody - 1), 0.5, 2.0))
        sim.field("dof_armature")[:, 6:] += torch.tensor(random((3, model.nv - 6), 0.0, 0.1))
        before = model.body_invweight0.copy(), model.dof_invweight0.copy()
        derived = [sim.field(name) for name in ("body_invweight0", "dof_invweight0")]
        for values in derived:
            values[mask] = torch.where(values[mask] == 0.0, 0.0, torch.inf)  # the world's are 0
        sim.update_constants(mask)
        for world in range(3):
            model.body_mass[:], model.dof_armature[:] = sim.field("body_mass")[world], sim.field("dof_armature")[world]
            mujoco.mj_setConst(model, mujoco.MjData(model))
            exact = (model.body_invweight0, model.dof_invweight0) if mask[world] else before
            for values, expected in zip(derived, exact, strict=True):
                np.testing.assert_allclose(values[world], expected, rtol=2e-5)

    @pytest.mark.parametrize(("name", "nearest"), [("body_mas", "body_mass"), ("qpos0", "")])
    def test_unknown_fields(self, name, nearest):
        """A field that does not exist, or that is not read everywhere by world, is refused by its name."""
        self.need("per_world")
        with pytest.raises(UserError, match=f"unknown field for sim.engine '{self.engine}' '{name}'.*{nearest}"):
            self.make(1).field(name)
