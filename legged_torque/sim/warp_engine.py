"""Base of engines on MuJoCo Warp's arrays: state, resets, divergence, parameters per world."""

import functools
import operator
from collections.abc import Sequence
from typing import Any

import mujoco
import mujoco_warp as mjw
import warp as wp
from torch import Tensor

from legged_torque.sim import kernels
from legged_torque.sim.engine import Engine, check_mask
from legged_torque.sim.fused.model import Model
from legged_torque.sim.fused.set_const import DerivedConstants
from legged_torque.sim.model import CONTACT_DATA, use_known_options
from legged_torque.utils.errors import UserError, check_names

_OF_LEGS = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat")
"""Fields on which the inverse weights of legs depend, apart from armatures."""
_TRUNK = 1  # its body
_BUFFERS = ("NEFC", "NJMAX_NNZ", "BROADPHASE", "NARROWPHASE", "CONTACT_MATCH")


class WarpEngine(Engine):
    """Worlds as rows of the arrays of a MuJoCo Warp ``Data``.

    Attributes:
        qacc_warmstart: Accelerations from which the constraint solver starts. Shape: (num_envs, nv).
        solver_niter: Iterations of the solver in the last physics step. Shape: (num_envs,), int32.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, device: str, contacts: int = 1, rows: int = 1) -> None:
        """Build the worlds, with room for so many contacts and constraint rows of MuJoCo Warp's own in each."""
        use_known_options(model)
        self.mj_model, self.num_envs, self.device = model, num_envs, device
        self._wp_device = wp.get_device(device)
        with wp.ScopedDevice(self._wp_device):
            try:
                self._model = mjw.put_model(model)
            except NotImplementedError as error:
                raise UserError(f"MuJoCo Warp cannot simulate this robot: {error}") from error
            self._model.opt.warn_overflow = 0  # it prints from inside kernels; check_buffers warns instead
            self._data = data = mjw.make_data(model, nworld=num_envs, nconmax=contacts, njmax=rows)
            self._diverged = wp.zeros(num_envs, dtype=wp.bool)
            self._overflow = wp.zeros(num_envs, dtype=wp.int32)
            self._reference_pose: wp.array = wp.array(model.qpos0, dtype=wp.float32)
        state = (data.qpos, data.qvel, data.qacc_warmstart, data.ctrl, data.solver_niter)
        self.qpos, self.qvel, self.qacc_warmstart, self.ctrl, self.solver_niter = map(wp.to_torch, state)
        self.diverged = wp.to_torch(self._diverged)
        sensors = wp.to_torch(data.sensordata).view(num_envs, -1, CONTACT_DATA)
        self.contact_found, self.contact_force = sensors[:, :, 0], sensors[:, :, 1:]
        self.fields: dict[str, Tensor] = {}
        self._carried: dict[str, Tensor] = {}  # what worlds carry besides their state, cleared by a reset
        self._tables: list[Model] = []  # structs of kernels that refer to the model's arrays

    def reset(self, mask: Tensor) -> None:
        """Reset worlds in one kernel, and what else they carry."""
        check_mask(self, mask)
        data = self._data
        state = (data.qpos, data.qvel, data.qacc_warmstart, data.ctrl, data.sensordata)
        inputs = [wp.from_torch(mask), self._reference_pose, *state]
        wp.launch(kernels.reset_worlds, self.num_envs, inputs, device=self._wp_device)
        for tensor in self._carried.values():
            tensor.view(self.num_envs, -1).masked_fill_(mask.unsqueeze(1), 0.0)

    def flag_diverged(self) -> None:
        """Mark the worlds whose state is not finite or absurdly large; MuJoCo Warp has no such check."""
        data = self._data
        state = [data.qpos, data.qvel, data.qacc_warmstart, data.ctrl, data.overflow, self._diverged, self._overflow]
        wp.launch(kernels.flag_diverged, data.qpos.shape, state, device=self._wp_device)

    def check_buffers(self) -> str | None:
        """Return a warning that names the buffers which were full."""
        bits = functools.reduce(operator.or_, wp.to_torch(self._overflow).unique().tolist())
        names = [name for name in _BUFFERS if mjw.OverflowType[name] & bits]
        if not names:
            return None
        return f"simulation buffers overflowed ({', '.join(names)}): some contacts were ignored"

    def state_dict(self) -> dict[str, Tensor]:
        """Return everything on which the next steps of the worlds depend, as references to the engine's memory."""
        names = ("qpos", "qvel", "qacc_warmstart", "ctrl", "contact_found", "contact_force", "diverged")
        return {name: getattr(self, name) for name in names} | self._carried | self.fields

    def applied_forces(self) -> tuple[Tensor, Tensor]:
        """Return MuJoCo's ``xfrc_applied`` and ``qfrc_applied``, which act from the first call on."""
        for name in ("xfrc_applied", "qfrc_applied"):
            self._carried[name] = wp.to_torch(getattr(self._data, name))
        return self._carried["xfrc_applied"], self._carried["qfrc_applied"]

    def field(self, name: str, columns: Sequence[int] | None = None) -> Tensor:
        """Return a field; constants of legs are recomputed from now on if other bodies than the trunk may change."""
        check_names(f"field for sim.engine '{self.name}'", [name], self._field_names())
        constants = self._constants  # while worlds are alike
        if name not in self.fields:
            self._give_rows(name)
        field = self.fields[name]
        width = field[0, 0].numel()
        if name in _OF_LEGS and (columns is None or any(column // width != _TRUNK for column in columns)):
            constants.vary_branches()
        return field

    def update_constants(self, mask: Tensor) -> None:
        """Recompute inverse weights."""
        check_mask(self, mask)
        self._constants.update(mask)

    @functools.cached_property
    def _constants(self) -> DerivedConstants:
        """What recomputes the fields that follow from masses and armatures."""
        for name in ("body_invweight0", "dof_invweight0"):
            self._give_rows(name)
        constants = DerivedConstants(self.mj_model, self._model, self.num_envs)
        self._tables.append(constants.model)
        return constants

    def _field_names(self) -> list[str]:
        """Return which fields of the model may differ from world to world: those to which MuJoCo Warp gives rows.

        The reference pose is not one of them: resets and inverse weights are those of the model's.
        """
        annotations = {**mjw.Model.__annotations__, "gravity": mjw.Option.__annotations__["gravity"]}
        shapes = {name: getattr(kind, "shape", ("",)) for name, kind in annotations.items()}
        return [name for name, shape in shapes.items() if shape[0] == "*" and name != "qpos0"]

    def _give_rows(self, name: str) -> None:
        """Replace a field that all worlds share by one with a row per world, all equal at first."""
        owner: Any = self._model.opt if name == "gravity" else self._model
        shared = getattr(owner, name)
        values = shared.numpy().repeat(self.num_envs, axis=0)
        rows: wp.array = wp.array(values, dtype=shared.dtype, device=shared.device)
        for each in (owner, *self._tables):
            if hasattr(each, name):
                setattr(each, name, rows)
        self.fields[name] = wp.to_torch(rows)
