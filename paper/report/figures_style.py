"""Names, colours and marks of tasks, the same in all figures, so that they can be read in grey too."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from legged_torque.paper.values import MODELS, task_on_plane

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
    # those of Tol, for what the paper does not have
    "a1_torque_curriculum_multihead": ("#777777", "-", "++"),
    "a1_torque_gravity_curriculum": ("#999933", "-.", "**"),
    "a1_torque_gravity_multihead": ("#882255", "--", "oo"),
    "a1_torque_curriculum_high": ("#44AA99", (0, (4, 2, 1, 2)), "||"),
    "a1_multihead_two_rates": ("#332288", (0, (8, 2)), "OO"),
}
"""Those of each task; tasks of your own have those that no other task of the figure has."""
MARKERS = ("o", "s", "^", "D", "v", "P")  # of approaches, where lines are many
SEED_MARK: dict[str, Any] = {"marker": "o", "markersize": 4.0, "markeredgecolor": "white", "markeredgewidth": 0.6}
SETTINGS = {
    "font.size": 10,
    "hatch.linewidth": 0.6,
    "axes.axisbelow": True,
    "savefig.dpi": 150,
    "text.parse_math": False,  # a "$" in a name is a "$"
}


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


def name_of(task: str) -> str:
    """Return how a task is called in figures and tables: as in the paper, or else by its own name."""
    return MODELS.get(task, task)


def method(task: str) -> str:
    """Return how a report calls a task."""
    return MODELS.get(task, f"`{task}`")


def seeds_text(count: int) -> str:
    """Return a number of seeds in words."""
    return f"{count} seed{'' if count == 1 else 's'}"


def draw_seeds(axis: Axes, places: Sequence[float], values: Sequence[float], color: str) -> None:
    """Draw a point per seed."""
    axis.plot(places, values, color=color, linestyle="none", zorder=5, **SEED_MARK)
