"""Pack an exported policy for others: a page that runs it in the browser, a video and a card.

The folder is a model of the Hugging Face Hub, to which --push uploads it; play.py and others take it as
--policy hf:owner/name. The page also works from any server of files.

Examples:
    python scripts/publish.py go2/torque_multihead    # then: python -m http.server -d published
    python scripts/publish.py logs/a1_torque_multihead/RUN/exported_1119 --out published --push owner/name
"""

import re
import shlex
import shutil
from pathlib import Path
from typing import Any

from legged_torque import resource_path
from legged_torque.deploy.description import DESCRIPTION_FILE, NETWORK_FILE, read
from legged_torque.utils import cli
from legged_torque.utils.devices import choose_offscreen_renderer
from legged_torque.utils.errors import UserError, printable
from legged_torque.utils.files import part_of, portable_path, without_machine, write_errors, write_whole
from legged_torque.utils.plain_yaml import dump_yaml
from legged_torque.utils.policies import CARD, check_upload, read_card, sha256, upload
from legged_torque.utils.runs import CONFIG_FILE, load_config

ROBOTS, STEPS, SHOWN_STEPS = 16, 500, 250
VIDEO = "replay.mp4"  # the name that Hugging Face shows
ABSOLUTE = re.compile(r"(?<![^\s=\[{,'\"])/[^\]},'\"]+")  # a path in a word of a command, also one of a list
README = """\
---
library_name: legged_torque
pipeline_tag: reinforcement-learning
tags: [robotics, locomotion, torque-control, mujoco]
{license_line}---
# {policy:s}

A policy of legged_torque's task `{task:s}` after {steps:,} steps of training. `policy.yaml` says how to run
`policy.onnx`; `index.html` does so in the browser, on a plane, from any server of files: `python -m http.server`.

| evaluation | tracking | falls per minute | cost of transport |
|---|---|---|---|
| {rows} |

Means and standard errors over worlds. `card.yaml` has all of them, and how they were measured.
"""
SHOWN = ("track_percentage", "falls_per_minute", "cost_of_transport")  # the columns of README
NEEDED = ("policy", "task", "steps")  # of a card, in README


def main() -> None:
    """Write the folder, and upload it if asked to."""
    parser = cli.Parser(__doc__)
    parser.add_argument("policy", type=Path, help="folder of policy.yaml and policy.onnx, or a bundled policy")
    parser.add_argument("--out", type=Path, default=Path("published"), help="new folder; default: %(default)s")
    parser.add_argument("--push", metavar="OWNER/NAME", help="also upload it to this model of the Hugging Face Hub")
    args = parser.parse_args()
    if args.out.exists():
        raise UserError(f"'{args.out}' exists: --out must be a new folder")
    cli.check_output(args.out / CARD)
    if args.push:
        check_upload(args.push)
    no_renderer = choose_offscreen_renderer()
    with cli.slow_imports():
        from legged_torque.deploy.policy import Policy
        from legged_torque.deploy.robot import MujocoRobot
        from legged_torque.deploy.simulation import Simulation, evaluate
        from legged_torque.viewer.static_page import write_page
        from legged_torque.viewer.video import SimulationRecorder
    _, network = read(args.policy)
    policy = Policy(network)
    xml = policy.description["robot"]["file"]
    if Path(xml).is_absolute():
        raise UserError(f"'{xml}' is a path of this machine: export anew with --set asset.file=RELATIVE_PATH")
    robot = MujocoRobot(resource_path(xml), policy.description)
    simulation = Simulation(policy, robot)
    recorder, part = SimulationRecorder(simulation), part_of(args.out)

    def on_step(number: int) -> None:
        if number == 0 and len(recorder.steps) < SHOWN_STEPS:
            recorder.add_step()

    with write_errors(args.out):
        part.mkdir(parents=True)
        try:
            card = copy_policy(network, part, policy.description)
            write_cards(part, {"metrics": {}} | card)  # what a card lacks is told before minutes of evaluation
            for note in write_page(part, policy, card["policy"]):
                print(printable(f"  note: {note}"))
            metrics = evaluate(simulation, 1 if "metrics" in card else ROBOTS, STEPS, 1, on_step)
            numbers = {name: [round(value.mean, 5), round(value.standard_error, 5)] for name, value in metrics.items()}
            card.setdefault("metrics", {"plain MuJoCo": numbers})
            write_cards(part, card)
            try:
                recorder.write(part / VIDEO, no_renderer)
            except UserError as error:
                print(f"no video: {error}")
            part.rename(args.out)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    print(f"Look at it: python -m http.server -d {shlex.quote(str(args.out))}")
    if args.push:
        print(f"Uploaded to {upload(args.out, args.push)}")


def copy_policy(network: Path, folder: Path, description: dict[str, Any]) -> dict[str, Any]:
    """Copy an export, and the settings and the actor of the run that it is in; return the card, or how it begins."""
    network = network.absolute()  # the run is above its folder
    export, run, training = network.parent, network.parents[1], description["training"]
    shutil.copy(network, folder / NETWORK_FILE)
    if (export / DESCRIPTION_FILE).is_file():  # the network holds it, too
        shutil.copy(export / DESCRIPTION_FILE, folder)
    if (export / CARD).is_file():
        for file in filter(Path.is_file, (export / CONFIG_FILE, export / training["checkpoint"])):
            shutil.copy(file, folder)
        return read_card(export)
    card = {"policy": f"{training['run']}, {description['task']}", "task": description["task"]}
    card |= {"steps": training["total_steps"], "versions": description["versions"]}
    card["evaluation"] = f"{ROBOTS} robots x {STEPS} steps in plain MuJoCo"
    if (run / CONFIG_FILE).is_file() and (run / training["checkpoint"]).is_file():
        from legged_torque.learning import checkpoint

        config = load_config(run)
        words = shlex.split(config.get("command", ""))
        command = shlex.join(ABSOLUTE.sub(lambda found: portable_path(found[0]), word) for word in words)
        settings = without_machine(config) | {"command": command}  # no folders of this machine, also in its command
        write_whole(folder / CONFIG_FILE, dump_yaml(settings, explicit_start=True, explicit_end=True))
        checkpoint.write_actor(run / training["checkpoint"], folder)
        card["trained"] = command
    return card


def write_cards(folder: Path, card: dict[str, Any]) -> None:
    """Write the card with the files' checksums, and README.md, which the Hub shows; a UserError if that lacks parts."""
    try:
        kinds = card["metrics"].items()
        rows = [" | ".join([kind, *("{:.3f} +- {:.3f}".format(*each[name]) for name in SHOWN)]) for kind, each in kinds]
        line = f"license: {card['license'].lower()}\n" if "license" in card else ""
        text = README.format(license_line=line, rows=" |\n| ".join(rows), **{name: card[name] for name in NEEDED})
    except (AttributeError, LookupError, TypeError, ValueError) as error:
        needed = f"{', '.join(NEEDED)}, and in metrics two numbers each of {', '.join(SHOWN)}"
        raise UserError(f"{CARD} must have {needed} ({type(error).__name__}: {error})") from None
    write_whole(folder / "README.md", text)
    described = (NETWORK_FILE, DESCRIPTION_FILE, CONFIG_FILE, *(file.name for file in folder.glob("model_*.pt")))
    card["files"] = {name: sha256(folder / name) for name in sorted(described) if (folder / name).is_file()}
    write_whole(folder / CARD, dump_yaml(card, width=100))


if __name__ == "__main__":
    cli.run_script(main, draws=True)
