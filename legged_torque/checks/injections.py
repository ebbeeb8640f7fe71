"""Bad numbers put into single worlds: do they stay there, and does a reset remove them?"""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from legged_torque.sim.simulator import Simulator

FIELDS = ("qpos", "qvel", "qacc_warmstart", "ctrl")
VALUES = (float("nan"), float("inf"), -float("inf"), 1e30)
WORLDS = 6
STEPS = 4  # physics steps before a bad number, with it, and after the reset
TORQUE = 8.0  # standard deviation of the random torques [N m]
_STATE = (*FIELDS, "contact_found", "contact_force")


def run(model: mujoco.MjModel, engine: str, count: int, device: str, seed: int = 0) -> dict[str, int]:
    """Put bad numbers into random places of single worlds of one of two simulators that otherwise do the same.

    Before each, all worlds fall from somewhere near the floor; after it, the world steps on, is reset in both
    simulators, and steps on.

    Returns:
        "injections": how many were made. "leaked": after how many of them another world differed by a bit.
        "not recovered": after how many the world itself differed by a bit once it was reset.
    """
    rng = np.random.default_rng(seed)
    sims = [Simulator(model, WORLDS, device, engine) for _ in range(2)]
    everyone = torch.ones(WORLDS, dtype=torch.bool, device=device)
    counts = {"injections": 0, "leaked": 0, "not recovered": 0}

    def step(times: int) -> None:
        for torques in torch.tensor(rng.normal(0.0, TORQUE, (times, WORLDS, model.nu))):
            for sim in sims:
                sim.ctrl.copy_(torques)
                sim.step()

    def fall(worlds: torch.Tensor, angles: torch.Tensor) -> None:
        for sim in sims:
            sim.reset(worlds)
            sim.qpos[worlds, 2] *= 0.5
            sim.qpos[worlds, 7:] += angles.to(device)[worlds]

    for _ in range(count):
        fall(everyone, torch.tensor(rng.normal(0.0, 0.3, (WORLDS, model.nu)), dtype=torch.float32))
        step(STEPS)
        name, world = rng.choice(FIELDS), int(rng.integers(WORLDS))
        target = getattr(sims[0], name)[world]
        target[int(rng.integers(len(target)))] = float(rng.choice(VALUES))
        for sim in sims:
            sim.step()  # with the bad torque, if it is one
        step(STEPS)
        mask = torch.arange(WORLDS, device=device) == world
        leaked = not _same(sims, ~mask)
        for sim in sims:
            sim.reset(mask)
        step(STEPS)
        counts["injections"] += 1
        counts["leaked"] += leaked or not _same(sims, ~mask)
        counts["not recovered"] += not _same(sims, mask)
    return counts


def _same(sims: list[Simulator], worlds: torch.Tensor) -> bool:
    """Return whether some worlds are the same in both simulators, to the last bit, and finite."""
    pairs = [[getattr(sim, name)[worlds] for sim in sims] for name in _STATE]
    return all(torch.equal(a, b) and bool(torch.isfinite(a).all()) for a, b in pairs)
