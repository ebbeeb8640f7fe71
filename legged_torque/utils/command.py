"""The console command ``legged-torque``: every script by its name, from any folder."""

import ast
import importlib.util
import os
import sys

import legged_torque
from legged_torque import SCRIPTS_DIR, __version__
from legged_torque.utils.cli import COMMAND, Parser, run_script, take_command

USUAL = ("train", "play", "evaluate", "export", "sim2sim", "experiment", "report", "import_robot", "info")
"""Scripts for most users, in the order of ``--help``."""


def main() -> None:
    """Run the script that the first word names, with the other words as its own."""
    run_script(run_command)


def run_command() -> None:
    """Run a script as ``python scripts/<name>.py`` does, or show what there is."""
    sys.argv[0] = COMMAND
    if "_ARGCOMPLETE" in os.environ:  # the words are those before the one to complete
        sys.argv[1:] = os.environ["COMP_LINE"][: int(os.environ["COMP_POINT"])].split(" ")[1:-1]
        os.environ["_ARGCOMPLETE"] = "1"  # how many words of the line are the command's name
    others = sorted(file.stem for file in SCRIPTS_DIR.glob("[!_]*.py") if file.stem not in USUAL)
    name = take_command("command", [*USUAL, *others])
    if not name:
        show_overview([*USUAL, *others])
        return
    spec = importlib.util.spec_from_file_location("__main__", SCRIPTS_DIR / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = sys.modules["__main__"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)


def show_overview(scripts: list[str]) -> None:
    """Answer ``--help``, a line per script with the purpose in its docstring, and ``--version``; complete a name."""
    overview = "commands:\n"
    for name in scripts:
        text = ast.get_docstring(ast.parse((SCRIPTS_DIR / f"{name}.py").read_text("utf-8"))) or ""
        purpose = text.partition("\n")[0].partition(":")[0].rstrip(".")
        overview += f"  {name:<20} {purpose}\n"
    parser = Parser(str(legged_torque.__doc__))
    parser.prog, parser.epilog = COMMAND, overview
    parser.add_argument("--version", action="version", version=f"{COMMAND} {__version__}")
    parser.add_argument("command", choices=scripts, metavar="command", help="one of those below, with its options")
    parser.parse_args(sys.argv[1:] or ["--help"])
