"""What is read of a log, and logs that are refused."""

from dataclasses import replace

import numpy as np
import pytest
from support.one_leg import TILT, noisy, write_log
from support.settings import error_of

from legged_torque.identification.recording import Recording, read_recording
from legged_torque.runtime.controller import Mode
from legged_torque.runtime.log import RecordedLog


@pytest.fixture
def written():
    """Random numbers, three ticks without a state."""
    commands, measured = (np.random.default_rng(1).normal(size=(3600, rows, 3)) for rows in (5, 2))
    return noisy(Recording(["a", "b", "c"], 0.002, TILT, commands, measured))


def test_late_ticks_and_other_modes(written, tmp_path):
    """Only the longest motion counts; ticks stand where they were due. Late ones leave gaps, unless robots wait."""
    times = 0.002 * np.arange(3600) + 0.0004
    times[1000] += 0.0018
    modes = [*[Mode.STAND] * 200, *[Mode.POLICY] * 100, *[Mode.STAND] * 100, *[Mode.POLICY] * 3200]
    write_log(tmp_path / "log.mcap", written, "task", modes, times)
    read = read_recording(RecordedLog(tmp_path / "log.mcap"))
    expected = replace(written, commands=written.commands[400:].copy(), measured=written.measured[400:].copy())
    expected.commands[600], expected.measured[600] = written.commands[999], np.nan  # which was the newest then
    for name in ("joint_order", "period", "commands", "measured"):
        np.testing.assert_array_equal(getattr(read, name), getattr(expected, name))
    np.testing.assert_allclose(read.quaternion, TILT, atol=1e-12)
    log = RecordedLog(tmp_path / "log.mcap")
    log.keeps_time = False
    for name in ("commands", "measured"):
        np.testing.assert_array_equal(getattr(read_recording(log), name), getattr(written, name)[400:])


def test_refused(written, tmp_path):
    """Too little, nothing at first, and a trunk that swings."""
    angles = 0.04 * np.sin(np.arange(3600))
    swinging = np.stack([np.cos(angles), np.sin(angles), 0 * angles, 0 * angles], axis=1)
    late = replace(written, measured=written.measured.copy())
    late.measured[0] = np.nan
    few = replace(written, commands=written.commands[:100], measured=written.measured[:100])
    cases = {"swings by 0.08 rad": replace(written, quaternion=swinging), "no state": late, "the log has 0.2 s": few}
    for number, (words, recording) in enumerate(cases.items()):
        write_log(tmp_path / f"{number}.mcap", recording, "task")
        assert words in error_of(read_recording, RecordedLog(tmp_path / f"{number}.mcap"))
