"""How far cheaper solver settings are from MuJoCo's own, converged physics."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import torch

from legged_torque.sim.simulator import Simulator

State = dict[str, torch.Tensor]
"""A batch of states: "qpos", "qvel", "qacc_warmstart", "ctrl", each (num_envs, size)."""


def copy_state(sim: Simulator) -> State:
    """Return a copy of what the next physics step depends on."""
    return {name: getattr(sim, name).clone() for name in ("qpos", "qvel", "qacc_warmstart", "ctrl")}


def reference_velocities(model: mujoco.MjModel, states: list[State]) -> np.ndarray:
    """Return the velocities after one ``mj_step`` in float64, with a converged solver, from every state.

    Args:
        model: The model of the simulator that the states are from.
        states: The states.

    Returns:
        Velocities in MuJoCo's layout. Shape: (len(states), num_envs, nv).
    """
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


def velocity_errors(sim: Simulator, states: list[State], reference: np.ndarray) -> dict[str, float]:
    """Compare one step of a simulator with the reference.

    Args:
        sim: The simulator; its settings are what is judged.
        states: States with as many worlds as the simulator.
        reference: From :func:`reference_velocities`.

    Returns:
        "rms", "p999" (the 99.9th percentile) and "max" of the absolute error of all velocities [m/s, rad/s], and
        "change_rms": how much velocities change in a step, to compare with.
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
