"""NVIDIA's Multi-Process Service around an experiment, with a stand-in for its program: this machine has no GPU."""

import os
import signal

import pytest

from legged_torque.experiments.local_launcher import MPS, multi_process_service
from legged_torque.utils.errors import UserError


@pytest.fixture
def program(tmp_path, monkeypatch):
    """A program that notes arguments, input, folder and devices, and may refuse; returns where it notes them."""
    notes, file = tmp_path / "notes", tmp_path / MPS
    noted = '$*|$([ "$1" ] || cat)|$CUDA_MPS_PIPE_DIRECTORY|$CUDA_VISIBLE_DEVICES'
    stays = f'[ "$1" ] && {{ sleep 60 & echo $! > {notes}.pid; }}'  # with its output open, as a service does
    file.write_text(f'#!/bin/sh\necho "{noted}" >> {notes}\n{stays}\necho "it is $1"\n[ ! -e {notes}.no ]\n')
    file.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    yield notes
    os.kill(int(notes.with_name("notes.pid").read_text()), signal.SIGKILL)  # fails if it was waited for


def test_service(program, monkeypatch):
    """It runs with a folder of its own while the context is open, also when that ends by an error, and no longer."""
    monkeypatch.setenv("CUDA_MPS_PIPE_DIRECTORY", "/mine")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,3")  # would be 0, 1 to programs that use the service
    before = dict(os.environ)
    with pytest.raises(KeyError), multi_process_service() as variables:
        (folder,) = set(variables.values())
        assert variables.keys() == {"CUDA_MPS_PIPE_DIRECTORY", "CUDA_MPS_LOG_DIRECTORY"}
        assert os.path.isdir(folder) and program.read_text() == f"-d||{folder}|\n"
        raise KeyError
    assert program.read_text().splitlines()[1:] == [f"|quit|{folder}|"]
    assert dict(os.environ) == before and not os.path.exists(folder)


def test_service_that_refuses(program):
    """Its words are the error, and the work is not begun."""
    program.with_name("notes.no").touch()
    with pytest.raises(UserError, match=f"--mps: {MPS} says: it is -d"), multi_process_service():
        raise AssertionError("the service has not started")
