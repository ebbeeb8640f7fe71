"""Make a robot of this library out of a MJCF or URDF: ``python scripts/import_robot.py go2.urdf --name go2 --check``.

Writes resources/robots/NAME/NAME.xml and legged_torque/envs/robots/NAME.py, which is all that NAME_position and its
other tasks need, or both into the folder --out; prints what was changed and why.
"""

import io
from pathlib import Path

from legged_torque import RESOURCES_DIR
from legged_torque import __file__ as package
from legged_torque.envs import task_registry
from legged_torque.utils import cli
from legged_torque.utils.devices import choose_offscreen_renderer, disable_renderer
from legged_torque.utils.errors import UserError, collect_errors, printable
from legged_torque.utils.files import write_whole
from legged_torque.utils.limits import Positive


def main() -> None:
    """Import a robot and, if asked, stand it up."""
    parser = cli.Parser(__doc__)
    parser.add_argument("file", type=Path, help="MJCF or URDF; its meshes are used if they are near it")
    parser.add_argument("--name", default="", help="name of the robot; default: that of the file")
    parser.add_argument("--out", type=Path, help="folder for both files; default: where the library keeps its robots")
    parser.add_argument("--torque_limit", type=float, help="[N m] of all joints; default: those of the file")
    parser.add_argument("--check", action="store_true", help="hold the nominal pose for 5 s and draw a picture of it")
    parser.add_argument("--force", action="store_true", help="write over files that exist")
    args = parser.parse_args()
    cli.check_args(args, torque_limit=Positive)
    no_picture = choose_offscreen_renderer() if args.check else disable_renderer()
    with cli.slow_imports():
        import mujoco

        from legged_torque.importer.mjcf import mjcf
        from legged_torque.importer.robot import import_robot
        from legged_torque.importer.settings import settings
        from legged_torque.sim.fused.tree import read_tree
        from legged_torque.utils.standing import hold_pose
    robot = import_robot(args.file, args.name, args.torque_limit)
    folder = args.out or RESOURCES_DIR / "robots" / robot.name
    model_file = folder / f"{robot.name}.xml"
    code_file = (args.out or Path(package).parent / "envs" / "robots") / f"{robot.name}.py"
    for file in (model_file, code_file):
        cli.check_output(file)
        if file.exists() and not args.force:
            raise UserError(f"'{file}' exists; --force writes over it, --name and --out write elsewhere")
    taken = [task for task in task_registry.names() if task.startswith(f"{robot.name}_")]
    if taken and not args.out and not code_file.exists():
        raise UserError(f"tasks of a robot '{robot.name}' may get names that are taken, as '{taken[0]}'; see --name")
    path = str(model_file.absolute()) if args.out else f"resources/robots/{robot.name}/{robot.name}.xml"
    text, model = mjcf(robot)
    problems: list[str] = []
    with collect_errors(problems):
        read_tree(model)
    code = settings(robot, path, is_fused=not problems)
    compile(code, code_file, "exec")  # a file with a mistake would be in every later command's way
    write_whole(model_file, text)
    write_whole(code_file, code)
    for note in robot.source.notes:
        print(printable(f"- {note}"))
    print(f"wrote {model_file}\nwrote {code_file}")
    print(*problems or ["sim.engine 'fused' simulates it"])
    if args.check:
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        print(f"5 s under PD: {hold_pose(data, *robot.gains(), model.actuator_ctrlrange.T, 5.0)}")
        if no_picture:
            print(f"no picture: {no_picture}")
        else:
            from PIL import Image

            with mujoco.Renderer(model, 480, 640) as renderer:
                renderer.update_scene(data, camera="track")
                Image.fromarray(renderer.render()).save(picture := io.BytesIO(), format="png")
            write_whole(folder / f"{robot.name}.png", picture.getvalue())
            print(f"wrote {folder / robot.name}.png")
    if args.out:
        print(f"To have its tasks, put {code_file.name} into {Path(package).parent / 'envs' / 'robots'}")
    print(f"Train it: {cli.script_command('train')} --task={robot.name}_position")


if __name__ == "__main__":
    cli.run_script(main, draws=True)
