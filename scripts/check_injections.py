"""Put NaN, inf and 1e30 into single worlds of both engines: ``python scripts/check_injections.py --count 400``.

No other world may differ by a bit, and a reset must make the world as good as new. Exits with 1 otherwise.
"""

import sys

from legged_torque import RESOURCES_DIR
from legged_torque.utils.args import Parser, add_options
from legged_torque.utils.cli import check_at_least, run_script, slow_imports
from legged_torque.utils.devices import resolve_device


def main() -> None:
    """Print the counts of both engines."""
    parser = Parser(__doc__)
    parser.add_argument("--count", type=int, default=400, help="bad numbers per engine; default: %(default)s")
    add_options(parser, "device")
    args = parser.parse_args()
    check_at_least(args, 1, "count")
    with slow_imports():
        device = resolve_device(args.device)
        from legged_torque.sim.model import build_model, collision_geoms
        from legged_torque.sim.registry import ENGINES
        from legged_torque.utils.mjcf import read_spec
        from tools import injections
    spec = read_spec(RESOURCES_DIR / "robots/a1/a1.xml")
    model = build_model(spec, collision_geoms(spec))
    is_good = True
    for engine in ENGINES:
        counts = injections.run(model, engine, args.count, device)
        print(f"{engine}: " + ", ".join(f"{count} {name}" for name, count in counts.items()), flush=True)
        is_good &= counts["leaked"] == counts["not recovered"] == 0
    sys.exit(0 if is_good else 1)


if __name__ == "__main__":
    run_script(main)
