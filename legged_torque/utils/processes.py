"""Processes that end when the process that has started them does, even when it is killed; only Linux can do so."""

from __future__ import annotations

import ctypes
import signal
import sys

_PR_SET_PDEATHSIG = 1  # of linux/prctl.h
_END_WITH_PARENT = f"""
import ctypes, os, sys
ctypes.CDLL(None).prctl({_PR_SET_PDEATHSIG}, {int(signal.SIGTERM)}, 0, 0, 0)
os.execvp(sys.argv[1], sys.argv[1:])
"""


def end_with_parent() -> None:
    """Let this process get SIGTERM when its parent ends for any reason."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGTERM), 0, 0, 0)


def ending_with_parent(command: list[str]) -> list[str]:
    """Return a command whose process gets SIGTERM when this process ends for any reason.

    ``preexec_fn`` of Popen would save one start of Python, but is not safe in a process with threads, such as a
    training.
    """
    return [sys.executable, "-I", "-c", _END_WITH_PARENT, *command] if sys.platform == "linux" else command
