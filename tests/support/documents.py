"""Pages and tables of the documents, and the numbers in them."""

from pathlib import Path

DOCS = Path(__file__).resolve().parents[2] / "docs"
TASKS = {
    "PD": "a1_position",
    "default torque": "a1_torque",
    "gravity pre-training": "a1_torque_gravity",
    "torque curriculum": "a1_torque_curriculum",
    "torque multi-head": "a1_torque_multihead",
    "multi-head": "a1_multihead",
    "curriculum, torque multi-head": "a1_torque_curriculum_multihead",
}
METRICS = ["track_percentage", "track_xy", "track_angular", "cost_of_transport"]


def text_of(page, heading):
    """A page from a heading on, in one line."""
    return " ".join((DOCS / page).read_text("utf-8").partition(heading)[2].split())


def rows_of(page, header):
    """Columns and rows of the table of a page that begins with a header, as lists of texts."""
    lines = (DOCS / page).read_text("utf-8").splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith(f"| {header} |"))
    end = next(i for i in range(start, len(lines)) if not lines[i].startswith("|"))
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[start:end]]
    return cells[0], cells[2:]


def same(text, value):
    """Whether a number is a value, rounded."""
    return abs(float(text) - value) <= 0.5 * 10.0 ** -len(text.partition(".")[2]) + 1e-9


def iqm(values):
    """Interquartile mean: without a quarter of the values, rounded down, at each end."""
    out = len(values) // 4
    return values.sort_values().iloc[out : len(values) - out].mean()
