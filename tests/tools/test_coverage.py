"""Logs with known numbers against another simulation of them, and what is counted of fits whose errors are known."""

import sys
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from support.one_leg import NOISE, PERIOD, POSE, TRUTH, fixed, one_leg, record, sweep
from support.scripts import assert_told_in_one_line, run_here
from support.settings import error_of

from legged_torque.deploy.policy import Policy
from legged_torque.utils.errors import UserError
from tools import coverage


def test_simulation(tmp_path):
    """Short semi-implicit steps, in which drives compute torques themselves, go to the same places."""
    leg, step = one_leg(tmp_path), 5e-5
    late = round(TRUTH[4, 0] / step)  # and half a step, since velocities are of half a step ago
    recording = record(leg, sweep(0.6))
    data, substeps, bias = mujoco.MjData(model := fixed(leg, step).compile()), round(PERIOD / step), TRUTH[3]
    data.qpos[:], measured, past = np.add([*POSE.values()], bias), [], np.zeros(3)
    for number in range(-round(coverage.SETTLE / step), len(recording.commands) * substeps):
        pos, vel, past = data.qpos - bias, 1.5 * data.qvel - 0.5 * past, data.qvel.copy()
        if number >= 0 and number % substeps == 0:
            measured.append((pos, vel))
        target = sum(recording.commands[max(number - late - more, 0) // substeps, 1] for more in (0, 1)) / 2
        data.ctrl[:] = 20.0 * (target - pos) - 0.5 * vel
        mujoco.mj_step(model, data)
    for number, atol in enumerate((2e-5, 2e-3)):
        np.testing.assert_allclose(recording.measured[:, number], np.array(measured)[:, number], atol=atol)
    assert np.ptp(recording.measured[:, 0], axis=0).min() > 0.1


def test_noise_and_numbers(monkeypatch):
    """Trials differ, and repeat themselves; encoders have the noise of the documentation, and biases either sign."""
    policy = Policy(coverage.POLICY)
    monkeypatch.setattr(coverage, "SECONDS", 0.5)
    logs, truths = zip(*(coverage.make_log(policy, trial) for trial in (0, 0, 1)), strict=True)
    monkeypatch.setattr(coverage, "NOISE", 0.0)
    noise = logs[0].measured - coverage.make_log(policy, 0)[0].measured
    np.testing.assert_allclose(noise.std(axis=(0, 2)), NOISE[:, 0], rtol=0.05)
    np.testing.assert_array_equal(logs[0].measured, logs[1].measured)
    assert (truths[0][:4] != truths[2][:4]).all() and (truths[0][4] == 0.005).all()
    assert {*np.sign(truths[0][3])} == {-1.0, 1.0} and logs[0].joint_order == policy.joint_order


def test_what_is_counted(tmp_path, monkeypatch, capsys):
    """Fits off by 1% with intervals of 2%, for which the delay's is too narrow; a refused one; none a second time."""
    fits = []

    def identify(cfg, recording, device, progress):
        """Answer of the trial that is next."""
        fits.append(truth := coverage.make_log(Policy(coverage.POLICY), len(fits))[1])
        if len(fits) == 3:
            raise UserError("nothing moves")
        shares = np.array([0.02, 0.02, 0.02, 0.02, 0.005])[:, None]
        return SimpleNamespace(values=1.01 * truth, half_widths=shares * np.abs(truth))

    monkeypatch.setattr(coverage, "identify", identify)
    monkeypatch.setattr(coverage, "SECONDS", 0.1)
    monkeypatch.setattr(sys, "argv", ["coverage", file := str(tmp_path / "a.csv"), "--trials", "0", "2"])
    sys.argv += ["--device", "cpu"]
    coverage.main()
    said = capsys.readouterr().out
    assert said.startswith("2 trials, 0 refused;") and len(fits) == 2
    assert [line.split() for line in said.splitlines()[2:]] == [
        *([kind, "100.0%", "1.00%", "0.50"] for kind in coverage.PARAMETERS[:4]),
        ["delay", "0.0%", "1.00%", "2.00"],
        ["all", "98.0%", "1.00%", "2.00"],
    ]
    sys.argv[4] = "3"
    coverage.main()
    output = capsys.readouterr()
    assert len(fits) == 3 and "trial 2 is refused: nothing moves" in output.err
    assert "3 trials, 1 refused;" in output.out and output.out.splitlines()[-1].split()[1] == "65.3%"
    rows = coverage.read_rows([tmp_path / "a.csv"])
    assert len(rows) == 3 * 49 and {row["parameter"] for row in rows} == {*coverage.PARAMETERS}
    monkeypatch.setattr(coverage, "COMMIT", "another")
    assert "has trials of commit" in error_of(coverage.main) and len(fits) == 3
    sys.argv[1:] = [file, file]
    assert error_of(coverage.main).endswith("has trial 0, as another file does")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["rows.csv"], "there are no trials yet"),
        (["rows.csv", "--trials", "-1", "2"], "--trials[0] must be at least 0"),
        (["rows.csv", "b.csv", "--trials", "0", "2"], "--trials takes one file, not 2"),
        (["other.csv"], "must have the columns trial, joint"),
        (["none.csv"], "No such file"),
    ],
)
def test_mistakes(tmp_path, words, message):
    """Each is refused in a line."""
    (tmp_path / "rows.csv").write_text(",".join(coverage.KEYS) + "\n")
    (tmp_path / "other.csv").write_text("a,b\n")
    assert_told_in_one_line(run_here("../tools/coverage.py", *words, root=tmp_path), message)
