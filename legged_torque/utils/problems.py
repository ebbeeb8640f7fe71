"""Several problems of one input, reported together in one line."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from legged_torque.utils.errors import UserError


def refuse(problems: Sequence[str], what: str = "", advice: str = "") -> None:
    """Raise a UserError that lists all problems, after ``what`` cannot be done and before ``advice``; none is fine."""
    if problems:
        message = "; ".join([*problems, advice] if advice else problems)
        raise UserError(f"{what}: {message}" if what else message)


def with_names(problems: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Yield each problem followed by the names of the parts that have it."""
    for problem, names in problems.items():
        yield f"{problem} ({', '.join(names)})"
