"""Train the Go1 with this package and with mjlab on the machine at hand: ``python -m tools.compare --num_envs 4096``.

Robot, ground, ranges of commands, decimation, physics step, networks, epochs and minibatches are the same in all rows.
With ``equal`` settings, so are the friction cone, impratio and the solver's iterations, and there are no mirror images.
Everything else is each trainer's own: how commands are drawn, contacts, rewards, observations and their normalization,
random parameters, pushes, gains, coefficients of PPO, and precision (bfloat16 here).

Seconds count from the start of the command, and each row compiles with empty caches; start-up ends with the first
iteration. Checkpoints of every tenth iteration (mjlab's: one later) walk in plain MuJoCo, each in its own model, until
one tracks 70% of its commands. Isaac Lab is left out since it needs NVIDIA's own index of packages, and MuJoCo
Playground 1.0 since it no longer has a Go1.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from legged_torque.utils.cli import Parser, check_args, check_output, run_script
from legged_torque.utils.devices import device_name, resolve_device
from legged_torque.utils.errors import UserError, require
from legged_torque.utils.files import write_json
from legged_torque.utils.limits import Count
from tools.compare import measure

ROOT = Path(__file__).resolve().parents[2]
MJLAB = "mjlab==1.6.0"
CACHES = ("WARP_CACHE_PATH", "TORCHINDUCTOR_CACHE_DIR", "TRITON_CACHE_DIR", "CUDA_CACHE_PATH")
ROWS = [
    ("mjlab", "default", None),
    ("mjlab", "equal", None),
    ("legged_torque", "equal", "mujoco_warp"),
    ("legged_torque", "equal", "fused"),
    ("legged_torque", "default", "fused"),
]
"""Trainer, settings and engine of each row."""
COLUMNS = {
    "step_ms": ("env.step ms", 2),
    "iteration_ms": ("iteration ms", 1),
    "update_ms": ("update ms", 1),
    "training_steps_per_s": ("steps/s", 0),
    "start_up_s": ("start-up s", 1),
    "seconds_to_70": ("s to 70%", 1),
    "steps_to_70": ("steps to 70%", 0),
}
"""Heading of each column, and its number of decimals."""


def main() -> None:
    """Run all rows one after the other, print a table, write JSON."""
    args = parse_args()
    require("onnx", "onnxruntime", "jsonschema")  # for the judge of our policies
    device = resolve_device(args.device)
    result: dict[str, Any] = {"device": device_name(device), "num_envs": args.num_envs, "seed": args.seed, "rows": []}
    with tempfile.TemporaryDirectory() as folder:
        mjlab = args.mjlab or install(Path(folder, "venv"))
        for trainer, settings, engine in ROWS:
            print(f"{trainer}, {settings} settings{f', engine {engine}' if engine else ''}:", flush=True)
            out = Path(folder, f"{trainer}_{settings}_{engine}")
            out.mkdir()
            module, python = ("mjlab_go1", mjlab) if trainer == "mjlab" else ("ours", Path(sys.executable))
            row = run(python, module, settings, engine, out / "row.json", args, device)
            result["rows"].append({"trainer": trainer, "compared": settings, "engine": engine} | row)
            if args.json:
                write_json(args.json, result)
    print(*table(result["rows"]), sep="\n")
    sys.exit(any("error" in row for row in result["rows"]))


def parse_args() -> argparse.Namespace:
    """Parse and check the command line."""
    parser = Parser(__doc__)
    parser.add_argument("--num_envs", type=int, default=4096, help="worlds; default: %(default)s")
    parser.add_argument("--iterations", type=int, default=300, help="of each training; default: %(default)s")
    parser.add_argument("--seed", type=int, default=1, help="random seed; default: %(default)s")
    parser.add_argument("--device", help="cpu or cuda:N; default: a GPU if there is one")
    parser.add_argument("--mjlab", type=Path, help=f"Python of an environment that has {MJLAB}; default: one is made")
    parser.add_argument("--json", type=Path, help="file to write")
    args = parser.parse_args()
    check_args(args, num_envs=Count, iterations=Count)
    if args.iterations % measure.INTERVAL:
        raise UserError(
            f"--iterations must be a multiple of {measure.INTERVAL}: there is a checkpoint after each of these"
        )
    if args.mjlab and not args.mjlab.is_file():
        raise UserError(f"--mjlab: there is no file '{args.mjlab}'")
    args.mjlab = args.mjlab and args.mjlab.absolute()  # rows run in another folder
    if args.json:
        check_output(args.json)
    return args


def install(folder: Path) -> Path:
    """Make an environment for mjlab, and return its Python."""
    python = folder / "bin" / "python"
    for words in ([sys.executable, "-m", "venv", str(folder)], [str(python), "-m", "pip", "install", "-q", MJLAB]):
        if subprocess.run(words, check=False).returncode:
            raise UserError(f"an environment with {MJLAB} could not be made, see above; --mjlab names one that has it")
    return python


def run(
    python: Path, module: str, settings: str, engine: str | None, out: Path, args: argparse.Namespace, device: str
) -> dict[str, Any]:
    """Run a row in a process of its own, and return what it has measured, or the "error" that ended it."""
    words = [str(python), "-m", f"tools.compare.{module}", f"--settings={settings}", f"--out={out}"]
    words += [f"--num_envs={args.num_envs}", f"--iterations={args.iterations}", f"--seed={args.seed}"]
    words += [f"--device={device}", *([f"--engine={engine}"] if engine else []), f"--started={time.time()}"]
    environment = os.environ | {name: str(out.with_name(name)) for name in CACHES}
    with open(out.with_name("log.txt"), "w+") as log:
        process = subprocess.run(words, cwd=ROOT, env=environment, stdout=log, stderr=subprocess.STDOUT, check=False)
        log.seek(0)
        lines = log.read().splitlines()
    if process.returncode:
        print(*lines[-20:], f"This row has failed, with exit status {process.returncode}.", sep="\n", flush=True)
        return {"error": lines[-20:]}
    print(*(line for line in lines if line.startswith("  after")), sep="\n", flush=True)
    return json.loads(out.read_text(encoding="utf-8"))


def table(rows: list[dict[str, Any]]) -> list[str]:
    """Return the lines of a table in Markdown."""
    titles = ["trainer", "settings", "engine", *(title for title, _ in COLUMNS.values())]
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for row in rows:
        cells = [row["trainer"], row["compared"], row["engine"] or "mujoco_warp"]
        missing = "failed" if "error" in row else "not reached"
        cells += [f"{row[key]:,.{digits}f}" if key in row else missing for key, (_, digits) in COLUMNS.items()]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


if __name__ == "__main__":
    run_script(main)
