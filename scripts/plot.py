"""Draw figures.

Each figure has options of its own: plot.py curves --help.

Examples:
    python scripts/plot.py curves logs/a1_torque/*/evaluations.csv --out curves.png
    python scripts/plot.py pretraining report.json --out pretraining.png
    python scripts/plot.py randomization --out distributions.png
    python scripts/plot.py terrain --out tiles.png
"""

import importlib
import os
import sys

from legged_torque.utils import cli
from legged_torque.utils.errors import unknown_name

FIGURES = {
    "curves": "legged_torque.paper.plot:plot_curves",
    "pretraining": "legged_torque.paper.plot:plot_pretraining",
    "randomization": "legged_torque.paper.randomization_picture:plot_randomization",
    "terrain": "legged_torque.paper.terrain_picture:plot_terrain",
}
"""Functions ("module:name") by figure: each parses its own command line, ``sys.argv``, and draws."""


def main() -> None:
    """Run the function of the figure that the first word names, with the other words as its command line."""
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    is_completing = "_ARGCOMPLETE" in os.environ
    if name in FIGURES:
        sys.argv = [f"{sys.argv[0]} {name}", *sys.argv[2:]]
        if is_completing:  # one more word of the line names the command
            os.environ["_ARGCOMPLETE"] = str(int(os.environ["_ARGCOMPLETE"]) + 1)
        module, _, function = FIGURES[name].partition(":")
        getattr(importlib.import_module(module), function)()
        return
    if not name.startswith("-") and not is_completing:
        raise unknown_name("figure", name, FIGURES)
    parser = cli.Parser(__doc__)
    parser.add_argument("figure", choices=FIGURES, help="the figure to draw")
    parser.parse_args(sys.argv[1:] or ["--help"])


if __name__ == "__main__":
    cli.run_script(main)
