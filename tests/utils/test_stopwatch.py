"""The seconds of a process by stage."""

import subprocess
import sys
import time

PROGRAM = """import time
from legged_torque.utils.stopwatch import stopwatch
for stage in ("a", "b", "a"):
    time.sleep(0.2)
    stopwatch.lap(stage)
print(stopwatch, *stopwatch.seconds.values(), sep=" | ")
"""


def test_every_second_counts():
    """A stage may go on later; the first has the process's start too, and all together are no more than its life."""
    began = time.perf_counter()
    output = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True).stdout
    lived = time.perf_counter() - began
    text, first, second = output.split(" | ")
    assert text == f"a {float(first):.1f} s, b {float(second):.1f} s"
    assert float(second) >= 0.2 and float(first) > 0.4 + 0.01 and float(first) + float(second) <= lived + 0.02
