"""Kernels of the CPU that compile in half the time: not vectorized, and with fewer functions inlined.

Warp's own settings are for long runs. ``python -m support.quick_kernels scripts/<name>.py <words>`` runs a script so.
"""

import os
import runpy
import sys

import warp as wp

wp.config.cpu_compiler_flags = "-march=native -fno-slp-vectorize -fno-vectorize"

COMMAND = [sys.executable, "-u", "-m", "support.quick_kernels"]
"""Runs the script whose file and words follow, given :data:`PATHS`."""
PATHS = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}

if __name__ == "__main__":
    del sys.argv[0]
    runpy.run_path(sys.argv[0], run_name="__main__")
