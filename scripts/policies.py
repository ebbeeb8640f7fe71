"""List the bundled policies: ``python scripts/policies.py``.

Each is a folder below resources/policies, whose card.yaml says how it was trained and measured. play.py, evaluate.py
and export.py take one as --policy, sim2sim.py and deploy.py in place of a file.
"""

from legged_torque.utils import cli
from legged_torque.utils.policies import policy_dir, policy_names, read_card


def main() -> None:
    """Print a line per policy."""
    cli.Parser(__doc__).parse_args()
    print(f"{'policy':<32} {'steps':>12}  {'tracking':<15} {'with perturbations':<18} falls per minute with them")
    for name in policy_names():
        card = read_card(policy_dir(name))
        metrics = [card["metrics"][kind] for kind in ("none", "low")]
        texts = ["{:.3f} +- {:.3f}".format(*each["track_percentage"]) for each in metrics]
        falls = "{:.3f} +- {:.3f}".format(*metrics[1]["falls_per_minute"])
        print(f"{name:<32} {card['steps']:>12,}  {texts[0]:<15} {texts[1]:<18} {falls}")


if __name__ == "__main__":
    cli.run_script(main)
