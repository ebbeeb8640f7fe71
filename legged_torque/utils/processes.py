"""Commands for processes that this process starts."""

import signal
import sys

_END_WITH_PARENT = f"""
import ctypes, os, sys
ctypes.CDLL(None).prctl(1, {int(signal.SIGTERM)}, 0, 0, 0)  # PR_SET_PDEATHSIG of linux/prctl.h
os.execvp(sys.argv[1], sys.argv[1:])
"""


def ending_with_parent(command: list[str]) -> list[str]:
    """Return a command whose process gets SIGTERM when this process ends for any reason, even when it is killed.

    Only Linux can do so; elsewhere the command is returned unchanged. ``preexec_fn`` of Popen would save one start of
    Python, but is not safe in a process with threads, such as a training.
    """
    return [sys.executable, "-I", "-c", _END_WITH_PARENT, *command] if sys.platform == "linux" else command
