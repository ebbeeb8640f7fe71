"""The batched MuJoCo Warp simulator: many worlds of one robot, as torch tensors on the simulator's own memory."""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from typing import Any

import mujoco
import mujoco_warp as mjw
import warp as wp
from torch import Tensor

from legged_torque.sim import kernels
from legged_torque.sim.fused.set_const import DerivedConstants
from legged_torque.sim.fused.step import FusedStep
from legged_torque.sim.fused.tables import FUSED_FIELDS, unread_columns
from legged_torque.sim.fused.tree import find_floor, read_tree
from legged_torque.sim.graph import prepare_device
from legged_torque.sim.height_map import HeightMap
from legged_torque.sim.model import CONTACT_DATA, max_constraints, max_contacts, use_known_options
from legged_torque.sim.per_world import check_fields, expand, owner
from legged_torque.sim.robot_file import actuator_problems
from legged_torque.sim.warp_step import WarpStep
from legged_torque.utils.errors import UserError, refuse, unknown_name

ENGINES = ("fused", "mujoco_warp")
"""What may step the worlds: one kernel per step for legged robots, or MuJoCo Warp for any robot."""

_BUFFERS = ("NEFC", "NJMAX_NNZ", "BROADPHASE", "NARROWPHASE", "CONTACT_MATCH")


class Simulator:
    """Steps and resets ``num_envs`` worlds.

    All tensors are views of the simulator's memory: writing them changes the state. Nothing here waits for the host
    except :meth:`check_buffers`.

    Attributes:
        qpos: Positions: trunk position [m], trunk quaternion (w, x, y, z), joints [rad]. Shape: (num_envs, nq).
        qvel: Velocities: trunk linear (world frame) [m/s], trunk angular (trunk frame) [rad/s], joints [rad/s].
            Shape: (num_envs, nv).
        qacc_warmstart: Accelerations from which the constraint solver starts. Shape: (num_envs, nv).
        ctrl: Torques of the motors [N m] in the model's order, which is that of the joints for robots of tasks; times
            gear, if a motor has one. Shape: (num_envs, nu).
        contact_found: Number of contacts of each sensed geom with the floor or other parts of the robot, as of the
            start of the last physics step; after one that does not sense, it is what it was ("fused") or 0
            ("mujoco_warp"). Shape: (num_envs, geoms).
        contact_force: Net contact force on each sensed geom in the world frame [N], likewise.
            Shape: (num_envs, geoms, 3).
        diverged: Worlds whose state was seen to be not finite or absurdly large since the last :meth:`clear_diverged`.
            Shape: (num_envs,), bool.
        is_fused: Whether the engine is "fused", which has :meth:`drive`.
        xfrc_applied: Force [N] at the centre of mass of each body and torque [N m] on it, in the world frame; zeros
            unless written. None without ``applied_forces``. Shape: (num_envs, nbody, 6).
        qfrc_applied: Generalized forces, likewise. Shape: (num_envs, nv).
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        device: str,
        engine: str = "fused",
        solver_iterations: int = 30,
        ls_iterations: int = 20,
        per_world: Sequence[str] = (),
        applied_forces: bool = False,
        height_map: HeightMap | None = None,
    ) -> None:
        """Build the worlds on "cpu" or "cuda:N", all in the reference pose of a model with contact sensors.

        Each has its own rows of the fields ``per_world``, "gravity" among them. Iterations of the constraint solver,
        and of its line search, are the most per physics step. With ``applied_forces``, ``xfrc_applied`` and
        ``qfrc_applied`` act. The ground of "fused" is a height map instead of the model's plane, if there is one; for
        "mujoco_warp" the model has it as a hfield. A UserError if the engine, one of :data:`ENGINES`, is unknown or
        cannot simulate this robot, or does not read one of the fields.
        """
        if engine not in ENGINES:
            raise unknown_name("sim.engine", engine, ENGINES)
        if height_map is not None and engine != "fused":
            raise ValueError("only the fused engine takes a height map; the model of others has a hfield")
        refuse(list(actuator_problems(model)), f"sim.engine '{engine}' needs motors")
        if engine == "fused":
            read_tree(model)  # tells all reasons at once, before MuJoCo Warp tells its first one
        use_known_options(model)
        self.mj_model, self.num_envs, self.device = model, num_envs, device
        prepare_device(device)
        self._wp_device = wp.get_device(device)
        contacts = max_contacts(model) if engine == "mujoco_warp" else 1  # the fused step keeps its contacts itself
        self.mj_model.opt.iterations = solver_iterations
        self.mj_model.opt.ls_iterations = ls_iterations
        with wp.ScopedDevice(self._wp_device):
            try:
                self.model = mjw.put_model(model)
            except NotImplementedError as error:
                raise UserError(f"MuJoCo Warp cannot simulate this robot: {error}") from error
            self.model.opt.warn_overflow = 0  # it prints from inside kernels; check_buffers tells instead
            rows = max_constraints(model, contacts, any_friction="dof_frictionloss" in per_world)
            self.data = mjw.make_data(model, nworld=num_envs, nconmax=contacts, njmax=rows)
            check_fields(self.model, per_world, FUSED_FIELDS if engine == "fused" else None)
            for name in per_world:
                expand(self.model, name, num_envs)
            self._diverged = wp.zeros(num_envs, dtype=wp.bool)
            self._overflow = wp.zeros(num_envs, dtype=wp.int32)
            self._reference_pose: wp.array = wp.array(model.qpos0, dtype=wp.float32)
        self._constants = DerivedConstants(model, self.model, num_envs) if per_world else None
        self.is_fused = engine == "fused"
        self._is_on_map = height_map is not None
        if self.is_fused:
            self._step: FusedStep | WarpStep = FusedStep(model, self.model, self.data, applied_forces, height_map)
        else:
            self._step = WarpStep(self.model, self.data)
        state = (self.data.qpos, self.data.qvel, self.data.qacc_warmstart, self.data.ctrl)
        self.qpos, self.qvel, self.qacc_warmstart, self.ctrl = map(wp.to_torch, state)
        self.diverged = wp.to_torch(self._diverged)
        sensors = wp.to_torch(self.data.sensordata).view(num_envs, -1, CONTACT_DATA)
        self.contact_found, self.contact_force = sensors[:, :, 0], sensors[:, :, 1:]
        derived = ("body_invweight0", "dof_invweight0") if per_world else ()
        self.derived = [self.field(name) for name in derived]  # what update_constants has written, to be saved
        forces = tuple(map(wp.to_torch, (self.data.xfrc_applied, self.data.qfrc_applied))) if applied_forces else ()
        self.xfrc_applied, self.qfrc_applied = forces or (None, None)
        self._fields = (*per_world, *derived)
        self._carried = [tensor.view(num_envs, -1) for tensor in (*forces, *self._step.carried)]

    def field(self, name: str) -> Tensor:
        """Return a writable field of the model, one that was asked for ``per_world``. Shape: (num_envs, ...)."""
        return wp.to_torch(getattr(owner(self.model, name), name))

    def check_columns(self, name: str, columns: Sequence[int]) -> None:
        """Refuse numbers of a world's part of a field, all entries behind each other, that the engine never reads.

        A UserError for those of the trunk's free joint with "fused", and for the place of a floor that is a height map.
        """
        width = self.field(name)[0, 0].numel()
        unread = unread_columns(name) * width if self.is_fused else 0
        if any(column < unread for column in columns):
            raise UserError(f"sim.engine 'fused' does not read '{name}' of the trunk's free joint")
        is_place = self._is_on_map and name in ("geom_pos", "geom_quat")
        if is_place and find_floor(self.mj_model) in [column // width for column in columns]:
            raise UserError(f"sim.engine 'fused' does not read '{name}' of the floor: heights of a map are the world's")

    def vary_legs(self) -> None:
        """Also recompute per-leg constants, see :func:`~legged_torque.sim.randomization.changes_legs`.

        Without this they follow from the trunk's mass and from armatures only.
        """
        self._derived_constants().vary_branches()

    def update_constants(self, mask: Tensor) -> None:
        """Recompute what MuJoCo derives from masses and armatures, after these changed in the worlds of ``mask``.

        Shape: (num_envs,), bool; see :meth:`vary_legs`.
        """
        self._derived_constants().update(wp.from_torch(mask))

    def _derived_constants(self) -> Any:
        """Return what recomputes them; only worlds with fields of their own have it."""
        if self._constants is None:
            raise ValueError("all worlds share one model: no field was asked for per_world")
        return self._constants

    def step(self, sense: bool = True) -> None:
        """Advance every world by one physics step under the torques in ``ctrl``, and update the contact sensors.

        Of several steps, only the last one needs to ``sense``.
        """
        self._step(sense)

    def drive(self, steps: int, law: wp.Function, reads: Any) -> None:
        """Advance every world by some physics steps, each under torques of its own; the last one senses.

        Before each of them, ``law(reads, world, motor, step, position, velocity)`` gives the torque of a motor [N m],
        which is written to ``ctrl``; ``step`` counts from 0, position [rad] and velocity [rad/s] are its joint's.
        ``reads`` is an instance of the Warp struct that the law's first argument is. Only the fused engine does this.
        """
        if not isinstance(self._step, FusedStep):
            raise ValueError("only the fused engine computes torques itself")
        self._step.drive(steps, law, reads)

    def reset(self, mask: Tensor) -> None:
        """Put the worlds of ``mask`` (num_envs,), bool, back to the reference pose, at rest.

        All that they carry from step to step is cleared, warm starts and applied forces included.
        """
        data = self.data
        state = (data.qpos, data.qvel, data.qacc_warmstart, data.ctrl, data.sensordata)
        self._launch(kernels.reset_worlds, wp.from_torch(mask), self._reference_pose, *state)
        for rows in self._carried:
            rows.masked_fill_(mask.unsqueeze(1), 0.0)

    def push(self, mask: Tensor, velocity: Tensor, add: Tensor) -> None:
        """Change the velocities of trunks in the worlds of ``mask``. Shape: (num_envs,), bool.

        ``velocity`` in the world frame [m/s] (num_envs, 3) is added where ``add`` (num_envs,), bool, says so; elsewhere
        it replaces the trunk's own.
        """
        drawn = (wp.from_torch(mask), wp.from_torch(velocity), wp.from_torch(add))
        self._launch(kernels.push, *drawn, self.data.qvel)

    def clear_diverged(self) -> None:
        """Forget which worlds have diverged."""
        self.diverged.zero_()

    def flag_diverged(self) -> None:
        """Mark the worlds whose state is not finite or absurdly large; MuJoCo Warp has no such check."""
        data = self.data
        state = [data.qpos, data.qvel, data.qacc_warmstart, data.overflow, self._diverged, self._overflow]
        wp.launch(kernels.flag_diverged, data.qpos.shape, state, device=self._wp_device)

    def state_dict(self) -> dict[str, Tensor]:
        """Return everything on which the next steps of the worlds depend, as references to the simulator's memory."""
        names = ("qpos", "qvel", "qacc_warmstart", "ctrl", "contact_found", "contact_force", "diverged")
        state = {name: getattr(self, name) for name in names} | {name: self.field(name) for name in self._fields}
        return state | {f"carried_{i}": tensor for i, tensor in enumerate(self._carried)}

    def check_buffers(self) -> str | None:
        """Return a warning if contacts or constraints were dropped since the start because a buffer was full.

        Waits for the device: not for the hot path.
        """
        bits = functools.reduce(operator.or_, wp.to_torch(self._overflow).unique().tolist())
        names = [name for name in _BUFFERS if mjw.OverflowType[name] & bits]
        if not names:
            return None
        return f"simulation buffers overflowed ({', '.join(names)}): some contacts were ignored"

    def _launch(self, kernel: wp.Kernel, *arrays: Any) -> None:
        """Run a kernel once per world."""
        wp.launch(kernel, dim=self.num_envs, inputs=arrays, device=self._wp_device)
