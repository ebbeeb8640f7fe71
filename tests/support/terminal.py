"""Shared by tests: code in a terminal."""

import contextlib
import fcntl
import os
import pty
import signal
import struct
import subprocess
import sys
import termios

from support.scripts import ROOT


def in_a_terminal(code, columns=80, rows=40, after="", close=False, **variables):
    """Run code in a terminal; once ``after`` has come, press Ctrl-C or close it. Return exit status and output."""
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
    environment = {key: value for key, value in os.environ.items() if key not in ("COLUMNS", "NO_COLOR", "LINES")}
    environment |= {"PYTHONPATH": str(ROOT), "TERM": "xterm-256color", "PYTHONUTF8": "1", **variables}
    streams = {"stdin": slave, "stdout": slave, "stderr": slave}

    def take_terminal():
        """Make it the controlling one, and notice when it closes, also in tests that run under nohup."""
        fcntl.ioctl(slave, termios.TIOCSCTTY, 0)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)

    how = {"env": environment, "start_new_session": True, "preexec_fn": take_terminal}
    process = subprocess.Popen([sys.executable, "-c", code], **streams, **how)
    os.close(slave)
    output = b""
    with contextlib.suppress(OSError):  # at the end of a terminal
        while data := os.read(master, 65536):
            output += data
            if after and after in output.decode(errors="replace"):
                if close:
                    break
                process.send_signal(signal.SIGINT)
                after = ""
    os.close(master)
    return process.wait(120), output.decode()
