"""Draw figures.

Examples:
    python scripts/plot.py curves logs/a1_torque/*/evaluations.csv --out curves.png
    python scripts/plot.py pretraining report.json --out pretraining.png
    python scripts/plot.py randomization --out distributions.png
    python scripts/plot.py sweeps sweeps/*.json --out sweeps.png

Each figure has options of its own: plot.py curves --help.
"""

import pkgutil
import sys

from legged_torque.utils import cli

FIGURES = {
    "curves": "legged_torque.paper.plot:plot_curves",
    "pretraining": "legged_torque.paper.plot:plot_pretraining",
    "randomization": "legged_torque.paper.randomization_picture:plot_randomization",
    "sweeps": "legged_torque.paper.sweep_picture:plot_sweeps",
}
"""Functions ("module:name") by figure: each parses its own command line, ``sys.argv``, and draws."""


def main() -> None:
    """Run the function of the figure that the first word names, with the other words as its command line."""
    name = cli.take_command("figure", list(FIGURES))
    if name:
        pkgutil.resolve_name(FIGURES[name])()
        return
    parser = cli.Parser(__doc__)
    parser.add_argument("figure", choices=FIGURES, help="the figure to draw")
    parser.parse_args(sys.argv[1:] or ["--help"])


if __name__ == "__main__":
    cli.run_script(main)
