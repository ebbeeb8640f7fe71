"""The error of cheap solver settings, compared with MuJoCo's own, converged physics."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import torch

from legged_torque.sim.simulator import Simulator

PhysicsState = dict[str, torch.Tensor]
"""A batch of states: "qpos", "qvel", "qacc_warmstart", "ctrl", each (num_envs, size)."""


def copy_state(sim: Simulator) -> PhysicsState:
    """Return a copy of the arrays that the next physics step depends on."""
    return {name: getattr(sim, name).clone() for name in ("qpos", "qvel", "qacc_warmstart", "ctrl")}


def reference_velocities(model: mujoco.MjModel, states: list[PhysicsState]) -> np.ndarray:
    """Return velocities after one converged ``mj_step`` in float64 per state. Shape: (len(states), num_envs, nv)."""
    model = copy.copy(model)
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 100, 50, 1e-12
    data = mujoco.MjData(model)
    result = np.zeros((len(states), len(states[0]["qpos"]), model.nv))
    for i, state in enumerate(states):
        arrays = {name: tensor.double().cpu().numpy() for name, tensor in state.items()}
        for world in range(len(arrays["qpos"])):
            for name, array in arrays.items():
                getattr(data, name)[:] = array[world]
            mujoco.mj_step(model, data)
            result[i, world] = data.qvel
    return result


def velocity_errors(sim: Simulator, states: list[PhysicsState], reference: np.ndarray) -> dict[str, float]:
    """Compare one step of a simulator from each of the states with the :func:`reference_velocities`.

    Returns:
        "rms", "p999" (the 99.9th percentile) and "max" of the absolute error of all velocities [m/s, rad/s], and
        "change_rms": the change of velocities in a step, for comparison.
    """
    errors, changes = [], []
    for state, expected in zip(states, reference, strict=True):
        for name, tensor in state.items():
            getattr(sim, name).copy_(tensor)
        sim.step()
        errors.append(np.abs(sim.qvel.double().cpu().numpy() - expected))
        changes.append(expected - state["qvel"].double().cpu().numpy())
    error = np.stack(errors)
    return {
        "rms": float(np.sqrt((error**2).mean())),
        "p999": float(np.quantile(error, 0.999)),
        "max": float(error.max()),
        "change_rms": float(np.sqrt((np.stack(changes) ** 2).mean())),
    }
