"""Names, colours, lines and hatches of tasks, the same in all tables and figures; readable in grey, too."""

from collections.abc import Sequence
from typing import Any

from legged_torque.paper.values import MODELS, task_on_plane

Style = tuple[str, Any, str]
"""Colour, line style and hatch."""
STYLES: dict[str, Style] = {
    # colours of Okabe and Ito, which colour-blind readers can tell apart; close to those of the paper
    "a1_position": ("#0072B2", "-", ""),
    "a1_torque": ("#009E73", ":", "..."),
    "a1_torque_gravity": ("#56B4E9", (0, (1, 1, 3, 1)), "xxx"),
    "a1_torque_curriculum": ("#E69F00", "--", "///"),
    "a1_torque_multihead": ("#D55E00", "-.", "\\\\\\"),
    "a1_multihead": ("#CC79A7", (0, (6, 1, 1, 1, 1, 1)), "---"),
    # colours of Tol, for tasks that the paper does not have
    "a1_torque_curriculum_multihead": ("#777777", "-", "++"),
    "a1_torque_gravity_curriculum": ("#999933", "-.", "**"),
    "a1_torque_gravity_multihead": ("#882255", "--", "oo"),
    "a1_torque_curriculum_high": ("#44AA99", (0, (4, 2, 1, 2)), "||"),
    "a1_multihead_two_rates": ("#332288", (0, (8, 2)), "OO"),
}
"""The style of each task; a task of the user's own has one that no other task of the figure uses."""


def style(tasks: Sequence[str], task: str) -> Style:
    """Return the style of one of the tasks in a figure: on rough ground solid, or dashed with the height scan."""
    plain = task_on_plane(task)
    names = list(dict.fromkeys(map(task_on_plane, tasks)))
    free = [look for name, look in STYLES.items() if name not in names] or list(STYLES.values())
    others = [name for name in names if name not in STYLES]
    color, line, hatch = STYLES[plain] if plain in STYLES else free[others.index(plain) % len(free)]
    if task == plain:
        return color, line, hatch
    return (color, "--", 2 * hatch or "oo") if task.endswith("_scan") else (color, "-", hatch)


def in_words(column: str) -> str:
    """Return the name of a column or an environment in text: "none" is no perturbations, and might mean no data."""
    return " -> ".join("no perturbations" if name == "none" else name for name in column.split(" -> "))


def name_of(task: str) -> str:
    """Return the name of a task in figures: the paper's, or else its own."""
    return MODELS.get(task, task)


def method(task: str) -> str:
    """Return the name of a task in the text and the tables of a report."""
    return MODELS.get(task, f"`{task}`")
