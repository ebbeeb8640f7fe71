"""The batched MuJoCo Warp simulator: many worlds of one robot, as torch tensors on the simulator's own memory."""

from __future__ import annotations

import functools
import operator

import mujoco
import mujoco_warp as mjw
import warp as wp
from torch import Tensor

from legged_torque.sim.graph import prepare_device
from legged_torque.sim.model import CONTACT_DATA, max_constraints, max_contacts

MAX_POSITION = 1e4
"""Largest position [m, rad] of a world that is still believed."""
MAX_VELOCITY = 1e4
"""Largest velocity [m/s, rad/s] of a world that is still believed."""
MAX_ACCELERATION = 1e10
"""Largest acceleration [m/s^2, rad/s^2] of a world that is still believed."""
_NO_SENSORS = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
_BUFFER_FLAGS = (
    mjw.OverflowType.NEFC,
    mjw.OverflowType.NJMAX_NNZ,
    mjw.OverflowType.BROADPHASE,
    mjw.OverflowType.NARROWPHASE,
    mjw.OverflowType.CONTACT_MATCH,
)


class Simulator:
    """Steps and resets ``num_envs`` worlds.

    All tensors are views of the simulator's memory: writing them changes the state. Nothing here waits for the host
    except :meth:`check_buffers`.

    Attributes:
        qpos: Positions: trunk position [m], trunk quaternion (w, x, y, z), joints [rad]. Shape: (num_envs, nq).
        qvel: Velocities: trunk linear (world frame) [m/s], trunk angular (trunk frame) [rad/s], joints [rad/s].
            Shape: (num_envs, nv).
        qacc_warmstart: Accelerations from which the constraint solver starts. Shape: (num_envs, nv).
        ctrl: Joint torques [N m]. Shape: (num_envs, nu).
        contact_found: Number of contacts of each sensed geom with the floor, as of the start of the last physics step;
            0 after a step that did not sense. Shape: (num_envs, geoms).
        contact_force: Net contact force on each sensed geom in the world frame [N], likewise.
            Shape: (num_envs, geoms, 3).
        diverged: Worlds whose state was seen to be not finite or absurdly large since the last :meth:`clear_diverged`.
            Shape: (num_envs,), bool.
    """

    def __init__(
        self, model: mujoco.MjModel, num_envs: int, device: str, solver_iterations: int, ls_iterations: int
    ) -> None:
        """Build the worlds, all in the model's reference pose.

        Args:
            model: Model of one world, see :func:`~legged_torque.sim.model.load_model`.
            num_envs: Number of worlds.
            device: "cpu" or "cuda:N".
            solver_iterations: Most iterations of the constraint solver per physics step.
            ls_iterations: Most iterations of its line search.
        """
        self.mj_model = model
        self.num_envs = num_envs
        self.device = device
        prepare_device(device)
        self._wp_device = wp.get_device(device)
        contacts = max_contacts(model)
        self.mj_model.opt.iterations = solver_iterations
        self.mj_model.opt.ls_iterations = ls_iterations
        with wp.ScopedDevice(self._wp_device):
            self.model = mjw.put_model(model)
            self.model.opt.warn_overflow = 0  # it prints from inside kernels; check_buffers tells instead
            if self._wp_device.is_cuda:
                self.model.opt.graph_conditional = False  # unrolled solver iterations are faster than a device loop
            self._flags = self.model.opt.disableflags
            self.data = mjw.make_data(model, nworld=num_envs, nconmax=contacts, njmax=max_constraints(model, contacts))
            self._diverged = wp.zeros(num_envs, dtype=wp.bool)
            self._reset_mask = wp.zeros(num_envs, dtype=wp.bool)
            self._overflow = wp.zeros(num_envs, dtype=wp.int32)
        self.qpos = wp.to_torch(self.data.qpos)
        self.qvel = wp.to_torch(self.data.qvel)
        self.qacc_warmstart = wp.to_torch(self.data.qacc_warmstart)
        self.ctrl = wp.to_torch(self.data.ctrl)
        self.diverged = wp.to_torch(self._diverged)
        sensors = wp.to_torch(self.data.sensordata).view(num_envs, -1, CONTACT_DATA)
        self.contact_found = sensors[:, :, 0]
        self.contact_force = sensors[:, :, 1:]

    def step(self, sense: bool = True) -> None:
        """Advance every world by one physics step under the torques in ``ctrl``.

        Args:
            sense: Whether to update the contact sensors; of several steps, only the last one needs to.
        """
        self.model.opt.disableflags = self._flags if sense else self._flags | _NO_SENSORS
        with wp.ScopedDevice(self._wp_device):
            mjw.step(self.model, self.data)

    def reset(self, mask: Tensor) -> None:
        """Put worlds back to the reference pose, at rest, with every buffer cleared, warm starts included.

        Args:
            mask: Which worlds. Shape: (num_envs,), bool.
        """
        wp.to_torch(self._reset_mask).copy_(mask)
        with wp.ScopedDevice(self._wp_device):
            mjw.reset_data(self.model, self.data, reset=self._reset_mask)

    def clear_diverged(self) -> None:
        """Forget which worlds have diverged."""
        self.diverged.zero_()

    def flag_diverged(self) -> None:
        """Mark the worlds whose state is not finite or absurdly large; MuJoCo Warp has no such check."""
        wp.launch(
            _flag_diverged,
            dim=self.num_envs,
            inputs=[self.data.qpos, self.data.qvel, self.data.qacc_warmstart, self.data.overflow],
            outputs=[self._diverged, self._overflow],
            device=self._wp_device,
        )

    def check_buffers(self) -> str | None:
        """Return a warning if contacts or constraints were dropped since the start because a buffer was full.

        Waits for the device: not for the hot path.
        """
        bits = functools.reduce(operator.or_, wp.to_torch(self._overflow).unique().tolist())
        names = [flag.name for flag in _BUFFER_FLAGS if flag & bits]
        if not names:
            return None
        return f"simulation buffers overflowed ({', '.join(names)}): some contacts were ignored"


@wp.kernel(enable_backward=False)
def _flag_diverged(
    qpos: wp.array2d(dtype=wp.float32),
    qvel: wp.array2d(dtype=wp.float32),
    qacc: wp.array2d(dtype=wp.float32),
    overflow: wp.array(dtype=wp.int32),
    diverged: wp.array(dtype=wp.bool),
    overflow_seen: wp.array(dtype=wp.int32),
):
    """Check one world; comparisons are written so that NaN fails them."""
    world = wp.tid()
    good = bool(True)  # a variable; Warp would take True for a constant
    for i in range(qpos.shape[1]):
        good = good and wp.abs(qpos[world, i]) <= wp.static(MAX_POSITION)
    for i in range(qvel.shape[1]):
        good = good and wp.abs(qvel[world, i]) <= wp.static(MAX_VELOCITY)
        good = good and wp.abs(qacc[world, i]) <= wp.static(MAX_ACCELERATION)
    if not good:
        diverged[world] = True
    overflow_seen[world] = overflow_seen[world] | overflow[world]
