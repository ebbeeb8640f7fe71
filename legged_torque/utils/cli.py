"""The command line of the scripts: options with legged_gym's names, and errors as one line. Needs no torch."""

import argparse
import contextlib
import dataclasses
import gc
import os
import re
import shlex
import shutil
import signal
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from legged_torque import SCRIPTS_DIR
from legged_torque.utils.config import flat, section_keys, to_dict
from legged_torque.utils.devices import disable_renderer
from legged_torque.utils.errors import LOST_PROCESS, TrainingError, UserError, is_out_of_memory, unknown_name
from legged_torque.utils.files import write_errors
from legged_torque.utils.limits import Rate, check_value, describe, types_of
from legged_torque.utils.options import DEFAULT_TASK, Options
from legged_torque.utils.policies import policy_names
from legged_torque.utils.task_registry import task_registry

LAST_WORDS = 5.0  # seconds after which a further process reports an error, if the first one has not ended by then
COMMAND = "legged-torque"  # the console command that runs every script
CLOCKS = ("policy_hz", "physics_hz")  # options in Hz
SETTINGS = ("task", "set", "perturbation", "seed", "device", "ranges", "motors", "task_file", *CLOCKS)  # of every task
RUNS = ("load_run", "policy", "checkpoint", "log_root", "experiment_name")  # of scripts that keep or load runs
TRAINING = ("max_iterations", "resume", "preset", "run_name", "logger", "verbose")  # of trainings alone
_GROUPS = {"task and settings": ("task", "num_envs", *SETTINGS[1:]), "training": TRAINING, "runs": RUNS}
_TASK_OF_RUN = f"name of the task, see train.py --list; default: that of the run, or {DEFAULT_TASK} for a new one"
_COMPLETED = ("policy", "task", "preset", "perturbation", "ranges", "motors", "set", "terrain")
_SCRIPT = re.compile(r"python scripts/(\w+)\.py")
_EXAMPLE = re.compile(r": ``(python scripts/[^`]+)``\.")


def script_command(script: str) -> str:
    """Return how a script is started: as this one was, by the command, from a clone or as a part of the package."""
    if sys.argv[0].startswith(f"{COMMAND} "):
        return f"{COMMAND} {script}"
    if SCRIPTS_DIR.parent == Path(__file__).resolve().parents[1]:
        return f"python -m legged_torque.scripts.{script}"
    file = SCRIPTS_DIR / f"{script}.py"
    return f"python {shlex.quote(str(file.relative_to(Path.cwd()) if file.is_relative_to(Path.cwd()) else file))}"


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line with the nearest valid name."""

    def __init__(self, description: str) -> None:
        """Create a parser; abbreviations of options are not accepted.

        ``description`` is the docstring of a script, with which the help begins. Its examples, in the first line or
        below a line "Examples:", keep their lines.
        """
        width = max(shutil.get_terminal_size().columns - 2, 20)  # argparse's own
        text = _EXAMPLE.sub(r".\n\nExamples:\n    \1", description.strip())
        parts = (part if part.startswith("Examples:") else textwrap.fill(part, width) for part in text.split("\n\n"))
        super().__init__(
            description=_SCRIPT.sub(lambda found: script_command(found[1]), "\n\n".join(parts)),
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )

    def format_help(self) -> str:
        """Return the text of ``--help``, which names options once: below the examples."""
        places = [action for action in self._actions if not action.option_strings]
        words = [f"[{place.dest}]" if place.nargs == "?" else place.dest for place in places]
        self.usage = " ".join(["%(prog)s", *words, "[options]"])
        return super().format_help()

    def error(self, message: str) -> NoReturn:
        """Report a mistake in the arguments."""
        raise UserError(message)

    def parse_args(self, args=None, namespace=None):
        """Parse the command line; an option that does not exist, or a value that is empty, is a UserError.

        When a shell asks for completions of a command line, they are printed, and the script ends.
        """
        if "_ARGCOMPLETE" in os.environ:
            import argcomplete

            for action in self._actions:
                if action.dest in _COMPLETED:
                    action.completer = complete  # type: ignore[attr-defined]
            argcomplete.autocomplete(self)
        words = sys.argv[1:] if args is None else list(args)
        for before, word in zip(["", *words], words, strict=False):
            name, equals, value = word.partition("=") if word.startswith("--") else (before, "", word)
            if (equals or not word) and value in ("", "--"):  # argparse would take --option=-- as no value
                raise UserError(f"the value of {name} is empty" if name else "an argument is empty")
        namespace, unknown = self.parse_known_args(words, namespace)
        if unknown:
            before = words[: words.index(unknown[0])] if unknown[0] in words else []
            option, key = ["", "", *before][-2:]
            if option == "--set" and "=" not in key:
                raise UserError(f"--set takes KEY=VALUE: give --set {key}={unknown[0]}")
            options = [option for action in self._actions for option in action.option_strings]
            raise unknown_name("option", unknown[0].partition("=")[0], options)
        return namespace


def take_command(kind: str, names: Sequence[str]) -> str:
    """Make the first word a part of the program's name and return it; nothing before an option or a completion.

    A UserError if it is not one of the names, which are those of a ``kind``; "-" is as good as "_".
    """
    given, is_completing = "".join(sys.argv[1:2]), "_ARGCOMPLETE" in os.environ
    if (name := given.replace("-", "_")) in names:
        sys.argv = [f"{sys.argv[0]} {name}", *sys.argv[2:]]
        if is_completing:  # one more word of the line belongs to the command
            os.environ["_ARGCOMPLETE"] = str(int(os.environ["_ARGCOMPLETE"]) + 1)
        return name
    if given and not given.startswith("-") and not is_completing:
        raise unknown_name(kind, given, names)
    return ""


def add_options(parser: Parser, *names: str) -> None:
    """Add fields of :class:`Options` in groups of ``--help``."""
    types, defaults = types_of(Options), Options()
    fields = {field.name: field for field in dataclasses.fields(Options)}
    for title, members in _GROUPS.items():
        chosen = [name for name in members if name in names]
        group = parser.add_argument_group(title) if chosen else parser
        if "task" in chosen:  # above the script's own options
            parser._action_groups.insert(1, parser._action_groups.pop())
        for name in chosen:
            hint, how = types[name], {**fields[name].metadata, "default": getattr(defaults, name)}
            if hint is bool:
                how["action"] = "store_true"
            elif hint == list[str]:
                how["action"] = "append"
            elif hint not in (str, str | None):
                how["type"] = float if hint == Rate | None else int
                how["help"] += f"; {describe(hint).removesuffix(' or null')}"
            if name == "task" and "load_run" in names:
                how |= {"default": "", "help": _TASK_OF_RUN}
            if aliases := how.pop("aliases", ()):
                how["action"] = _OneValue
            group.add_argument(f"--{name}", *aliases, **how)


def complete(action: argparse.Action, parsed_args: argparse.Namespace, **_: Any) -> list[str]:
    """Return the words that a shell offers as values of an option, which may depend on the task."""
    tasks, task = task_registry.names(), getattr(parsed_args, "task", "")
    env_cfg, train_cfg = task_registry.get_cfgs(task if task in tasks else DEFAULT_TASK)
    words = {
        "task": tasks,
        "preset": train_cfg.presets(),
        "perturbation": env_cfg.perturbations(),
        "ranges": env_cfg.parameter_ranges(),
        "motors": env_cfg.motors.choices,
        "set": [f"{path}=" for path in flat(to_dict(env_cfg) | to_dict(train_cfg))],
        "policy": policy_names(),
        "terrain": ["all", *section_keys(env_cfg.terrain.terrain_proportions)],
    }
    return list(words[action.dest])


class _OneValue(argparse.Action):
    """An option with several names, which must not be given different values; of a repeated name the last counts."""

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option_string: Any = None) -> None:
        """Keep the value; a UserError if another name has given another one."""
        self.given = {**getattr(self, "given", {}), option_string: values}
        if len(set(self.given.values())) > 1:
            given = ", ".join(f"{option}={value}" for option, value in self.given.items())
            raise UserError(f"these options mean the same, but differ: {given}")
        setattr(namespace, self.dest, values)


def add_task_args(parser: Parser) -> None:
    """Add the options of scripts that build a task and keep or load runs of it."""
    add_options(parser, *SETTINGS, "num_envs", *RUNS)
    parser.add_argument("--headless", action="store_true", help=argparse.SUPPRESS)  # of legged_gym: no window opens


def options_of(args: argparse.Namespace) -> Options:
    """Return the shared options of a parsed command line, and load the files of tasks that it names.

    Options that its parser does not have keep their defaults.
    """
    names = [field.name for field in dataclasses.fields(Options)]
    options = Options(**{name: getattr(args, name) for name in names if hasattr(args, name)})
    if options.task_file:
        with slow_imports():
            task_registry.import_files(options.task_file)
    return options


def option_words(args: object, *names: str) -> list[str]:
    """Return words that give another script the values that some options have; those of None are left out."""
    values = {name: getattr(args, name) for name in names}
    lists = {name: value if isinstance(value, list) else [value] for name, value in values.items()}
    return [f"--{name}={value}" for name, each in lists.items() for value in each if value is not None]


@contextlib.contextmanager
def slow_imports() -> Iterator[None]:
    """Context for imports that take seconds, of torch and Warp. Check the command line before.

    Ctrl-C ends the process without a traceback. The garbage collector is off, and never searches what was imported:
    that took a third of the time, and a second or two at the end.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
        if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
            signal.signal(signal.SIGINT, signal.default_int_handler)
    if "mujoco" in sys.modules:  # which would write its warnings to a file in the current folder
        sys.modules["mujoco"].set_mju_user_warning(lambda text: print(f"MuJoCo: {text}", file=sys.stderr))


def run_script(main: Callable[[], None], draws: bool = False) -> None:
    """Run the main function of a script; expected errors are one line without a traceback.

    The exit status is 2 for a mistake of the user, a file that cannot be used or too little memory, 130 after Ctrl-C,
    and 1 for a training that cannot learn or an output that is not read any more (``| head``).

    Args:
        main: Takes no arguments.
        draws: Whether the script chooses a renderer; others must not depend on one.
    """
    if not draws:
        disable_renderer()
    try:
        " ".join([os.getcwd(), *sys.argv]).encode()  # files name them
        main()
        return
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what Python writes when it ends
        sys.exit(1)
    except KeyboardInterrupt:
        status, line = 130, "interrupted"
    except TrainingError as error:
        status, line = 1, f"error: {error}"
    except Exception as error:
        if isinstance(error, UserError):
            message = " ".join(str(error).splitlines())
        elif isinstance(error, UnicodeEncodeError):
            message = f"a name is not UTF-8, or the locale is another one (LC_ALL=C.UTF-8 may help): {error.object!r}"
        elif isinstance(error, FileNotFoundError) and not error.filename:
            message = "the current folder has been removed"
        elif isinstance(error, OSError):
            message = f"{error.strerror or error}" + (f": {str(error.filename)!r}" if error.filename else "")
        elif isinstance(error, ModuleNotFoundError) and not str(error.name).startswith("legged_torque"):
            message = f"'{error.name}' is not installed"
        elif is_out_of_memory(error):
            reason = (str(error).strip() or "no reason is given").splitlines()[0]
            message = f"this does not fit in memory, lower --num_envs: {reason}"
        elif isinstance(error, RuntimeError) and "gloo" in str(error):
            message = LOST_PROCESS
        else:
            raise
        status, line = 2, f"error: {message}"
    finally:
        if "triton" in sys.modules:
            gc.unfreeze()  # what Python does not collect when it ends, triton reports as leaks
    if os.environ.get("RANK", "0") != "0":
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # Linux may send it once for each thread of a parent that dies
        time.sleep(LAST_WORDS)  # in which the first process, which has started this one, may end it
    print(line, file=sys.stderr)
    sys.exit(status)


def check_args(args: object, **hints: Any) -> None:
    """Raise a UserError if an argument does not have the type ``hints[name]``, with its bounds; None has any."""
    for name, hint in hints.items():
        if getattr(args, name) is not None:
            check_value(f"--{name}", getattr(args, name), hint)


def add_command_arg(parser: Parser, kind: str = "fixed", default: str = "drawn as in training") -> None:
    """Add a command of the robots; ``default`` says what it is if none is given."""
    hint = f"{kind} command: forwards, to the left [m/s], yaw rate [rad/s]; default: {default}"
    parser.add_argument("--command", type=float, nargs=3, metavar=("X", "Y", "YAW"), help=hint)


def video_file(name: str) -> Path:
    """Return the file of a video, as argparse's type of an option; a UserError if its name ends otherwise."""
    if not name.lower().endswith((".mp4", ".gif")):
        raise UserError(f"a video is an mp4 or a gif, by the end of its name, not '{name}'")
    return Path(name)


def check_output(file: Path) -> None:
    """Raise a UserError if a file cannot be written later; nothing is created or changed yet."""
    with write_errors(file):
        if file.is_dir():
            raise UserError(f"cannot write '{file}': it is a folder")
        if file.exists():
            file.open("ab").close()
            return
        folder = next(parent for parent in file.absolute().parents if parent.exists())
        tempfile.TemporaryFile(dir=folder).close()
        with contextlib.suppress(FileNotFoundError):
            file.stat()  # whose name may be too long
