"""The engine "mujoco_warp": MuJoCo Warp's own step, for any robot that it can simulate."""

from collections.abc import Sequence

import mujoco
import mujoco_warp as mjw
import warp as wp
from torch import Tensor

from legged_torque.sim import kernels
from legged_torque.sim.fused.tree import SLOWER, reasons_against
from legged_torque.sim.model import max_constraints, max_contacts
from legged_torque.sim.warp_engine import WarpEngine

_NO_SENSORS = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)


class MuJoCoWarpEngine(WarpEngine):
    """Steps the worlds with about a hundred kernels. A step without sensing sets the contact sensors to zero."""

    name = "mujoco_warp"
    capabilities = frozenset({"self_collision", "applied_forces", "per_world"})

    def __init__(self, model: mujoco.MjModel, num_envs: int, device: str) -> None:
        """Build the worlds; a UserError if MuJoCo Warp cannot simulate this robot."""
        contacts = max_contacts(model)
        super().__init__(model, num_envs, device, contacts, max_constraints(model, contacts))
        reasons = "; ".join(reasons_against(model))
        why = f"which cannot simulate this robot: {reasons}" if reasons else "which can simulate this robot"
        self.notes = [f"sim.engine 'mujoco_warp' steps worlds, {SLOWER} than 'fused', {why}"]
        # Rows of constraints that are not in use: the solver multiplies them by zero, so that a NaN would stay.
        self._carried = {"efc.J": wp.to_torch(self._data.efc.J), "efc.force": wp.to_torch(self._data.efc.force)}
        self._flags = self._model.opt.disableflags
        if self._wp_device.is_cuda:
            self._model.opt.graph_conditional = False  # unrolled solver iterations are faster than a device loop

    def step(self, sense: bool = True) -> None:
        """Launch one physics step."""
        self._model.opt.disableflags = self._flags if sense else self._flags | _NO_SENSORS
        with wp.ScopedDevice(self._wp_device):
            wp.launch(kernels.clear_nan_ctrl, self.num_envs, [self._data.ctrl, self._diverged])
            mjw.step(self._model, self._data)

    def field(self, name: str, columns: Sequence[int] | None = None) -> Tensor:
        """Return a field; pairs of geoms are not sorted out by their file's sizes any more if these may change."""
        if name == "geom_size":
            self._model.opt.broadphase_filter = 0
            bounds = wp.to_torch(self._model.geom_rbound)  # which height fields and sorted geoms read, too
            bounds[bounds > 0.0] = mujoco.mjMAXVAL  # 0 stands for planes
        return super().field(name, columns)
