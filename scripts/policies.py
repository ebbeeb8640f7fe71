"""List the bundled policies: ``python scripts/policies.py``.

Each is a folder below resources/policies, whose card.yaml says how it was trained and measured. play.py, evaluate.py
and export.py take one as --policy, sim2sim.py and deploy.py in place of a file.
"""

from legged_torque.utils import cli
from legged_torque.utils.policies import policy_dir, policy_names, read_card


def main() -> None:
    """Print a line per policy."""
    cli.Parser(__doc__).parse_args()
    print(f"{'policy':<24} {'task':<28} {'steps':>12}  {'tracking':<18} falls per minute")
    for name in policy_names():
        card = read_card(policy_dir(name))
        measured = {metric: card["metrics"][metric] for metric in ("track_percentage", "falls_per_minute")}
        texts = [f"{mean:.3f} +- {error:.3f}" for mean, error in measured.values()]
        print(f"{name:<24} {card['task']:<28} {card['steps']:>12,}  {texts[0]:<18} {texts[1]}")


if __name__ == "__main__":
    cli.run_script(main)
