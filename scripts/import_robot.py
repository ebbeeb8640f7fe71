"""Make a robot of this library out of a MJCF or URDF: ``python scripts/import_robot.py go2.urdf --name go2 --check``.

Writes NAME.xml and NAME.py into the folder --out. NAME.py registers NAME_position and the robot's other tasks: name it
by --task_file. In a clone, without --out, they go to resources/robots/NAME and legged_torque/envs/robots, where every
script finds them. Prints what was changed and why, and whether the robot stands.
"""

import importlib.util
import io
import shlex
from pathlib import Path
from typing import Annotated

from legged_torque import RESOURCES_DIR
from legged_torque import __file__ as package
from legged_torque.envs import task_registry
from legged_torque.utils import cli
from legged_torque.utils.devices import choose_offscreen_renderer, disable_renderer
from legged_torque.utils.errors import UserError, collect_errors, printable
from legged_torque.utils.files import write_whole
from legged_torque.utils.limits import Limits

Torque = Annotated[float, Limits(above=0, highest=1e5)]


def main() -> None:
    """Import a robot and, if asked, stand it up."""
    parser = cli.Parser(__doc__)
    parser.add_argument("file", type=Path, help="MJCF or URDF; its meshes are used if they are near it")
    parser.add_argument("--name", default="", help="name of the robot; default: that of the file")
    hint = "folder for both files; default: the current one, or a clone's own places"
    parser.add_argument("--out", type=Path, help=hint)
    parser.add_argument("--torque_limit", type=float, help="[N m] of all joints; default: those of the file")
    parser.add_argument("--check", action="store_true", help="also draw a picture of it, after 5 s in the nominal pose")
    parser.add_argument("--force", action="store_true", help="write over files that exist")
    args = parser.parse_args()
    cli.check_args(args, torque_limit=Torque)
    no_picture = choose_offscreen_renderer() if args.check else disable_renderer()
    with cli.slow_imports():
        import mujoco

        from legged_torque.importer.mjcf import mjcf
        from legged_torque.importer.robot import check, import_robot
        from legged_torque.importer.settings import IMPORTED, settings
        from legged_torque.sim.fused.tree import read_tree
    robot = import_robot(args.file, args.name, args.torque_limit)
    clone = Path(package).resolve().parents[1]
    is_inside = Path.cwd().is_relative_to(clone) and (clone / "pyproject.toml").is_file() and not args.out
    folder = RESOURCES_DIR / "robots" / robot.name if is_inside else args.out or Path()
    model_file = folder / f"{robot.name}.xml"
    code_file = (clone / "legged_torque" / "envs" / "robots" if is_inside else folder) / f"{robot.name}.py"
    if is_inside and code_file.exists() and IMPORTED not in code_file.read_text("utf-8"):
        raise UserError(f"the robot '{robot.name}' was not imported, and stays as it is; see --name")
    for file in (model_file, code_file):
        cli.check_output(file)
        if file.exists() and file.samefile(args.file):
            raise UserError(f"'{file}' is the file to import; --name and --out write elsewhere")
        if file.exists() and not args.force:
            raise UserError(f"'{file}' exists; --force writes over it, --name and --out write elsewhere")
    taken = [task for task in task_registry.names() if task.startswith(f"{robot.name}_")]
    if taken and not (is_inside and code_file.exists()):
        raise UserError(f"tasks of a robot '{robot.name}' may get names that are taken, as '{taken[0]}'; see --name")
    module = None if is_inside else importlib.util.find_spec(robot.name)
    if module and module.origin and Path(module.origin).resolve() != code_file.resolve():
        raise UserError(f"'{code_file}' could not be imported: there is another module '{robot.name}'; see --name")
    path = f"resources/robots/{robot.name}/{robot.name}.xml" if is_inside else ""
    text, model = mjcf(robot)
    problems: list[str] = []
    with collect_errors(problems):
        read_tree(model)
    code = settings(robot, path, is_fused=not problems)
    compile(code, code_file, "exec")  # a file with a mistake would be in every later command's way
    data = mujoco.MjData(model)
    verdict = check(robot, data)
    write_whole(model_file, text)
    write_whole(code_file, code)
    for note in robot.source.notes:
        print(printable(f"- {note}"))
    print(f"wrote {model_file}\nwrote {code_file}")
    print(*problems or ["sim.engine 'fused' simulates it"])
    print(f"5 s under PD: {verdict}")
    if args.check and no_picture:
        print(f"no picture: {no_picture}")
    elif args.check:
        from PIL import Image

        picture, content = folder / f"{robot.name}.png", io.BytesIO()
        with mujoco.Renderer(model, 480, 640) as renderer:
            renderer.update_scene(data, camera="track")
            Image.fromarray(renderer.render()).save(content, format="png")
        write_whole(picture, content.getvalue())
        print(f"wrote {picture}")
    task_file = "" if is_inside else f"--task_file {shlex.quote(str(code_file))} "
    print(f"Train it: {cli.script_command('train')} {task_file}--task={robot.name}_position")


if __name__ == "__main__":
    cli.run_script(main, draws=True)
