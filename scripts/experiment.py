"""Train and evaluate tasks x environments x seeds.

Examples:
    python scripts/experiment.py experiments/smoke.yaml --jobs 2      # a few iterations, to try it
    python scripts/experiment.py experiments/paper.yaml --dry-run     # list pending jobs
    python scripts/experiment.py experiments/paper.yaml               # run them on all GPUs
    python scripts/experiment.py my.yaml --device cpu --jobs 2 --out results

Finished cells are skipped and interrupted ones resumed: to continue an experiment, repeat the command.
"""

import argparse
import contextlib
import sys
from pathlib import Path

from legged_torque import EXPERIMENTS_DIR, experiment_path
from legged_torque.experiments.job import Launcher
from legged_torque.experiments.local_launcher import CPU_JOBS, GPU_JOBS, MPS_JOBS, LocalLauncher, multi_process_service
from legged_torque.experiments.matrix import SETTINGS_FILE, cell_state, check_same, read_matrix
from legged_torque.experiments.run import ExperimentRun, claim_folder
from legged_torque.utils import cli
from legged_torque.utils.errors import UserError, unknown_name


def main() -> None:
    """Run all cells of a matrix, or list what is left to do."""
    parser = cli.Parser(__doc__)
    parser.add_argument("file", type=Path, help="description of the matrix, see experiments/")
    parser.add_argument("--out", type=Path, help="folder of the results; default: logs/experiments/<name of the file>")
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda:N; auto uses all GPUs, or else the CPU")
    hint = f"runs at a time on each device; default: {GPU_JOBS} on a GPU, {MPS_JOBS} with --mps, {CPU_JOBS} on the CPU"
    parser.add_argument("--jobs", type=int, help=hint)
    hint = "let runs on a GPU compute at once instead of in turns, by NVIDIA's Multi-Process Service"
    parser.add_argument("--mps", action="store_true", help=hint)
    hint = "where runs are started: on this machine (local), or on the machines of a Ray cluster (ray)"
    parser.add_argument("--launcher", default="local", help=hint)
    parser.add_argument("--address", help="of the Ray cluster; default: auto, the one that this machine belongs to")
    parser.add_argument("--dry-run", action="store_true", help="only list what is left to do")
    cli.add_options(parser, "task_file")
    args = parser.parse_args()
    folders = [args.file.parent, *([EXPERIMENTS_DIR] if args.file.parts[:1] == ("experiments",) else [])]
    others = {str(args.file.parent / other.name) for folder in folders for other in folder.glob("*.yaml")}
    if others and not experiment_path(args.file).exists():
        raise unknown_name("file", str(args.file), others)
    with cli.slow_imports():
        matrix = read_matrix(experiment_path(args.file), args.task_file)
    out = (args.out or Path("logs", "experiments", args.file.stem)).resolve()
    launcher = make_launcher(args)
    if args.dry_run:
        check_same(matrix, out)
        for cell in matrix.cells(out):
            try:
                print(f"{cell.name}: {cell_state(cell)}")
            except UserError as error:  # with which this cell would fail, and no other
                print(f"{cell.name}: {error}")
        return
    cli.check_output(out / SETTINGS_FILE)
    with multi_process_service() if args.mps else contextlib.nullcontext({}) as variables:
        if isinstance(launcher, LocalLauncher):
            launcher.variables |= variables
        claim_folder(matrix, experiment_path(args.file), out)
        status = ExperimentRun(matrix, out, launcher).run()
    sys.exit(status)


def make_launcher(args: argparse.Namespace) -> Launcher:
    """Return what starts the runs."""
    if args.launcher == "ray":
        if args.mps:
            raise UserError("--mps is for this machine; on a cluster, start the service on each node")
        if args.task_file:
            raise UserError("--task_file is for this machine; on a cluster, install the tasks: docs/howto/own_tasks.md")
        with cli.slow_imports():
            from legged_torque.experiments.ray_launcher import RayLauncher
        return RayLauncher(args.address or "auto", args.device, args.jobs)
    if args.launcher != "local":
        raise unknown_name("launcher", args.launcher, ["local", "ray"])
    if args.address:
        raise UserError("--address is that of a Ray cluster: give --launcher ray as well")
    launcher = LocalLauncher(args.device, MPS_JOBS if args.mps and args.jobs is None else args.jobs)
    if args.mps and launcher.device == "cpu":
        raise UserError("--mps is for GPUs, and this experiment would run on the CPU")
    return launcher


if __name__ == "__main__":
    cli.run_script(main)
