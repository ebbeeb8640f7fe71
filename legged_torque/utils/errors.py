"""Errors that a user can act on, and the words of messages."""

import contextlib
import difflib
import importlib.util
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

OUT_OF_MEMORY = ("out of memory", "Failed to allocate", "can't allocate memory")
"""Parts of the messages of CUDA, Warp and torch on the CPU when memory has run out."""
MANY = 40  # names, of which an error lists only the nearest
NEAREST = 5  # how many those are
LOST_PROCESS = "another process of this training has ended; --resume goes on from the last checkpoint"


def printable(text: object) -> str:
    """Return a text with codes in place of characters such as line ends, with which names could change a terminal."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(text))


def counted(number: int, noun: str) -> str:
    """Return a number of things in words: "1 fall", "2,000 falls"."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


class UserError(Exception):
    """A mistake of the user, in one line: the given value, the allowed ones and the nearest match.

    Scripts print the line and exit with status 2; no traceback is shown.
    """

    def __init__(self, message: object) -> None:
        """Take the message; what it quotes of a stranger's file is made :func:`printable`."""
        super().__init__(printable(message))


class TrainingError(Exception):
    """A training that cannot learn: one line that says why. Scripts print it and exit with status 1."""


def require(*packages: str, extra: str = "export") -> None:
    """Raise a UserError that names the extra if a package is not installed."""
    for package in packages:
        if importlib.util.find_spec(package) is None:
            raise UserError(f"{package} is not installed; this needs the extra: pip install 'legged_torque[{extra}]'")


def unknown_name(kind: str, given: str, allowed: Iterable[str]) -> UserError:
    """Return the error for a name that does not exist; ``kind`` is the kind of things it names, e.g. "task".

    It lists the allowed names, or the nearest ones of more than :data:`MANY`.
    """
    allowed = sorted(allowed)
    by_lower_case = {name.lower(): name for name in allowed}
    near = difflib.get_close_matches(given.lower(), by_lower_case, n=NEAREST, cutoff=0.5)
    hint = f" did you mean '{by_lower_case[near[0]]}'?" if near else ""
    shown = [by_lower_case[name] for name in near] if near and len(allowed) > MANY else allowed
    others = f" and {len(allowed) - len(shown)} others" if len(shown) < len(allowed) else ""
    return UserError(f"unknown {kind} '{given}';{hint} allowed: {', '.join(shown)}{others}")


def check_names(kind: str, given: Iterable[str], allowed: Collection[str]) -> None:
    """Raise :func:`unknown_name` for the first name that is not allowed."""
    for name in given:
        if name not in allowed:
            raise unknown_name(kind, str(name), allowed)


def refuse(problems: Sequence[str], what: str = "", advice: str = "") -> None:
    """Raise a UserError that lists all problems, after ``what`` cannot be done and before ``advice``; none is fine."""
    if problems:
        message = "; ".join([*problems, advice] if advice else problems)
        raise UserError(f"{what}: {message}" if what else message)


def with_names(problems: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Yield each problem followed by the names of the parts that have it."""
    for problem, names in problems.items():
        yield f"{problem} ({', '.join(names)})"


@contextlib.contextmanager
def collect_errors(problems: list[str]) -> Iterator[None]:
    """Append the message of a UserError that is raised inside to a list, and go on."""
    try:
        yield
    except UserError as error:
        problems.append(str(error))


def is_out_of_memory(error: BaseException | None) -> bool:
    """Return whether an error, or one that led to it, says that memory has run out."""
    while error is not None:
        is_said = isinstance(error, RuntimeError) and any(words in str(error) for words in OUT_OF_MEMORY)
        if is_said or isinstance(error, MemoryError):
            return True
        error = error.__cause__ or error.__context__
    return False
