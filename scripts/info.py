"""Show what is installed and what is missing: ``python scripts/info.py``.

Versions, processor, GPU and driver, where compiled kernels are kept, and which extras can be used.
"""

import os

from legged_torque.utils.cli import Parser, run_script, slow_imports
from legged_torque.utils.errors import collect_errors
from legged_torque.utils.rendering import choose_offscreen_renderer


def main() -> None:
    """Print a block of lines per topic."""
    Parser(__doc__).parse_args()
    no_renderer = choose_offscreen_renderer()
    with slow_imports():
        from legged_torque.benchmark.installation import topics
        from legged_torque.viewer.native import check_display
    no_window: list[str] = []
    with collect_errors(no_window):
        check_display("--viewer web")
    shown = {"videos": no_renderer or os.environ["MUJOCO_GL"], "MuJoCo's window": " ".join(no_window) or "ok"}
    for title, lines in (topics() | {"rendering": [f"{what}: {text}" for what, text in shown.items()]}).items():
        print(title, *lines, sep="\n  ")


if __name__ == "__main__":
    run_script(main, draws=True)
