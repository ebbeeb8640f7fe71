"""Experiments in this process, and small stand-ins for the scripts that they start."""

import yaml
from support.clock import wait_for as wait_for  # for the tests of experiments
from support.scripts import run_here

SMALL = {
    "tasks": ["a1_position", "a1_torque"],
    "environments": {"low": ["low", "high"]},
    "seeds": [1],
    "train": {"runner.total_steps": 128},
}
"""A matrix of two cells."""

TRAIN = """
import os, signal, sys, time, zipfile
from pathlib import Path
SETTINGS = '''{task: t, env: {env: {num_envs: 5}}, train: {runner: {num_steps_per_env: 2}}, max_iterations: 4,
versions: {}}'''
options = dict(word.lstrip("-").partition("=")[::2] for word in sys.argv[1:])
here, cell = Path(__file__).parent, Path(options["log_root"]) / options["experiment_name"]
behaviour = (here / "behaviour").read_text()
runs = sorted(cell.glob("run_*"))
done = max((int(file.stem[6:]) for file in runs[-1].glob("model_*")), default=0) if "resume" in options else 0
with open(here / "order", "a") as order:
    order.write(f"{cell.name} {done} {os.getppid()}\\n")
if behaviour == f"fail {cell.name}":
    sys.exit("first\\nsomething broke")
run = cell / f"run_{int(runs[-1].name[4:]) + 1 if runs else 0}"
run.mkdir(parents=True)
(run / "config.yaml").write_text(SETTINGS)
stopped = []
signal.signal(signal.SIGTERM, lambda *_: stopped.append(1))
if behaviour.startswith("killed") and not (behaviour.endswith("once") and done):
    zipfile.ZipFile(run / "model_2.pt", "w").close()
    os.kill(os.getpid(), signal.SIGKILL)
while done < 4 and not stopped and not (behaviour == "early" and done == 2):
    done += 1
    print(f"iteration {done} of 4, 0:00:01, 0:00:02 left; tracking 0.5{done}0 (best 0.600), 0.0 falls/min", flush=True)
    if behaviour == "slow" and done == 3:
        zipfile.ZipFile(run / "model_2.pt", "w").close()
    while done == 3 and (here / "behaviour").read_text() == "slow" and not stopped:
        time.sleep(0.02)
zipfile.ZipFile(run / f"model_{done}.pt", "w").close()
if behaviour.startswith("measure"):
    for name in behaviour.split()[1:]:
        (run / name).write_text("steps\\n8\\n")
"""
"""Trains for four iterations. The file ``behaviour`` says how; "slow" waits in the third one."""

EVALUATE = """
import json, sys
from pathlib import Path
options = dict(word.lstrip("-").partition("=")[::2] for word in sys.argv[1:])
broken = Path(__file__).with_name("behaviour").read_text() == "broken"
Path(options["json"]).write_text('{"half' if broken else json.dumps(options))
"""


def write_scripts(folder):
    """Write the stand-ins into a new folder; return it."""
    folder.mkdir()
    for name, text in {"train.py": TRAIN, "evaluate.py": EVALUATE, "behaviour": "", "order": ""}.items():
        (folder / name).write_text(text)
    return folder


def order(folder):
    """The trainings that stand-ins have begun: cell, iterations before, process that started it."""
    return [line.split() for line in (folder / "order").read_text().splitlines()]


def write(file, values):
    """Write a matrix as YAML; return the file."""
    file.write_text(yaml.safe_dump(values, sort_keys=False))
    return file


def experiment_here(*words, tmp_path):
    """Run scripts/experiment.py in this process; return exit status, standard output, standard error."""
    return run_here("experiment.py", *map(str, words), root=tmp_path)
