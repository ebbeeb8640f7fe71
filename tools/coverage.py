"""Try identify.py on logs with known numbers: ``python -m tools.coverage rows.csv --trials 0 100``.

In each trial, drives are drawn at random for a robot that hangs in plain MuJoCo and follows deploy.py's chirp, with
late commands and noisy encoders. A row for each number is added to the file; trials that it has are left out.
Processes beside each other take a file and a range each. Without --trials, files are only summed up.
"""

import csv
import time
from pathlib import Path

import mujoco
import numpy as np

from legged_torque import resource_path
from legged_torque.deploy.policy import Policy
from legged_torque.deploy.robot import joints_and_motors
from legged_torque.envs import task_registry
from legged_torque.identification.fit import ROUNDS, identify
from legged_torque.identification.recording import Recording
from legged_torque.identification.worlds import FIELDS, PARAMETERS
from legged_torque.runtime.chirp import Chirp
from legged_torque.utils import cli
from legged_torque.utils.devices import resolve_device
from legged_torque.utils.display import Counter, warn
from legged_torque.utils.errors import UserError
from legged_torque.utils.files import append_whole
from legged_torque.utils.limits import Number
from legged_torque.utils.mjcf import set_joints, torque_range
from legged_torque.utils.runs import commit

POLICY, SECONDS = "go2/torque_multihead", 40.0  # whose robot, pose and gains it is; of a log
RATE, STEP = 500.0, 2e-4  # ticks per second; [s] of the truth's physics: half of it moves no velocity by 1e-4 rad/s
DRAWN = np.array([[0.008, 0.03], [0.05, 0.4], [0.15, 0.9], [0.02, 0.06]])  # as PARAMETERS; biases have either sign
DELAY, SETTLE = 0.005, 0.5  # [s]; the latter before a log begins
NOISE = np.array([[5e-4], [0.05]])  # of encoders [rad, rad/s]
KEYS = ("trial", "joint", "parameter", "truth", "estimate", "low", "high", "covered", "seconds", "commit")
COMMIT = commit().removeprefix("+g")


def simulate(file: Path, names: list[str], commands: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return what encoders say at the start of each tick, of a robot of a file on a fixed trunk, without noise.

    Drives act continuously, with the gains of the first command, and steps are of Runge and Kutta: what a fit gets
    wrong because its steps are longer is its error. Shapes: (ticks, 5, joints), (5, joints) to (ticks, 2, joints).
    """
    spec, (_, targets, _, stiffness, damping) = mujoco.MjSpec.from_file(str(file)), commands.transpose(1, 0, 2)
    for part in [*spec.keys, *(joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE)]:
        spec.delete(part)
    spec.option.timestep, spec.option.integrator = STEP, mujoco.mjtIntegrator.mjINT_RK4
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONTACT
    model = spec.compile()
    fields = (field.removeprefix("dof_") for field in FIELDS.values())
    set_joints(model, {field: dict(zip(names, row, strict=True)) for field, row in zip(fields, truth, strict=False)})
    joints, motors = joints_and_motors(model, names)
    model.actuator_forcerange[motors] = [torque_range(model, motor) for motor in motors]
    model.actuator_forcelimited[motors], model.actuator_ctrllimited[motors], model.actuator_gear[motors, 0] = 1, 0, 1.0
    model.actuator_biastype[motors], model.actuator_gainprm[motors, 0] = mujoco.mjtBias.mjBIAS_AFFINE, stiffness[0]
    model.actuator_biasprm[motors, :3] = np.stack([stiffness[0] * truth[3], -stiffness[0], -damping[0]], axis=1)
    data, positions, velocities = mujoco.MjData(model), model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    substeps, measured = round(1.0 / (RATE * STEP)), []
    ticks_late, steps_late = divmod(round(truth[4, 0] / STEP), substeps)
    data.qpos[positions], data.ctrl[motors] = targets[0] + truth[3], targets[0]
    mujoco.mj_step(model, data, round(SETTLE / STEP))
    for tick in range(len(targets)):
        measured.append((data.qpos[positions] - truth[3], data.qvel[velocities]))
        for late, steps in ((ticks_late + 1, steps_late), (ticks_late, substeps - steps_late)):
            data.ctrl[motors] = targets[max(tick - late, 0)]
            mujoco.mj_step(model, data, steps)
    return np.array(measured)


def make_log(policy: Policy, trial: int) -> tuple[Recording, np.ndarray]:
    """Return the log of a random robot with a policy's gains, and its numbers by joint (5, joints)."""
    names, chirp, rng = policy.joint_order, Chirp(policy, RATE, SECONDS), np.random.default_rng(trial)
    low, high = DRAWN.T[..., None]
    truth = np.vstack([rng.uniform(low, high, (4, len(names))), np.full(len(names), DELAY)])
    truth[3] *= rng.choice([-1.0, 1.0], len(names))
    commands = np.zeros((round(RATE * SECONDS), 5, len(names)))
    for command in commands:
        tau, target, kp, kd = chirp.drive_targets(chirp.act(np.zeros(0)))
        command[:] = tau, target, np.zeros_like(target), kp, kd
    measured = simulate(resource_path(policy.description["robot"]["file"]), names, commands, truth)
    measured += NOISE * rng.normal(size=measured.shape)
    return Recording(names, 1.0 / RATE, np.array([1.0, 0.0, 0.0, 0.0]), commands, measured), truth


def run_trial(policy: Policy, trial: int, device: str, counter: Counter) -> str:
    """Return the rows of a trial as CSV; numbers of a log that is refused are NaN, and not covered."""
    (recording, truth), start = make_log(policy, trial), time.perf_counter()
    values = halves = np.full_like(truth, np.nan)
    try:
        found = identify(task_registry.get_cfgs(policy.description["task"])[0], recording, device, counter.add)
        values, halves = found.values, found.half_widths
    except UserError as error:
        warn(f"trial {trial} is refused: {error}")
    took, lines = time.perf_counter() - start, []
    for number, kind in enumerate(PARAMETERS):
        for joint, name in enumerate(recording.joint_order if kind != "delay" else ["all"]):
            true, value, half = (each[number, joint] for each in (truth, values, halves))
            numbers = ",".join(f"{each:.8g}" for each in (true, value, value - half, value + half))
            numbers += f",{int(abs(value - true) <= half)}"
            lines.append(f"{trial},{name},{kind},{numbers},{took:.1f},{COMMIT}\n")
    return "".join(lines)


def read_rows(files: list[Path]) -> list[dict[str, str]]:
    """Return the rows of files; a UserError if one is not of this program, or two have the same trial."""
    rows: list[dict[str, str]] = []
    for file in files:
        with file.open(encoding="utf-8", newline="") as stream:
            reader = csv.DictReader(stream)
            if tuple(reader.fieldnames or ()) != KEYS:
                raise UserError(f"'{file}' must have the columns {', '.join(KEYS)}")
            new = list(reader)
        if twice := {row["trial"] for row in rows} & {row["trial"] for row in new}:
            raise UserError(f"'{file}' has trial {min(twice, key=int)}, as another file does")
        rows += new
    return rows


def summary(rows: list[dict[str, str]]) -> str:
    """Return a table of all rows; errors leave out refused trials, intervals count them as wrong."""
    seconds = np.array([*{row["trial"]: float(row["seconds"]) for row in rows}.values()])
    refused = {row["trial"] for row in rows if row["estimate"] == "nan"}
    times = f"{np.median(seconds):.0f} s a fit, at most {seconds.max():.0f}"
    lines = [f"{len(seconds)} trials, {len(refused)} refused; {times}"]
    lines += [f"{'':<17} covered  largest error, relative  in half intervals"]
    for kind in (*PARAMETERS, "all"):
        of = [row for row in rows if kind in (row["parameter"], "all")]
        numbers = np.array([[float(row[key]) for key in ("truth", "estimate", "high", "covered")] for row in of])
        true, value, high, covered = numbers.T
        errors = np.abs(value - true), np.abs(true), high - value
        largest = [np.max(errors[0] / by, where=~np.isnan(value), initial=0.0) for by in errors[1:]]
        lines.append(f"{kind:<17} {covered.mean():7.1%}  {largest[0]:23.2%}  {largest[1]:17.2f}")
    return "\n".join(lines)


def main() -> None:
    """Make trials if any are asked for, and sum up."""
    parser = cli.Parser(__doc__)
    parser.add_argument("files", type=Path, nargs="+", help="CSV files; trials are added to a single one")
    parser.add_argument("--trials", type=int, nargs=2, metavar=("FIRST", "END"), help="seeds, END not included")
    cli.add_options(parser, "device")
    args = parser.parse_args()
    cli.check_args(args, trials=list[Number])
    if args.trials:
        if len(args.files) > 1:
            raise UserError(f"--trials takes one file, not {len(args.files)}")
        file, policy, device = args.files[0], Policy(POLICY), resolve_device(args.device)
        if not file.exists():
            append_whole(file, ",".join(KEYS) + "\n")
        rows = read_rows([file])
        if others := {row["commit"] for row in rows} - {COMMIT}:
            raise UserError(f"'{file}' has trials of commit {min(others)}, not {COMMIT}: give another file")
        done = {int(row["trial"]) for row in rows}
        trials = [trial for trial in range(*args.trials) if trial not in done]
        with Counter("identifying, round", ROUNDS * len(trials)) as counter:
            for count, trial in enumerate(trials, 1):
                append_whole(file, run_trial(policy, trial, device, counter))
                counter.done = ROUNDS * count  # fits may end before
    if not (rows := read_rows(args.files)):
        raise UserError("there are no trials yet: give --trials FIRST END")
    print(summary(rows))


if __name__ == "__main__":
    cli.run_script(main)
