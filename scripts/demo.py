"""Steer a robot on a page, with a bundled policy: no GPU, no training.

Examples:
    python scripts/demo.py                    # a Go2 on rough ground
    python scripts/demo.py go2/position       # another policy, see policies.py; the page offers them, too

It is play.py --policy ... --viewer web, on kinds of rough ground that the policies for it cross.
"""

import argparse
import runpy
import sys

from legged_torque import SCRIPTS_DIR
from legged_torque.utils import cli

POLICY = "go2/rough_torque_multihead"
KINDS = ["stairs_up", "stairs_down", "rough_slope", "discrete_obstacles", "waves"]
ROUGH = ["--terrain", *KINDS, "--level", "0.3", "0.6"]


def main() -> None:
    """Call play.py."""
    parser = cli.Parser(__doc__)
    parser.add_argument("policy", nargs="?", default=POLICY, help="robot/approach; default: %(default)s")
    parser.add_argument("--host", default="127.0.0.1", help="address of the page; default: %(default)s")
    parser.add_argument("--port", default=8080, help="port of the page, or the next free one; default: 8080")
    parser.add_argument("--device", default="auto", help=argparse.SUPPRESS)  # of the page before, if it has chosen this
    args = parser.parse_args()
    ground = ROUGH if "rough" in args.policy else []
    words = [f"--policy={args.policy}", "--viewer=web", "--num_envs=1", f"--host={args.host}", f"--port={args.port}"]
    sys.argv[1:] = [*words, *cli.option_words(args, "device"), *ground, "--command", "0.5", "0", "0"]
    runpy.run_path(str(SCRIPTS_DIR / "play.py"), run_name="__main__")


if __name__ == "__main__":
    cli.run_script(main, draws=True)
