"""Check that a training gives the same bits again, also resumed: ``python scripts/check_reproducible.py``."""

import argparse
import random
import sys
import tempfile
from pathlib import Path

from legged_torque.envs import task_registry
from legged_torque.envs.base.validation import check_env_cfg
from legged_torque.utils.args import Parser, add_build_args, options_of, task_file_words
from legged_torque.utils.cli import check_at_least, run_script, slow_imports
from legged_torque.utils.errors import UserError

SAVE_INTERVAL = 2  # iterations; of trainings that are killed


def main() -> None:
    """Train again and again, compare every checkpoint's last tensor, and judge."""
    parser = Parser(__doc__)
    add_build_args(parser)
    parser.set_defaults(perturbation="low")
    parser.add_argument("--iterations", type=int, default=4, help="iterations to train; default: %(default)s")
    parser.add_argument("--processes", type=int, default=1, help="processes that train together; default: %(default)s")
    help_text = "how often to stop and resume, once in the middle or at random iterations; default: %(default)s"
    parser.add_argument("--resumes", type=int, default=1, help=help_text)
    help_text = "how often to kill a training of its own at random moments and resume it; default: %(default)s"
    parser.add_argument("--kills", type=int, default=0, help=help_text)
    args = parser.parse_args()
    check_at_least(args, 1, "iterations", "processes")
    check_at_least(args, 0, "resumes", "kills")
    if args.resumes >= args.iterations:
        raise UserError(f"--resumes must be less than --iterations, which is {args.iterations}, not {args.resumes}")
    with slow_imports():
        check_env_cfg(task_registry.get_cfgs(args.task, options_of(args))[0])  # mistakes are told first
    with tempfile.TemporaryDirectory() as folder:
        sys.exit(0 if check(args, Path(folder)) else 1)


def check(args: argparse.Namespace, folder: Path) -> bool:
    """Print a line per comparison; return whether nothing differs and nothing is broken."""
    from tools.reproducible import Training, compare, kill_often

    words = train_words(args)
    first, again, resumed, killed, straight = (
        Training(words, folder / name, args.processes) for name in ("first", "again", "resumed", "killed", "straight")
    )
    chance = random.Random(args.iterations)
    print(f"{args.task}: equal to the bit, apart from times?")
    first.run_until(args.iterations)
    again.run_until(args.iterations)
    comparisons = [(again, first, "trained twice")]
    if args.resumes:
        stops = sorted(chance.sample(range(1, args.iterations), args.resumes))
        stops = [args.iterations // 2] if args.resumes == 1 else stops
        for iterations in [*stops, args.iterations]:
            resumed.run_until(iterations)
        comparisons.append((resumed, first, f"resumed after {', '.join(map(str, stops))} of {args.iterations}"))
    broken = []
    if args.kills:
        left, saved = kill_often(killed, args.kills, SAVE_INTERVAL, chance)
        print(f"killed {left.count} times: at most {left.most_lost} iterations lost, {len(left.broken)} broken files")
        broken = left.broken
        for training in (killed, straight):
            training.run_until(saved + 1)
        comparisons.append((killed, straight, f"killed, {saved + 1} iterations"))
    different = []
    for second, one, name in comparisons:
        result = compare(name, one, second)
        print(f"{result.name:<40} {result.compared:>6} compared {len(result.different):>6} different")
        different += [f"{result.name}: {part}" for part in result.different]
    print("\n".join(different[:20] + broken), end="\n" if different or broken else "")
    return not different and not broken


def train_words(args: argparse.Namespace) -> list[str]:
    """Return the words of ``train.py`` that the options stand for, with two evaluations after every iteration."""
    names = ("task", "seed", "perturbation", "ranges", "device", "num_envs")
    words = [f"--{name}={getattr(args, name)}" for name in names if getattr(args, name) is not None]
    changes = ["evaluation.interval=1", f"evaluation.also=[{args.perturbation}]", "evaluation.also_from=1"]
    changes += [f"runner.save_interval={SAVE_INTERVAL}", *args.set]
    words += [*task_file_words(args.task_file), "--logger=none"]
    return [*words, *(f"--set={change}" for change in changes)]


if __name__ == "__main__":
    run_script(main)
