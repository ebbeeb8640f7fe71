"""Candidates as worlds of the fused engine: robots whose trunk is held, under the commands of a log."""

import math
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from legged_torque.envs.base.asset import load_asset
from legged_torque.identification.drives import drive
from legged_torque.identification.recording import Recording
from legged_torque.sim.fused.tree import read_tree
from legged_torque.sim.graph import CudaGraph
from legged_torque.sim.registry import make_engine
from legged_torque.utils.errors import refuse, unknown_name
from legged_torque.utils.mjcf import hang_up

STEP = 1e-3  # [s] longest physics step
TICKS = 20  # of the log that are simulated as one CUDA graph
FIELDS = {"armature": "dof_armature", "viscous_friction": "dof_damping", "coulomb_friction": "dof_frictionloss"}
PARAMETERS = (*FIELDS, "bias", "delay")
"""Of a joint, as PACE has them [kg m^2, N m s/rad, N m, rad, s]; it stands where the encoder says, plus the bias."""


class HangingRobots:
    """Robots in the air.

    The fused engine needs a free trunk: it weighs 1000 t, a force carries it, and its state is put back before each
    step; legs accelerate it by 1e-4 m/s^2. That costs nothing, since drives need a kernel before each step
    anyway, and joints are where a fixed base in plain MuJoCo has them (``tests/identification``). Nothing collides.

    Attributes:
        num_worlds: How many robots there are: two for each number of a leg and the delay, and one.
        branches: Joints, by their places in the log, that hang on the trunk one behind the other. With a fixed trunk
            they do not feel those of other branches.
        file_values: Parameters in the robot's file; no bias, no delay. Shape: (5, joints).
        torque_limits: Lowest and highest [N m]. Shape: (2, joints).
    """

    def __init__(self, cfg: Any, recording: Recording, device: str, finer: int = 1) -> None:
        """Hang the robot of a task's settings up as that of a log; ``finer``: 2 for steps of half the length, say.

        A UserError if it lacks joints of the log, or the log lacks joints that hang on a branch with others of it.
        """
        self._recording, wanted = recording, recording.joint_order
        self._substeps = finer * int(np.ceil(recording.period / STEP - 1e-9))
        self._step = recording.period / self._substeps
        asset = load_asset(cfg)
        model, names = asset.mj_model, asset.dof_names
        refuse([str(unknown_name("joint of the log", name, names)) for name in wanted if name not in names])
        self._order = order = [names.index(name) for name in wanted]
        chains = [[joint - 1 for joint in chain if joint > 0] for chain in read_tree(model).joints.tolist()]
        chains = [chain for chain in chains if not set(chain).isdisjoint(order)]
        limp = [names[joint] for chain in chains for joint in chain if joint not in order]
        refuse([f"the log lacks joints of the branches that it has: {', '.join(limp)}"] if limp else [])
        self.branches = [[order.index(joint) for joint in chain] for chain in chains]
        self.num_worlds = 2 * (4 * max(map(len, self.branches)) + 1) + 1
        self.torque_limits, none = model.actuator_ctrlrange[order].T, np.zeros(len(order))
        self.file_values = np.array([*(getattr(model, field)[6:][order] for field in FIELDS.values()), none, none])
        hang_up(model)
        model.opt.timestep, sim = self._step, cfg.sim
        model.dof_damping[6:] = model.actuator_ctrllimited[:] = model.actuator_forcelimited[:] = 0  # drive applies them
        self._engine = make_engine("fused", model, self.num_worlds, device, sim.solver_iterations, sim.ls_iterations)
        fields = (self._engine.field(name, range(6, model.nv))[:, 6:] for name in FIELDS.values())
        self._armature, _, self._coulomb_friction = fields
        tables = (recording.commands, self.torque_limits, [0.0, 0.0, 1.0, *recording.quaternion])
        self._tables = [torch.tensor(order, dtype=torch.int32, device=device), *map(self._tensor, tables)]
        shape = (self.num_worlds, len(order))
        self._taken = torch.zeros(shape, dtype=torch.int32, device=device)
        self._values = torch.zeros(shape[0], 5, shape[1], device=device)
        self._past, self._ahead = (torch.zeros(shape, device=device) for _ in range(2))
        self._seen = torch.zeros(len(recording.commands), shape[0], 2, shape[1], device=device)
        self._graph = CudaGraph(self._run_ticks, device)

    def _tensor(self, values: Any) -> Tensor:
        """Return numbers on the device, as float32."""
        return torch.tensor(np.array(values), dtype=torch.float32, device=self._engine.device)

    def run(self, parameters: np.ndarray, ticks: int) -> Tensor:
        """Return what encoders say in the first ticks of the log.

        Args:
            parameters: :data:`PARAMETERS` of the joints of all robots. Shape: (num_worlds, 5, joints).
            ticks: How many ticks, at most those of the log.

        Returns:
            Positions [rad] and velocities [rad/s] at the start of each tick, which the next call overwrites. Shape:
            (ticks, num_worlds, 2, joints).
        """
        engine, order, model = self._engine, self._order, self._engine.mj_model
        start = self._tensor(self._recording.measured[0])
        everywhere = torch.ones(self.num_worlds, dtype=torch.bool, device=engine.device)
        self._values.copy_(self._tensor(parameters))
        self._past.copy_(start[1].expand_as(self._past))
        self._ahead.zero_()
        self._taken.zero_()
        engine.reset(everywhere)
        self._armature[:, order], self._coulomb_friction[:, order] = self._values[:, 0], self._values[:, 2]
        engine.update_constants(everywhere)
        engine.qpos[:, 7:][:, order], engine.qvel[:, 6:][:, order] = start[0] + self._values[:, 3], self._past
        engine.applied_forces()[0][:, 1, :3] = self._tensor(-model.body_mass[1] * model.opt.gravity)
        for _ in range(math.ceil(ticks / TICKS)):
            self._graph()
        return self._seen[:ticks]

    def _run_ticks(self) -> None:
        """Simulate some ticks; what encoders say is kept up to the end of the log."""
        engine = self._engine
        own = (self._values, self._past, self._ahead)
        tensors = [*self._tables, *own, engine.qpos, engine.qvel, engine.ctrl, self._seen]
        inputs = [wp.from_torch(self._taken), self._substeps, 1.0 / self._step, *map(wp.from_torch, tensors)]
        launch = wp.launch(drive, self._past.shape, inputs, device=engine.device, record_cmd=True)
        for _ in range(TICKS * self._substeps):
            launch.launch()
            engine.step(sense=False)
