"""MuJoCo Warp's own step: for any robot that MuJoCo Warp can simulate."""

from __future__ import annotations

import mujoco
import mujoco_warp as mjw
import warp as wp

_NO_SENSORS = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)


class WarpStep:
    """Steps all worlds of a MuJoCo Warp ``Data``.

    Attributes:
        carried: What worlds carry from one step to the next beside their states: constraint rows that are not used
            now, whose NaN would spoil a world, since the solver multiplies them by zero.
    """

    def __init__(self, model: mjw.Model, data: mjw.Data) -> None:
        """Keep model and data on the device."""
        self._model, self._data = model, data
        self.carried = (wp.to_torch(data.efc.J), wp.to_torch(data.efc.force))
        self._device = data.qpos.device
        self._flags = model.opt.disableflags
        if self._device.is_cuda:
            model.opt.graph_conditional = False  # unrolled solver iterations are faster than a device loop

    def __call__(self, sense: bool) -> None:
        """Advance every world by one physics step; ``sense`` says whether to write the contact sensors."""
        self._model.opt.disableflags = self._flags if sense else self._flags | _NO_SENSORS
        with wp.ScopedDevice(self._device):
            mjw.step(self._model, self._data)
