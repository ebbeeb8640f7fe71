"""Times the physics of the A1 on a plane and on height maps, and compares a device with a CPU. See NOTES_19.md.

Run as ``python NOTES_19_gpu.py cuda:0 4096`` in the root of the repository.
"""

import sys

import numpy as np
import torch
import warp as wp

from legged_torque import RESOURCES_DIR
from legged_torque.sim.graph import prepare_device
from legged_torque.sim.model import build_model, read_spec
from legged_torque.sim.simulator import Simulator
from tests.test_height_map_contacts import make_map, stairs

DEVICE, WORLDS = sys.argv[1], int(sys.argv[2])
CELLS = 1600  # 80 m x 80 m
GROUNDS = {
    "plane": None,
    "flat": make_map(lambda x, y: 0.0 * x, cells=CELLS),
    "slope 0.3": make_map(lambda x, y: 0.3 * x, cells=CELLS),
    "waves": make_map(lambda x, y: 0.1 * np.sin(2.0 * x) * np.cos(2.0 * y), cells=CELLS),
    "rough": make_map(lambda x, y: np.random.default_rng(1).uniform(-0.03, 0.03, x.shape), cells=CELLS),
    "stairs": make_map(lambda x, y: stairs(x, y) + 0.0 * y, cells=CELLS),
}


def make(device, ground):
    """Worlds of the A1 spread over a ground, at the same places on any device, and their reference pose."""
    model = build_model(read_spec(RESOURCES_DIR / "robots/a1/a1.xml"), ["FR_foot", "FL_foot", "RR_foot", "RL_foot"])
    sim = Simulator(model, WORLDS, device, "fused", 10, 20, height_map=ground)
    rng, home = np.random.default_rng(0), torch.tensor(model.key_qpos[0], dtype=torch.float32, device=device)
    places = rng.uniform(-35.0, 35.0, (WORLDS, 2))
    sim.qpos.copy_(home)
    sim.qpos[:, :2] = torch.tensor(places, dtype=torch.float32)
    if ground is not None:
        cells = ((places - ground.corner) / ground.horizontal_scale).astype(int)
        near = np.stack([ground.heights[cells[:, 0] + i, cells[:, 1] + j] for i in range(-6, 8) for j in range(-6, 8)])
        sim.qpos[:, 2] += torch.tensor(near.max(axis=0), device=device)
    return sim, home


def act(sim, home, noise):
    """Write torques of a PD controller and noise."""
    sim.ctrl.copy_(60.0 * (home[7:] - sim.qpos[:, 7:]) - 1.5 * sim.qvel[:, 6:] + noise * torch.randn_like(sim.ctrl))


def measure(name, ground):
    """Print microseconds of four physics steps as one graph, and what one step differs from a CPU's."""
    torch.manual_seed(0)
    sim, home = make(DEVICE, ground)
    for step in range(400):
        if step % 4 == 0:
            act(sim, home, 3.0)
        sim.step(step % 4 == 3)
    device = wp.get_device(DEVICE)
    times, iterations = [], []
    if device.is_cuda:
        with wp.ScopedCapture(device) as capture:
            for step in range(4):
                sim.step(step == 3)
        for _ in range(200):
            act(sim, home, 3.0)
            start, end = wp.Event(device, enable_timing=True), wp.Event(device, enable_timing=True)
            stream = wp.get_stream(device)
            stream.record_event(start)
            wp.capture_launch(capture.graph)
            stream.record_event(end)
            times.append(1e3 * wp.get_event_elapsed_time(start, end))
            iterations.append(sim.data.solver_niter.numpy().mean())
    state = [tensor.cpu().clone() for tensor in (sim.qpos, sim.qvel, sim.ctrl, sim.qacc_warmstart)]
    results = []
    for on in (DEVICE, "cpu"):
        other, _ = make(on, ground)
        for tensor, values in zip((other.qpos, other.qvel, other.ctrl, other.qacc_warmstart), state, strict=True):
            tensor.copy_(values)
        other.step()
        results.append((other.qvel.cpu(), other.contact_found.cpu()))
    error = (results[0][0] - results[1][0]).abs().amax(dim=1)
    print(
        f"{name:10s} 4 steps {np.mean(times or [np.nan]):7.1f} us (median {np.median(times or [np.nan]):7.1f}), "
        f"iterations {np.mean(iterations or [np.nan]):.2f}, contacts {sim.contact_found.sum(dim=1).mean().item():.2f}, "
        f"from CPU: median {error.median():.1e}, 99.9% {error.quantile(0.999):.1e}, "
        f"other contacts {(results[0][1] != results[1][1]).sum().item()}"
    )


prepare_device(DEVICE)
for ground_name, ground_map in list(GROUNDS.items()):
    measure(ground_name, ground_map)
