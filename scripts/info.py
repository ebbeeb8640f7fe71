"""Show what is installed and what is missing: ``python scripts/info.py``.

Versions, processor, GPU and driver, where compiled kernels are kept, and which extras can be used.
"""

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path

from packaging.requirements import Requirement

import legged_torque
from legged_torque.utils import cli
from legged_torque.utils.devices import choose_offscreen_renderer
from legged_torque.utils.errors import collect_errors, counted
from legged_torque.utils.runs import package_versions

PURPOSES = {
    "video": "videos of play.py and sim2sim.py",
    "viewer": "play.py --viewer web",
    "export": "export.py, sim2sim.py",
    "robot": "robots over DDS",
    "identify": "identify.py",
    "plots": "figures and report.py",
    "wandb": "--logger wandb",
    "ray": "experiment.py --launcher ray",
}
"""The extras that users need."""


def main() -> None:
    """Print a block of lines per topic."""
    cli.Parser(__doc__).parse_args()
    no_renderer = choose_offscreen_renderer()  # before anything imports mujoco
    with cli.slow_imports():
        import torch

        from legged_torque.viewer.native import check_display
    window: list[str] = []
    with collect_errors(window):
        check_display("--viewer web")
    topics = {
        f"legged_torque {legged_torque.__version__}": [f"in {Path(legged_torque.__file__).parent}"],
        "versions": [f"{name:<14} {version}" for name, version in package_versions().items()],
        "machine": [platform.platform(), f"{os.cpu_count()} cores, threads of torch: {torch.get_num_threads()}"],
        "GPU": gpus(),
        "caches": caches(),
        "extras": extras(),
        "videos": [no_renderer or os.environ["MUJOCO_GL"]],
        "MuJoCo's window": window or ["ok"],
    }
    for title, lines in topics.items():
        print(title, *lines, sep="\n  ")


def gpus() -> list[str]:
    """Return a line per GPU of NVIDIA's driver and, if there are some that cannot be used, why."""
    import torch

    command = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
    try:
        found = subprocess.run(command, capture_output=True, text=True, timeout=20, check=True).stdout.splitlines()
    except (OSError, subprocess.SubprocessError):
        found = []  # there is no driver
    lines = [f"{line.strip()} (name, driver, memory)" for line in found] or ["none with a driver of NVIDIA"]
    if torch.version.cuda is None:
        return [*lines, "torch is a build for the CPU" + (": install one for CUDA to use the GPU" if found else "")]
    usable = [torch.cuda.get_device_name(number) for number in range(torch.cuda.device_count())]
    return [*lines, f"torch, for CUDA {torch.version.cuda}, can use: {', '.join(usable) or 'none'}"]


def caches() -> list[str]:
    """Return the folder of compiled kernels, with its number of modules."""
    import warp as wp

    import legged_torque.sim  # noqa: F401 (lets Warp print no banner)

    wp.init()
    folder = Path(wp.config.kernel_cache_dir or "")
    modules = counted(len([*folder.glob("wp_*")]), "module")
    return [f"compiled kernels: {folder}, {modules}; WARP_CACHE_PATH chooses it"]


def extras() -> list[str]:
    """Return for each extra whether all that it needs is there, or what is missing and the command that installs it."""
    try:
        requirements = [Requirement(text) for text in importlib.metadata.requires("legged_torque") or []]
    except importlib.metadata.PackageNotFoundError:
        return ["unknown, as the package is not installed: pip install -e ."]
    lines = []
    for extra, purpose in PURPOSES.items():
        wanted = [need for need in requirements if need.marker and need.marker.evaluate({"extra": extra})]
        missing = [problem for problem in map(lacking, wanted) if problem]
        hint = f"missing {', '.join(missing)}: pip install 'legged_torque[{extra}]'"
        lines.append(f"{extra:<7} {hint if missing else 'ok'} ({purpose})")
    return lines


def lacking(need: Requirement) -> str:
    """Return the name of a required package that is missing, with the versions if another is there; else nothing."""
    try:
        version = importlib.metadata.version(need.name)
    except importlib.metadata.PackageNotFoundError:
        return need.name
    return "" if need.specifier.contains(version, prereleases=True) else f"{need.name}{need.specifier} (here {version})"


if __name__ == "__main__":
    cli.run_script(main, draws=True)
