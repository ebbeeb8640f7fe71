"""The engine "fused": one kernel per physics step, for legged robots."""

from collections.abc import Sequence

import mujoco
import warp as wp
from torch import Tensor

from legged_torque.sim.engine import HeightMap
from legged_torque.sim.fused.collision_self import make_self_contacts, pair_kinds
from legged_torque.sim.fused.constraint import Contact
from legged_torque.sim.fused.layout import Layout, branches_of
from legged_torque.sim.fused.model import Model, State, make_model, unread_columns
from legged_torque.sim.fused.step import make_kernel
from legged_torque.sim.fused.surface import make_surface
from legged_torque.sim.fused.tree import read_tree
from legged_torque.sim.fused.types import branch_types, vec4
from legged_torque.sim.parallel import launch_worlds
from legged_torque.sim.warp_engine import WarpEngine
from legged_torque.utils.errors import UserError

BLOCK_DIM = 128  # threads per block: of 32, 64 and 128 the fastest in many worlds, in 4096 within 3% of it


class FusedEngine(WarpEngine):
    """Steps worlds by the kernel of :mod:`~legged_torque.sim.fused.step`, on MuJoCo Warp's arrays.

    A step without sensing leaves the contact sensors as they were.
    """

    name = "fused"
    capabilities = frozenset({"height_map", "self_collision", "applied_forces", "per_world"})

    def __init__(self, model: mujoco.MjModel, num_envs: int, device: str, height_map: HeightMap | None = None) -> None:
        """Build the worlds; kernels compile at the first step that needs them.

        The ground is the model's plane, or a height map with the plane's friction and softness. A UserError if the
        robot has something that this step does not simulate.
        """
        on_map = height_map is not None
        tree = read_tree(model, on_map=on_map)  # raises all reasons at once, before MuJoCo Warp raises its first
        super().__init__(model, num_envs, device)
        layout = Layout.of(tree, self._wp_device.is_cuda, on_map, pair_kinds(model))
        data, room = self._data, num_envs * layout.branches
        self._layout, self._has_forces = layout, False
        with wp.ScopedDevice(self._wp_device):
            self._struct = make_model(model, self._model, tree)
            self._tables.append(self._struct)
            self._ground = make_surface(height_map) if height_map is not None else 0
            self._state = State()
            for name in State.vars:
                setattr(self._state, name, getattr(data, name))
            self._scratch = scratch = branches_of(layout).Scratch()
            for name in ("residual", "pushing", "change"):
                setattr(scratch.contacts, name, wp.empty(room * layout.points, dtype=vec4))
            scratch.contacts.found = wp.empty(room * layout.points, dtype=Contact)
            if on_map:
                scratch.contacts.normal = wp.empty(room * layout.points, dtype=wp.vec3)
            if layout.self_kinds:
                scratch.selves = make_self_contacts(model, self._model, tree, data)
            waiting = room if layout.per_thread > 1 else 1
            scratch.branch = wp.empty(waiting, dtype=branch_types(layout.depth).Branch)

    def step(self, sense: bool = True) -> None:
        """Launch one physics step."""
        kernel, dim = make_kernel(self._layout, self._has_forces), (self.num_envs, self._layout.threads)
        inputs = [self._struct, self._ground, self._state, self._scratch, sense]
        launch_worlds(kernel, dim, inputs, self._wp_device, BLOCK_DIM)

    def applied_forces(self) -> tuple[Tensor, Tensor]:
        """Return the applied forces; from the first call on, the kernel reads them."""
        self._has_forces = True
        return super().applied_forces()

    def field(self, name: str, columns: Sequence[int] | None = None) -> Tensor:
        """Return a field; a UserError for columns of the trunk's free joint, and the pose of a floor that is a map."""
        field = super().field(name, columns)
        entries = [column // field[0, 0].numel() for column in columns or ()]
        if any(entry < unread_columns(name) for entry in entries):
            raise UserError(f"sim.engine 'fused' does not read '{name}' of the trunk's free joint")
        if self._layout.on_map and name in ("geom_pos", "geom_quat") and self._struct.floor in entries:
            raise UserError(f"sim.engine 'fused' does not read '{name}' of the floor: heights of a map are the world's")
        return field

    def _field_names(self) -> list[str]:
        """Return which fields of the model may differ from world to world: those that the kernel reads by world."""
        return [name for name in super()._field_names() if name in Model.vars]
