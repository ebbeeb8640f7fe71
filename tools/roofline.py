"""Compare update and physics with the peaks of a device: ``python tools/roofline.py --num_envs 4096``.

The operations and bytes are counted that the mathematics asks for, not those of an implementation:

- FLOP of an update: its matrix products, for each sample and mirror image: forward, gradients of weights, and
  gradients of inputs except for the first layer, which reads observations.
- Bytes of an update: numbers of the rollout read once per epoch; outputs of linear layers written once and read once;
  weights and both moments of Adam read and written once per minibatch.
- Bytes of physics: in each physics step the state read and written once, torques and a world's own rows of parameters
  read once; contact sensors written once per control step.

There is no count of the physics' operations: iterations of its solver and contacts differ from world to world.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import Any

from legged_torque.utils.devices import disable_renderer

disable_renderer()  # before anything imports mujoco

import torch
from torch import Tensor, nn

from legged_torque.benchmark.measure import WARM_UP, build, seconds_per_call, time_iterations, time_physics
from legged_torque.envs import task_registry
from legged_torque.learning.ppo.torch_ppo import TorchPPO
from legged_torque.sim.engine import Engine
from legged_torque.sim.fused.model import unread_columns
from legged_torque.utils import cli
from legged_torque.utils.devices import device_name, resolve_device
from legged_torque.utils.errors import UserError
from legged_torque.utils.limits import Count

RATES = (("update", "flop"), ("update", "bytes"), ("physics", "bytes"))
_ROUNDS = 5  # timings of each peak
_MATRIX = {"cuda": 8192, "cpu": 1024}  # rows and columns of the product
_COPY = {"cuda": 2**29, "cpu": 2**26}  # bytes that are copied: several times the caches


@dataclass(frozen=True)
class Peaks:
    """What a device reaches in large pieces of work."""

    flop_per_s: float  # of matrix products
    bytes_per_s: float  # of a copy, read and written


def measure_peaks(device: str, dtype: str) -> Peaks:
    """Measure the peaks on "cpu" or "cuda:N"; products are of numbers of a ``dtype``, "float32" (TF32) or "bfloat16".

    Those of float32 have the precision that torch is set to, so after a training that of its update.
    """
    kind = torch.device(device).type
    size, count = _MATRIX[kind], _COPY[kind]
    a, b, c = torch.randn(3, size, size, device=device).to(getattr(torch, dtype))
    product = _median_seconds(lambda: torch.mm(a, b, out=c), device)
    source, target = torch.zeros(2, count, dtype=torch.uint8, device=device)
    copy = _median_seconds(lambda: target.copy_(source), device)
    return Peaks(2 * size**3 / product, 2 * count / copy)


def work(alg: TorchPPO, sim: Engine, decimation: int) -> dict[str, Any]:
    """Return what an update and the physics of a control step need: "update_flop", "update_bytes", "physics_bytes".

    "update_dtype" is the kind of numbers that an update multiplies.
    """
    return {
        "update_dtype": str(alg.product_dtype).removeprefix("torch."),
        "update_flop": update_flop(alg),
        "update_bytes": update_bytes(alg),
        "physics_bytes": physics_bytes(sim, decimation),
    }


def shares(row: dict[str, Any], peaks: Peaks) -> dict[str, float]:
    """Return rates of what :func:`work` has counted, in 1e9 per second, and their shares of the peaks."""
    rates = {"peak_gflop_per_s": 1e-9 * peaks.flop_per_s, "peak_gbytes_per_s": 1e-9 * peaks.bytes_per_s}
    for part, unit in RATES:
        rate = 1e-6 * row[f"{part}_{unit}"] / row[f"{part}_ms"]
        rates |= {f"{part}_g{unit}_per_s": rate, f"{part}_{unit}_share": rate / rates[f"peak_g{unit}_per_s"]}
    return rates


def update_flop(alg: TorchPPO) -> int:
    """Return the operations of an update's matrix products; a multiplication with an addition is two."""
    passes = {alg.actor: actor_passes(alg), alg.critic: images(alg)}
    return samples(alg) * sum(count * flop_per_sample(model) for model, count in passes.items())


def flop_per_sample(model: nn.Module) -> int:
    """Return the operations of a model's linear layers for one sample, forward and backward."""
    first, *others = (layer.weight.numel() for layer in _linear(model))
    return 2 * (2 * first + 3 * sum(others))


def update_bytes(alg: TorchPPO) -> int:
    """Return the bytes that an update reads and writes if it does so once, see above."""
    storage, width = alg.storage, alg.product_dtype.itemsize  # of activations, too
    groups = {*alg.actor.obs_groups, *alg.critic.obs_groups}
    stored: list[Tensor] = [storage.observations[name] for name in groups]
    stored += [storage.actions, storage.actions]  # and their means
    stored += [storage.values, storage.returns, storage.advantages, storage.actions_log_prob]
    outputs = {alg.actor: actor_passes(alg), alg.critic: images(alg)}
    activations = sum(count * layer.out_features for model, count in outputs.items() for layer in _linear(model))
    parameters = [*alg.actor.parameters(), *alg.critic.parameters()]
    per_sample = sum(_bytes(tensor[0, 0]) for tensor in stored) + 2 * width * activations
    per_minibatch = 2 * 3 * sum(map(_bytes, parameters))
    return samples(alg) * per_sample + alg.num_learning_epochs * alg.num_mini_batches * per_minibatch


def samples(alg: TorchPPO) -> int:
    """Return the samples of all minibatches of an update, without mirror images."""
    rollout = alg.storage.num_envs * alg.storage.num_transitions_per_env
    return alg.num_learning_epochs * (rollout // alg.num_mini_batches) * alg.num_mini_batches


def images(alg: TorchPPO) -> int:
    """Return how often each sample counts in a minibatch: twice with its mirror image."""
    return 2 if alg.symmetry and alg.symmetry.use_data_augmentation else 1


def actor_passes(alg: TorchPPO) -> int:
    """Return how often the actor sees each sample; the mirror loss shows it the sample and its image once more."""
    return images(alg) + (2 if alg.symmetry and alg.symmetry.use_mirror_loss else 0)


def physics_bytes(sim: Engine, decimation: int) -> int:
    """Return the bytes that the physics of a control step reads and writes if each step does so once, see above."""
    carried = sim.state_dict()
    state = sum(_bytes(carried[name]) for name in ("qpos", "qvel", "qacc_warmstart"))
    own = sum(_bytes(field[:, unread_columns(name) :]) for name, field in sim.fields.items())  # read by each world
    sensors = _bytes(sim.contact_found) + _bytes(sim.contact_force)
    return decimation * (2 * state + _bytes(sim.ctrl) + own) + sensors


def _linear(model: nn.Module) -> list[nn.Linear]:
    """Return a model's linear layers, the one that reads observations first."""
    return [layer for layer in model.modules() if isinstance(layer, nn.Linear)]


def _bytes(tensor: Tensor) -> int:
    """Return the bytes of a tensor's numbers."""
    return tensor.numel() * tensor.element_size()


def _median_seconds(function: Callable[[], object], device: str) -> float:
    """Return the median time of a call that has run before [s]."""
    function()
    return median(seconds_per_call(function, device) for _ in range(_ROUNDS))


def main() -> None:
    """Time updates and physics of a task, and print their rates as shares of the peaks."""
    parser = cli.Parser(__doc__)
    cli.add_options(parser, *cli.SETTINGS, "num_envs")
    parser.add_argument("--rounds", type=int, default=10, help="how often each part is timed; default: %(default)s")
    args = parser.parse_args()
    cli.check_args(args, rounds=Count)
    device, options = resolve_device(args.device), cli.options_of(args)
    options.set = ["evaluation.interval=0", *options.set]  # without evaluations iterations are alike
    env_cfg, train_cfg = task_registry.get_cfgs(args.task, options)
    with tempfile.TemporaryDirectory() as folder:
        task, runner = build(args.task, (env_cfg, train_cfg), device, folder)
        alg = runner.alg
        if not isinstance(alg, TorchPPO):
            raise UserError(f"updates of PPO are counted, not those of {type(alg).__name__}")
        time_iterations(runner, WARM_UP)
        row: dict[str, Any] = {"update_ms": median(time_iterations(runner, args.rounds)["update"])}
        row["physics_ms"], _ = time_physics(task, args.rounds)
    row |= work(alg, task.sim, env_cfg.control.decimation)
    row |= shares(row, measure_peaks(device, str(row["update_dtype"])))
    print(f"{args.task}, {task.num_envs} worlds on {device_name(device)}, medians of {args.rounds} rounds")
    for part, unit in RATES:
        rate, peak, share = (
            row[name] for name in (f"{part}_g{unit}_per_s", f"peak_g{unit}_per_s", f"{part}_{unit}_share")
        )
        print(f"  {part:<7} {rate:>12,.1f} of {peak:>12,.1f} G{'FLOP' if unit == 'flop' else 'B'}/s: {share:.1%}")


if __name__ == "__main__":
    cli.run_script(main)
