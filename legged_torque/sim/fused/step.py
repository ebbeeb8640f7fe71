"""Physics steps as one kernel: a group of threads per world, one thread per branch.

MuJoCo Warp runs a step as some hundred small kernels, which wait for each other and for memory. A legged robot on
the ground is small: a trunk and a few branches of hinge joints that meet only there. Here a thread holds a branch in
registers from kinematics to integration, and the threads of a world add up what concerns the trunk.

A launch may do several steps, each under torques that a Warp function computes from the state of the joints.
"""

import functools
from typing import Any

import mujoco
import mujoco_warp as mjw
import warp as wp

from legged_torque.sim.fused.applied import apply_to_trunk
from legged_torque.sim.fused.branches import FIRST_TOLERANCE, LINE_SEARCH_TOLERANCE, Layout, around_solver, in_solver
from legged_torque.sim.fused.contact import Contact, plane_contacts
from legged_torque.sim.fused.integrate import integrate_trunk
from legged_torque.sim.fused.map_contact import Ground, make_ground, map_contacts
from legged_torque.sim.fused.smooth import make_trunk, trunk_pose
from legged_torque.sim.fused.tables import Tables, Worlds, make_tables
from legged_torque.sim.fused.tree import check_map, read_tree
from legged_torque.sim.fused.trunk import TrunkMotion, solve_trunk, trunk_residual, trunk_slopes, whole_body
from legged_torque.sim.fused.types import branch_types, vec4
from legged_torque.sim.height_map import HeightMap
from legged_torque.sim.parallel import launch_worlds

BLOCK_DIM = 128  # threads per block: of 32, 64 and 128 the fastest in many worlds, in 4096 within 3% of it
EXACT_STEP = wp.constant(1.0)
"""A step that promises less than this decrease of the cost, in MuJoCo's units, is exact in float32 for our purposes."""


class FusedStep:
    """Steps all worlds of a MuJoCo Warp ``Data``, on its own arrays.

    Attributes:
        carried: What worlds carry from one step to the next beside their states: nothing.
    """

    carried: tuple[()] = ()

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        model: mjw.Model,
        data: mjw.Data,
        applied_forces: bool = False,
        height_map: HeightMap | None = None,
    ) -> None:
        """Read the robot's structure; the kernels compile at the first step that needs them.

        Parameters that change in ``model``, the one on the device, act at once; ``xfrc_applied`` and ``qfrc_applied``
        of ``data`` act with ``applied_forces``. The ground is the model's plane, or a height map, of which that plane
        says how it feels. A UserError if the robot has something that this step does not simulate.
        """
        tree = read_tree(mj_model, on_map=height_map is not None)
        self._device = data.qpos.device
        if height_map is not None:
            check_map(mj_model)
        layout = Layout.of(tree, self._device.is_cuda, height_map is not None)
        room = data.nworld * layout.branches
        with wp.ScopedDevice(self._device):
            tables = make_tables(mj_model, model, tree)
            self._scratch = [wp.empty(room * layout.points, dtype=dtype) for dtype in (Contact, vec4, vec4, vec4)]
            waiting = room if layout.per_lane > 1 else 1  # a GPU's threads have one branch each
            self._scratch.append(wp.empty(waiting, dtype=branch_types(layout.depth).Branch))
            ground = make_ground(height_map, room * layout.points) if height_map is not None else 0
        self._model = [tables, ground, mj_model.opt.iterations, mj_model.opt.ls_iterations]
        self._data = [data.ctrl, data.qpos, data.qvel, data.qacc_warmstart, data.sensordata, data.solver_niter]
        self._data += [data.xfrc_applied, data.qfrc_applied]
        self._kernel_for = layout, applied_forces
        self._dim = data.nworld, layout.lanes

    def __call__(self, sense: bool) -> None:
        """Advance every world by one physics step; ``sense`` says whether to write the contact sensors."""
        self._launch(range(1), sense, None, 0)

    def drive(self, steps: int, law: wp.Function, reads: Any) -> None:
        """Advance every world by some physics steps, each under torques of its own; see :meth:`Simulator.drive`.

        On a GPU each step is a launch: within one, worlds drift apart, and threads at different places of this long
        kernel wait for its instructions (one launch for four steps takes 1.1 to 1.6 times as long on an H200).
        """
        step_by_step = [range(i, i + 1) for i in range(steps)]
        for part in step_by_step if self._device.is_cuda else [range(steps)]:
            self._launch(part, part.stop == steps, law, reads)

    def _launch(self, steps: range, sense: bool, law: wp.Function | None, reads: Any) -> None:
        """Run the kernel for some steps, the last of which may sense."""
        inputs = [*self._model, steps.start, steps.stop, sense, reads, *self._data, *self._scratch]
        kernel = make_kernel(*self._kernel_for, law)
        launch_worlds(kernel, self._dim, inputs, self._device, BLOCK_DIM)


@functools.cache
def make_kernel(layout: Layout, applied_forces: bool, law: wp.Function | None = None) -> wp.Kernel:
    """Return the kernel for a robot's structure, with or without forces that a user applies, and a law for torques."""
    around, solver, lanes = around_solver(layout, applied_forces, law), in_solver(layout), layout.lanes
    Reads = next(iter(law.input_types.values())) if law else wp.int32  # what the law reads: its first argument
    Branch = branch_types(layout.depth).Branch
    GroundType = Ground if layout.on_map else wp.int32  # a plane is in the tables
    gather = map_contacts if layout.on_map else plane_contacts

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options={"fast_math": True})
    def fused_step(
        first_world: int,
        # Model:
        tables: Tables,
        ground: GroundType,
        iterations: int,
        ls_iterations: int,
        # In:
        first_step: int,
        end_step: int,
        sense: bool,
        reads: Reads,
        # Data in, or out with a law:
        ctrl: wp.array2d(dtype=float),
        # Data in and out:
        qpos: wp.array2d(dtype=float),
        qvel: wp.array2d(dtype=float),
        qacc_warmstart: wp.array2d(dtype=float),
        # Data out:
        sensordata: wp.array2d(dtype=float),
        solver_niter: wp.array(dtype=int),
        # Data in, unless there are none:
        xfrc_applied: wp.array2d(dtype=wp.spatial_vector),
        qfrc_applied: wp.array2d(dtype=float),
        # Scratch:
        found: wp.array(dtype=Contact),
        residuals: wp.array(dtype=vec4),
        pushing: wp.array(dtype=vec4),
        changes: wp.array(dtype=vec4),
        kept: wp.array(dtype=Branch),
    ):
        place, lane = wp.tid()
        world = first_world + place
        worlds = Worlds(ctrl, qpos, qvel, qacc_warmstart, sensordata, xfrc_applied, qfrc_applied)
        contacts = gather(tables, world, ground, found, residuals, pushing, changes)
        for i in range(first_step, end_step):
            trunk = make_trunk(tables, worlds, world)
            if wp.static(applied_forces):
                trunk = apply_to_trunk(tables, worlds, world, trunk, trunk_pose(trunk))
            acc = TrunkMotion()
            acc.lin = wp.vec3(qacc_warmstart[world, 0], qacc_warmstart[world, 1], qacc_warmstart[world, 2])
            acc.ang = wp.vec3(qacc_warmstart[world, 3], qacc_warmstart[world, 4], qacc_warmstart[world, 5])
            around.drive_all(tables, worlds, world, lane, i, reads)
            branch, total = around.make_all(tables, worlds, world, lane, trunk, acc, contacts, kept)
            whole = whole_body(trunk, total, wp.static(lanes))
            used = int(0)
            for _iteration in range(iterations):
                used += 1
                branch, system = solver.assemble_all(world, lane, branch, kept, trunk.rot, acc, contacts)
                residual = trunk_residual(whole, acc)
                step = solve_trunk(whole, residual, system, wp.static(lanes))
                branch, slopes = solver.turn_all(world, lane, branch, kept, trunk.rot, step, contacts)
                start = slopes + trunk_slopes(whole, residual, step)
                decrease = -start[0] * tables.cost_scale
                if used > 1 and not (decrease > tables.tolerance):
                    break
                share = wp.where(used > 1, LINE_SEARCH_TOLERANCE, FIRST_TOLERANCE)
                alpha = solver.line_search(share, ls_iterations, world, branch, kept, start, contacts)
                acc.lin = acc.lin + alpha * step.lin
                acc.ang = acc.ang + alpha * step.ang
                branch, flips = solver.move_all(world, branch, kept, contacts, alpha)
                if alpha == 1.0 and flips == 0.0 and decrease < EXACT_STEP:
                    break  # the whole step stayed in one piece of the piecewise quadratic cost: this is its minimum
            branch, system = around.damp_all(tables.timestep, world, lane, branch, kept)
            damped = solve_trunk(whole, TrunkMotion(), system, wp.static(lanes))
            around.integrate_all(
                tables, worlds, world, lane, branch, kept, damped, contacts, sense and i == end_step - 1
            )
            if lane == 0:
                integrate_trunk(tables.timestep, worlds, world, trunk, acc, damped)
                solver_niter[world] = used

    return fused_step
