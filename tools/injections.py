"""Put NaN, inf and 1e30 into single worlds of both engines: ``python tools/injections.py --count 400``.

No other world may differ by a bit, and a reset must make the world as good as new. Exits with 1 otherwise.
"""

import sys

from legged_torque.utils.devices import disable_renderer

disable_renderer()  # before anything imports mujoco

import mujoco
import numpy as np
import torch

from legged_torque import RESOURCES_DIR
from legged_torque.sim.engine import Engine
from legged_torque.sim.model import build_model, collision_geoms
from legged_torque.sim.registry import ENGINES, make_engine
from legged_torque.utils import cli
from legged_torque.utils.devices import resolve_device
from legged_torque.utils.limits import Count
from legged_torque.utils.mjcf import read_spec

FIELDS = ("qpos", "qvel", "qacc_warmstart", "ctrl")
VALUES = (float("nan"), float("inf"), -float("inf"), 1e30)
WORLDS = 6
STEPS = 4  # physics steps before a bad number, with it, and after the reset
LOW, HIGH = 0.1, 1.0  # heights of trunks in the floor and in the air [m]
TORQUE = 8.0  # standard deviation of the random torques [N m]
_STATE = (*FIELDS, "contact_found", "contact_force")


def run(model: mujoco.MjModel, engine: str, count: int, device: str, seed: int = 0) -> dict[str, int]:
    """Put bad numbers into random places of single worlds of one of two simulators that otherwise do the same.

    Before each, all worlds are in the floor, where they have many contacts; after it, the world steps on, is reset in
    both simulators, and goes on in the air, where it has few constraints and must not read what is left of others.

    Returns:
        "injections": how many were made. "leaked": after how many of them another world differed by a bit.
        "not recovered": after how many the world itself differed by a bit once it was reset.
    """
    rng = np.random.default_rng(seed)
    sims = [make_engine(engine, model, WORLDS, device) for _ in range(2)]
    everyone = torch.ones(WORLDS, dtype=torch.bool, device=device)
    bent = torch.tensor(model.jnt_range[1:].mean(axis=1), dtype=torch.float32, device=device)
    counts = {"injections": 0, "leaked": 0, "not recovered": 0}

    def step(times: int) -> None:
        """Step both simulators under the same random torques."""
        for torques in torch.tensor(rng.normal(0.0, TORQUE, (times, WORLDS, model.nu))):
            for sim in sims:
                sim.ctrl.copy_(torques)
                sim.step()

    def restart(worlds: torch.Tensor, height: float) -> None:
        """Reset worlds of both simulators and pose them alike, at a height [m]."""
        angles = torch.tensor(rng.normal(0.0, 0.1, (WORLDS, model.nu)), dtype=torch.float32, device=device)
        for sim in sims:
            sim.reset(worlds)
            sim.qpos[worlds, 2] = height
            sim.qpos[worlds, 7:] = bent + angles[worlds]

    for _ in range(count):
        restart(everyone, LOW)
        step(STEPS)
        name, world = rng.choice(FIELDS), int(rng.integers(WORLDS))
        target = getattr(sims[0], name)[world]
        target[int(rng.integers(len(target)))] = float(rng.choice(VALUES))
        for sim in sims:
            sim.step()  # with the bad torque, if it is one
        step(STEPS)
        mask = torch.arange(WORLDS, device=device) == world
        leaked = not _same(sims, ~mask)
        restart(mask, HIGH)
        step(STEPS)
        counts["injections"] += 1
        counts["leaked"] += leaked or not _same(sims, ~mask)
        counts["not recovered"] += not _same(sims, mask)
    return counts


def _same(sims: list[Engine], worlds: torch.Tensor) -> bool:
    """Return whether some worlds are the same in both simulators, to the last bit, and finite."""
    pairs = [[getattr(sim, name)[worlds] for sim in sims] for name in _STATE]
    return all(torch.equal(a, b) and bool(torch.isfinite(a).all()) for a, b in pairs)


def main() -> None:
    """Print the counts of both engines."""
    parser = cli.Parser(__doc__)
    parser.add_argument("--count", type=int, default=400, help="bad numbers per engine; default: %(default)s")
    cli.add_options(parser, "device")
    args = parser.parse_args()
    cli.check_args(args, count=Count)
    device, spec = resolve_device(args.device), read_spec(RESOURCES_DIR / "robots/a1/a1.xml")
    model, is_good = build_model(spec, collision_geoms(spec)), True
    for engine in ENGINES:
        counts = run(model, engine, args.count, device)
        print(f"{engine}: " + ", ".join(f"{count} {name}" for name, count in counts.items()), flush=True)
        is_good &= counts["leaked"] == counts["not recovered"] == 0
    sys.exit(0 if is_good else 1)


if __name__ == "__main__":
    cli.run_script(main)
