"""The interface of physics engines."""

from collections.abc import Sequence
from typing import Any, ClassVar, Protocol

import mujoco
import numpy as np
import torch
from torch import Tensor

from legged_torque.utils.buffers import check_tensor
from legged_torque.utils.errors import UserError, check_names

CAPABILITIES = {
    "height_map": "takes ground that is not a plane as a HeightMap, not as a hfield in its model",
    "self_collision": "lets parts of a robot collide with each other",
    "applied_forces": "has Engine.applied_forces",
    "per_world": "has Engine.field and what belongs to it: parameters of the model that differ from world to world",
}
"""Optional abilities of engines."""


class HeightMap(Protocol):
    """Ground that is not a plane: heights on a square grid in the world frame, with two triangles per cell.

    A cell's diagonal runs from sample (i, j) to (i + 1, j + 1), as in MuJoCo's hfield. All worlds have the same map.
    """

    heights: np.ndarray  # [m]; rows along x, columns along y, two or more of each
    horizontal_scale: float  # distance between neighbouring samples [m]
    corner: tuple[float, float]  # x and y of sample (0, 0) [m]


class Engine(Protocol):
    """Steps and resets ``num_envs`` worlds of one robot.

    An engine is a subclass with these members and an entry in :data:`~legged_torque.sim.registry.ENGINES`. It inherits
    a :meth:`check_buffers` that never warns, and methods of the capabilities that it lacks, which raise a UserError.

    Tensors are the engine's own memory: writing them changes the state, and their addresses never change. Nothing here
    waits for the host except :meth:`check_buffers`.

    Attributes:
        name: Name in ``sim.engine``.
        capabilities: Those of :data:`CAPABILITIES` that it has.
        mj_model: The robot, as MuJoCo's model.
        num_envs: Number of worlds.
        device: "cpu" or "cuda:N".
        notes: What a user should know of this engine with this robot, one line each.
        qpos: Positions: trunk position [m], trunk quaternion (w, x, y, z), joints [rad]. Shape: (num_envs, nq).
        qvel: Velocities: trunk linear (world frame) [m/s], trunk angular (trunk frame) [rad/s], joints [rad/s].
            Shape: (num_envs, nv).
        ctrl: Torques of the motors [N m] in the model's order, which is that of the joints for robots of tasks; times
            gear, if a motor has one. Shape: (num_envs, nu).
        contact_found: Number of contacts of each sensed geom with the floor or other parts of the robot, as of the
            start of the last physics step; undefined after a step that did not sense. Shape: (num_envs, geoms).
        contact_force: Net contact force on each sensed geom in the world frame [N], of the same step.
            Shape: (num_envs, geoms, 3).
        diverged: Worlds that :meth:`flag_diverged` has marked. Shape: (num_envs,), bool.
        fields: The fields that :meth:`field` has returned and those that follow from them, by name.
    """

    name: ClassVar[str]
    capabilities: ClassVar[frozenset[str]]
    mj_model: mujoco.MjModel
    num_envs: int
    device: str
    notes: Sequence[str] = ()
    qpos: Tensor
    qvel: Tensor
    ctrl: Tensor
    contact_found: Tensor
    contact_force: Tensor
    diverged: Tensor
    fields: dict[str, Tensor]

    def __init__(self, model: mujoco.MjModel, num_envs: int, device: str, **options: Any) -> None:
        """Build the worlds, all in the reference pose of a model with contact sensors (four numbers each).

        ``model.opt`` has the most iterations of the constraint solver and of its line search. Engines with the
        capability "height_map" take ``height_map`` in ``options``, the ground in place of the model's plane. A
        UserError if the engine cannot simulate this robot.
        """

    def step(self, sense: bool = True) -> None:
        """Advance every world by one physics step under the torques in ``ctrl``, and update the contact sensors.

        Of several steps, only the last one needs to ``sense``. A world with a NaN in ``ctrl`` steps without torques, as
        in ``mj_step``.
        """

    def reset(self, mask: Tensor) -> None:
        """Put the worlds of ``mask`` (num_envs,), bool, back to the reference pose, at rest.

        Everything that they carry from step to step is cleared, warm starts and applied forces included. A UserError,
        here and in :meth:`update_constants`, for a mask of another device, type or shape.
        """

    def flag_diverged(self) -> None:
        """Mark the worlds whose state is not finite or absurdly large, or whose torques are not finite."""

    def check_buffers(self) -> str | None:
        """Return a warning if contacts or constraints were dropped since the start because a buffer was full.

        Waits for the device: not for the hot path.
        """

    def state_dict(self) -> dict[str, Tensor]:
        """Return everything on which the next steps of the worlds depend, as references to the engine's memory."""

    # ---- "applied_forces" --------------------------------------------------------------------------------------------

    def applied_forces(self) -> tuple[Tensor, Tensor]:
        """Return MuJoCo's ``xfrc_applied`` and ``qfrc_applied``, which act from the first call on.

        The first holds the force [N] at the centre of mass of each body and the torque [N m] on it, in the world frame;
        the second holds generalized forces. Shapes: (num_envs, nbody, 6), (num_envs, nv).
        """
        raise lacks(self, "applied_forces")

    # ---- "per_world" -------------------------------------------------------------------------------------------------

    def field(self, name: str, columns: Sequence[int] | None = None) -> Tensor:
        """Return a field of the model with a row per world, which it gets at the first request, to change ``columns``.

        These are numbers of a row, all entries flattened; None stands for all. The first request must precede the first
        step that is captured into a graph. Shape: (num_envs, ...). A UserError if the engine does not read the field,
        or one of the columns.
        """
        raise lacks(self, "per_world")

    def update_constants(self, mask: Tensor) -> None:
        """Recompute what MuJoCo derives from masses and armatures, after these changed in the worlds of ``mask``.

        Shape: (num_envs,), bool.
        """
        raise lacks(self, "per_world")


def check_mask(engine: Engine, mask: Tensor) -> None:
    """Raise a UserError unless a mask of worlds fits an engine: a kernel would read memory that is none of it."""
    check_tensor("a mask of worlds", mask, (engine.num_envs,), engine.device, torch.bool)


def lacks(engine: Engine | type[Engine], capability: str, what: str = "this") -> UserError:
    """Return the error for ``what`` needs a capability that an engine does not have."""
    return UserError(f"sim.engine '{engine.name}' lacks the capability '{capability}', which {what} needs")


def require(engine: Engine | type[Engine], capability: str, what: str) -> None:
    """Raise a UserError that names engine, capability, and ``what`` needs it, unless the engine has it."""
    if capability not in engine.capabilities:
        raise lacks(engine, capability, what)


def shared_field(engine: Engine, name: str, columns: Sequence[int] | None = None) -> Tensor:
    """Return a copy of a field of the model that all worlds share; a UserError if there is none. Shape: (1, ...)."""
    owner: Any = engine.mj_model.opt if name == "gravity" else engine.mj_model
    known = [field for field in dir(owner) if isinstance(getattr(owner, field), np.ndarray)]
    check_names("field of MuJoCo's model", [name], known)
    return torch.tensor(getattr(owner, name), dtype=torch.float32, device=engine.device).unsqueeze(0)
