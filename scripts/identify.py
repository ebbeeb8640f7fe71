"""Identify the drives of a robot that hangs in the air, from a log of deploy.py --chirp.

Examples:
    python scripts/identify.py chirp.mcap                       # prints a table, writes chirp_motors.yaml

Minutes on a CPU. Train with what it found: train.py --motors chirp_motors.yaml. docs/howto/identify.md says how to make
such a log, and what the numbers are worth.
"""

from pathlib import Path
from typing import Any

from legged_torque.envs import task_registry
from legged_torque.utils import cli
from legged_torque.utils.devices import resolve_device
from legged_torque.utils.errors import UserError
from legged_torque.utils.files import write_json, write_whole
from legged_torque.utils.options import MOTOR_FILES
from legged_torque.utils.plain_yaml import dump_yaml

UNITS = ("kg m^2", "N m s/rad", "N m", "rad")


def main() -> None:
    """Fit, print and write."""
    parser = cli.Parser(__doc__)
    parser.add_argument("log", type=Path, help="MCAP file of deploy.py --log")
    parser.add_argument("--out", type=Path, help="YAML file for --motors; default: the log's name with _motors.yaml")
    parser.add_argument("--json", type=Path, help="JSON file of all numbers, intervals and errors to write")
    cli.add_options(parser, "device", "task_file")
    args = parser.parse_args()
    if not args.log.is_file():
        raise UserError(f"cannot read '{args.log}': there is no such file")
    args.out = args.out or args.log.with_name(f"{args.log.stem}_motors.yaml")
    if not str(args.out).endswith(MOTOR_FILES):
        raise UserError(f"--out must end in {' or '.join(MOTOR_FILES)}, which --motors reads, not '{args.out}'")
    for file in filter(None, (args.out, args.json)):
        cli.check_output(file)
    cli.options_of(args)  # imports files of tasks
    with cli.slow_imports():
        from legged_torque.identification.fit import ROUNDS, identify
        from legged_torque.identification.recording import read_recording
        from legged_torque.identification.worlds import FIELDS, PARAMETERS
        from legged_torque.runtime.chirp import CHECKSUM
        from legged_torque.runtime.log import RecordedLog
        from legged_torque.utils.display import Counter
    log = RecordedLog(args.log)
    if log.sha256 != CHECKSUM:
        raise UserError(f"'{args.log}' is no log of deploy.py --chirp, in which a robot hangs")
    cfg, recording = task_registry.get_cfgs(log.task)[0], read_recording(log)
    with Counter("identifying, round", ROUNDS) as counter:
        found = identify(cfg, recording, resolve_device(args.device), counter.add)
    names, values = log.joint_order, dict(zip(PARAMETERS, found.values, strict=True))
    print(f"{log.task}, {len(recording.commands) * log.period:.0f} s: values, 95% intervals")
    print(f"{'joint':<20}", *(f"{f'{name} [{unit}]':<30}" for name, unit in zip(PARAMETERS, UNITS, strict=False)))
    for joint, name in enumerate(names):
        pairs = zip(found.values[:4, joint], found.half_widths[:4, joint], strict=True)
        print(f"{name:<20}", *(f"{f'{value:.4g} +- {half:.1g}':<30}" for value, half in pairs))
    print(f"delay {1e3 * found.values[4, 0]:.2f} +- {1e3 * found.half_widths[4, 0]:.1g} ms")
    print("error where nothing was fitted [rad], of the robot's file and of the last fit")
    for name, *errors in zip(names, *found.held_out[:, 0], strict=True):
        print(f"{name:<20}", *(f"{error:<10.2g}" for error in errors))
    write_whole(args.out, settings_text(names, values, cfg.sim.dt, FIELDS))
    print(f"wrote {args.out}; to train with it: --motors {args.out}")
    if args.json:
        about = {"log": str(args.log), "joint_order": names, "parameters": PARAMETERS}
        write_json(args.json, about | {name: part.tolist() for name, part in vars(found).items()})


def settings_text(names: list[str], values: dict[str, Any], step: float, fields: dict[str, str]) -> str:
    """Return settings of motors as YAML, with a delay of whole physics steps [s]."""
    steps, offset = max(round(values["delay"][0] / step), 0), float(f"{abs(values['bias']).max():.2g}")
    delay = {"unit": "physics_steps", "range": [steps, steps]}
    if (1e3 * step).is_integer():  # which holds for other physics steps, too
        delay = {"unit": "milliseconds", "range": [round(1e3 * step) * steps] * 2}
    joints = {}
    for key, field in fields.items():
        rounded = (float(f"{value:.4g}") for value in values[key])
        joints[field.removeprefix("dof_")] = dict(zip(names, rounded, strict=True))
    drawn = {"keep_fixed": list(fields.values()), "joint_offset": {"add": [-offset, offset]}}
    return dump_yaml({"motors": {"joints": joints, "delay": delay}, "domain_rand": drawn})


if __name__ == "__main__":
    cli.run_script(main)
