"""Shared by tests: experiments."""

import time

import yaml
from support.scripts import run_here

SMALL = {
    "tasks": ["a1_position", "a1_torque"],
    "environments": {"low": ["low", "high"]},
    "seeds": [1],
    "train": {"runner.total_steps": 128},
}


"""A matrix of two cells."""


def write(file, values):
    """Write a matrix as YAML; return the file."""
    file.write_text(yaml.safe_dump(values, sort_keys=False))
    return file


def wait_for(condition, seconds=120):
    """Return what a condition returns as soon as that is true."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)
    return condition()


def experiment_here(*words, tmp_path):
    """Run scripts/experiment.py in this process; return exit status, standard output, standard error."""
    return run_here("experiment.py", *map(str, words), root=tmp_path)
