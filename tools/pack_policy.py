"""Pack a checkpoint of a run as a bundled policy: ``python tools/pack_policy.py RUN go2/torque_multihead``.

The folder gets the actor, its export, the settings, and a card with what ``evaluate.py`` measures and checksums.
"""

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path

import yaml

from legged_torque import SCRIPTS_DIR
from legged_torque.learning import checkpoint
from legged_torque.utils import cli
from legged_torque.utils.files import write_whole
from legged_torque.utils.plain_yaml import Dumper
from legged_torque.utils.policies import CARD, POLICIES_DIR, sha256
from legged_torque.utils.runs import CONFIG_FILE, find_checkpoint, load_config

EVALUATION = ["--device=cpu", "--num_envs=64", "--steps=2000", "--seed=1"]
"""Options of evaluate.py with which the numbers of a card are measured."""


def main() -> None:
    """Pack."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="folder of a run")
    parser.add_argument("name", help="robot/approach")
    parser.add_argument("--checkpoint", type=int, help="default: the last one")
    parser.add_argument("--machine", required=True, help="on what it was trained, for the card")
    parser.add_argument("--note", default="", help="what else users should know, for the card")
    args = parser.parse_args()
    folder, file, config = POLICIES_DIR / args.name, find_checkpoint(args.run, args.checkpoint), load_config(args.run)
    shutil.rmtree(folder, ignore_errors=True)
    content = checkpoint.read(file, "checkpoint", "cpu")
    checkpoint.write(folder / file.name, {key: content[key] for key in ("actor_state_dict", "iter", "infos")})
    shutil.copy(args.run / CONFIG_FILE, folder)
    how = ["--log_root=.", f"--load_run={folder}", "--device=cpu"]
    run("export", *how, f"--out={folder / 'exported'}")
    for part in ("policy.onnx", "policy.yaml"):
        shutil.move(folder / "exported" / part, folder)
    shutil.rmtree(folder / "exported")
    result = folder / "measured.json"
    run("evaluate", *how[:2], *EVALUATION, f"--json={result}")
    measured = json.loads(result.read_text())["metrics"]
    result.unlink()
    card = {
        "policy": args.name,
        "task": config["task"],
        "note": args.note,
        "steps": int(content["infos"]["total_timesteps"]),
        "seed": config["train"]["seed"],
        "trained": {key: config.get(key) for key in ("command", "versions")} | {"machine": args.machine},
        "evaluation": " ".join(EVALUATION),
        "metrics": {
            name: [round(each[key], 5) for key in ("mean", "standard_error")] for name, each in measured.items()
        },
        "license": "BSD-3-Clause",
        "files": {path.name: sha256(path) for path in sorted(folder.iterdir())},
    }
    write_whole(folder / CARD, yaml.dump(card, Dumper=Dumper, sort_keys=False, width=100))


def run(script: str, *words: str) -> None:
    """Run a script."""
    subprocess.run([sys.executable, SCRIPTS_DIR / f"{script}.py", *words], check=True)


if __name__ == "__main__":
    cli.run_script(main)
