"""Steer a robot on a page, with a bundled policy: no GPU, no training.

Examples:
    python scripts/demo.py                    # a Go2 on rough ground
    python scripts/demo.py go2/position       # another policy, see policies.py

It is play.py --policy ... --viewer web --terrain ..., with a ground that such policies cross.
"""

import runpy
import sys
from typing import Annotated

from legged_torque import SCRIPTS_DIR
from legged_torque.utils import cli
from legged_torque.utils.limits import Limits
from legged_torque.utils.policies import policy_dir

POLICY = "go2/torque_multihead"
GROUND = ["--terrain", "rough_slope", "waves", "--level", "0.2", "0.3"]


def main() -> None:
    """Call play.py."""
    parser = cli.Parser(__doc__)
    parser.add_argument("policy", nargs="?", default=POLICY, help="robot/approach; default: %(default)s")
    parser.add_argument("--port", type=int, default=8080, help="port of the page, or the next free one; default: 8080")
    args = parser.parse_args()
    cli.check_args(args, port=Annotated[int, Limits(1, 65535)])
    policy_dir(args.policy)  # or its error
    words = [f"--policy={args.policy}", "--viewer=web", "--num_envs=1", f"--port={args.port}", *GROUND]
    sys.argv[1:] = [*words, "--command", "0.5", "0", "0"]
    runpy.run_path(str(SCRIPTS_DIR / "play.py"), run_name="__main__")


if __name__ == "__main__":
    cli.run_script(main, draws=True)
