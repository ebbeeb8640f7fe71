"""Runs of strangers, and scripts that load them."""

import yaml
from support.scripts import run_here

LOADING = {
    "train.py": ["--resume", "--num_envs=2", "--max_iterations=2", "--logger=none"],
    "play.py": ["--steps=1", "--num_envs=2"],
    "evaluate.py": ["--steps=1", "--num_envs=2"],
    "export.py": [],
}
"""Scripts that load a run, and words that make it short."""


class Payload:
    """An object whose pickle creates a file when it is loaded."""

    def __init__(self, file):
        self.file = file

    def __reduce__(self):
        return open, (str(self.file), "w")


def load_run(script, run, *words):
    """Load a run with a script, in the folder of its logs."""
    all_words = ["--task=a1_position", "--device=cpu", *LOADING[script], *words]
    return run_here(script, *all_words, root=run.parents[2])


def edit_config(run, **changes):
    """Change settings of a run's training, given with ``__`` in place of dots."""
    config = yaml.safe_load((run / "config.yaml").read_text())
    for path, value in changes.items():
        *sections, key = path.split("__")
        part = config["train"]
        for section in sections:
            part = part[section]
        part[key] = value
    (run / "config.yaml").write_text(yaml.safe_dump(config))
