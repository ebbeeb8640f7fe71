"""The engines of the package: what all of them must do, and what is special about each."""

import numpy as np
import pytest
import torch
from support.control import LEGS, SENSED
from support.engine_suite import LEG_UP, EngineSuite
from support.fused import compiled, make_a1

from legged_torque.sim import mjwarp
from legged_torque.sim.registry import make_engine
from legged_torque.terrain.height_grid import HeightGrid
from legged_torque.utils.errors import UserError


class TestFused(EngineSuite):
    """One kernel per step."""

    engine, tolerance, pushed = "fused", 2e-3, "crab"  # whose kernel test_fused.py needs as well

    @pytest.mark.parametrize("name", ["geom_margin", "actuator_gainprm"])
    def test_fields_that_are_not_read(self, name):
        """Fields that the kernel does not read cannot be had per world; MuJoCo Warp's own step takes them."""
        with pytest.raises(UserError, match=f"unknown field for sim.engine 'fused' '{name}'"):
            self.make(2).field(name)
        assert len(make_engine("mujoco_warp", compiled(make_a1()), 2).field(name)) == 2

    @pytest.mark.parametrize("name", ["dof_damping", "dof_armature", "dof_frictionloss", "jnt_stiffness"])
    def test_the_free_joint_is_not_read(self, name):
        """Parameters of the trunk's free joint would not act and are refused; MuJoCo Warp's own step reads them."""
        sim, last_of_trunk = self.make(2), 0 if name == "jnt_stiffness" else 5
        sim.field(name, [last_of_trunk + 1])
        with pytest.raises(UserError, match=f"does not read '{name}' of the trunk's free joint"):
            sim.field(name, [last_of_trunk + 1, last_of_trunk])
        make_engine("mujoco_warp", compiled(make_a1()), 2).field(name, [last_of_trunk])


def put_deep_into_the_floor(sim):
    """Fill the buffers: every geom in the floor at all its points, every joint beyond a limit."""
    sim.qpos[:] = torch.tensor([0, 0, -0.3, 1, 0, 0, 0, *(1.0, -1.2, -2.8) * 4])
    sim.qvel.zero_()


class TestMuJoCoWarp(EngineSuite):
    """MuJoCo Warp's own step, which has buffers of limited size; the fused step has room for all."""

    engine, tolerance, height = "mujoco_warp", 1e-2, (1.0, 2.0)

    def test_buffers_suffice_for_the_worst_case(self):
        """With all contacts and all limits active at once, in all worlds, nothing is dropped."""
        sim = self.make(3)
        put_deep_into_the_floor(sim)
        sim.step()
        sim.flag_diverged()
        assert sim.check_buffers() is None
        for world in range(3):
            found = dict(zip(SENSED, sim.contact_found[world].tolist(), strict=True))
            assert found.pop("trunk") >= 4
            assert found == {name: 1 if name.endswith(("foot", "hip")) else 2 for name in found}  # spheres, capsules

    @pytest.mark.parametrize("on_map", [False, True], ids=["plane", "map"])
    def test_feet_that_are_larger(self, on_map):
        """They meet the ground where those of a robot do whose file has their size."""
        found, forces = [], []
        for radius, own in ((0.02, 0.03), (0.03, 0.03)):
            spec = make_a1()
            for geom in spec.geoms:
                if geom.name.endswith("foot"):
                    geom.size[0] = radius
                elif geom.name != "floor":
                    geom.contype = geom.conaffinity = 0
            if on_map:
                HeightGrid(np.zeros((3, 3)), 1.0, (-1.0, -1.0)).add_to(spec, "floor")
            sim = self.make(2, compiled(spec))
            sizes, feet = sim.field("geom_size"), [sim.mj_model.geom(f"{leg}_foot").id for leg in LEGS]
            sizes[1, feet, 0] = own
            sim.qpos.copy_(torch.tensor([0, 0, 0.343, 1, 0, 0, 0, *(0.0, 0.0, -0.95) * 4]))  # feet 27 mm high
            sim.step()
            found.append(sim.contact_found)
            forces.append(sim.contact_force)
        assert not found[0][0].any() and found[0][1].all()
        assert torch.equal(found[0][1], found[1][1]) and torch.equal(forces[0][1], forces[1][1])

    @pytest.mark.parametrize(
        ("buffer", "size", "name"), [("max_contacts", 6, "NARROWPHASE"), ("max_constraints", 20, "NEFC")]
    )
    def test_full_buffers_are_reported(self, monkeypatch, buffer, size, name):
        """A buffer that is too small in one world is named, even after that world has been reset."""
        monkeypatch.setattr(mjwarp, buffer, lambda *_: size)
        sim = self.make(2)
        put_deep_into_the_floor(sim)
        sim.qpos[:, 2], sim.qpos[:, 7:] = 10.0, torch.tensor(LEG_UP * 4)
        sim.step()
        sim.flag_diverged()
        assert sim.check_buffers() is None  # nothing touches the floor, and no joint is at its limit
        put_deep_into_the_floor(sim)
        sim.qpos[0, 2] = 10.0
        sim.step()
        sim.flag_diverged()
        sim.reset(torch.tensor([True, True]))
        sim.step()
        sim.flag_diverged()
        assert name in sim.check_buffers()


def test_unknown_engine():
    """One line names the engines."""
    with pytest.raises(UserError, match=r"unknown sim.engine 'fuse'; did you mean 'fused'.*mujoco_warp"):
        make_engine("fuse", compiled(make_a1()), 1)
