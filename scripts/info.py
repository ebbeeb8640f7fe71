"""Show what is installed and what is missing: ``python scripts/info.py``.

Versions, processor, GPU and driver, where compiled kernels are kept, and which extras can be used.
"""

from legged_torque.utils.interrupt import end_on_interrupt
from legged_torque.utils.rendering import choose_offscreen_renderer

end_on_interrupt()
NO_RENDERER = choose_offscreen_renderer()  # before anything imports mujoco

import os

from legged_torque.utils.cli import Parser, importing, run_script
from legged_torque.utils.errors import told_in


def main() -> None:
    """Print a block of lines per topic."""
    Parser(__doc__).parse_args()
    with importing():
        from legged_torque.benchmark.installation import topics
        from legged_torque.viewer.native import check_display
    no_window: list[str] = []
    with told_in(no_window):
        check_display("--viewer web")
    shown = {"videos": NO_RENDERER or os.environ["MUJOCO_GL"], "MuJoCo's window": " ".join(no_window) or "ok"}
    for title, lines in (topics() | {"rendering": [f"{what}: {text}" for what, text in shown.items()]}).items():
        print(title, *lines, sep="\n  ")


if __name__ == "__main__":
    run_script(main)
