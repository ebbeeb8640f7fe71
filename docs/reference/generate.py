"""Write settings.md and scripts.md beside this file from the code: ``python docs/reference/generate.py``."""

from __future__ import annotations

import ast
import contextlib
import inspect
import io
import os
import re
import runpy
import sys
import tokenize
from pathlib import Path
from types import ModuleType

os.environ["MUJOCO_GL"] = "disable"

from legged_torque import SCRIPTS_DIR
from legged_torque.envs.approaches import multi_head_config, torque_config, torque_curriculum_config, torque_gravity
from legged_torque.envs.base import commands_config, legged_robot_config
from legged_torque.envs.robots import a1, anymal_c, g1, go1, go2
from legged_torque.utils.limits import describe, types_of

HERE = Path(__file__).parent
CONFIGS = (
    (legged_robot_config, "LinearChange"),
    (legged_robot_config, "LeggedRobotCfg"),
    (commands_config, "CommandsCfg"),
    (legged_robot_config, "LeggedRobotCfgPPO"),
    (a1, "A1Cfg"),
    (a1, "A1CfgPPO"),
    (anymal_c, "AnymalCCfg"),
    (g1, "G1Cfg"),
    (go1, "Go1Cfg"),
    (go2, "Go2Cfg"),
    (torque_config, "TorqueCfgPPO"),
    (torque_curriculum_config, "TorqueCurriculumCfg"),
    (torque_gravity, "TorqueGravityCfgPPO"),
    (multi_head_config, "TorqueMultiHeadCfg"),
    (multi_head_config, "MultiHeadCfg"),
    (multi_head_config, "MultiHeadCfgPPO"),
    (multi_head_config, "MultiHeadTwoRatesCfg"),
    (multi_head_config, "MultiHeadTwoRatesCfgPPO"),
)
"""Config classes in the order of the page."""

SETTINGS_HEAD = """# Settings

Made by `python docs/reference/generate.py` from the config classes. `--set section.setting=value` changes a setting for
one run, a subclass changes it for a task. Units are in brackets; a comment without a unit means a number without one.
Every number must be finite, at most 1e9 either way; what else a setting must be stands next to its default in the code,
and other values are refused.

A class that is listed with few settings inherits all others from its base. A run's `config.yaml` holds every value that
it was trained with.
"""
SCRIPTS_HEAD = """# Scripts

Made by `python docs/reference/generate.py` from the scripts. In an installed package without a clone, use
`python -m legged_torque.scripts.train` in place of `python scripts/train.py`, and so on.
"""


def comments(source: str) -> dict[int, str]:
    """Return the comment at the end of each line, by number of the line."""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}


def rows(
    node: ast.ClassDef, cls: type, path: str, source: str, notes: dict[int, str], known: dict[str, str]
) -> list[str]:
    """Return the rows of a table: settings of a class and of the classes inside it.

    Args:
        node: The class.
        cls: The same, as Python made it.
        path: Dotted path of its section, with a dot at the end.
        source: Source of its module.
        notes: Comments of the module by number of the line.
        known: Meanings of settings by path, from the classes before; new ones are added.
    """
    result = []
    for statement in node.body:
        if isinstance(statement, ast.ClassDef):
            text = ast.get_docstring(statement) or notes.get(statement.lineno, "")
            if text:
                result.append(f"| **`{path}{statement.name}`** | | | {text.splitlines()[0].replace('``', '`')} |")
            result += rows(statement, getattr(cls, statement.name), f"{path}{statement.name}.", source, notes, known)
        for name, node_of_value in assignments(statement):
            value = " ".join((ast.get_source_segment(source, node_of_value) or "").split())
            value = value if len(value) <= 60 else f"{value[:57]}..."
            before = known.get(f"{path}{name}", known.get(name, ""))
            note = notes.get(getattr(statement, "end_lineno", 0), before).replace("|", "\\|")
            known[f"{path}{name}"] = note
            allowed = describe(types_of(cls).get(name, object))
            result.append(f"| `{path}{name}` | `{value}` | {allowed} | {note} |")
    return result


def assignments(statement: ast.stmt) -> list[tuple[str, ast.expr]]:
    """Return the settings that a statement sets, with their values; ``a, b = 1, 2`` sets two."""
    if isinstance(statement, ast.AnnAssign) and statement.value is not None:
        return [(ast.unparse(statement.target), statement.value)]
    if not isinstance(statement, ast.Assign):
        return []
    (target,), value = statement.targets, statement.value
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        return [(ast.unparse(name), part) for name, part in zip(target.elts, value.elts, strict=True)]
    return [(ast.unparse(target), value)]


def settings_table(module: ModuleType, name: str, known: dict[str, str]) -> str:
    """Return the section of the page on one config class; for ``known`` see :func:`rows`."""
    source = inspect.getsource(module)
    (node,) = (part for part in ast.parse(source).body if isinstance(part, ast.ClassDef) and part.name == name)
    bases = ", ".join(f"`{ast.unparse(base)}`" for base in node.bases)
    text = " ".join(re.sub(r":\w+:`~?[\w.]*?(\w+)`", r"`\1`", ast.get_docstring(node) or "").replace("``", "`").split())
    table = ["| setting | default | allowed | meaning |", "|---|---|---|---|"]
    section = "commands." if name == "CommandsCfg" else ""
    table += rows(node, getattr(module, name), section, source, comments(source), known)
    return "\n".join([f"## {name}", "", f"{text} Base: {bases}.", "", *table, ""])


def settings_page() -> str:
    """Return settings.md."""
    known: dict[str, str] = {}
    return "\n".join([SETTINGS_HEAD, *(settings_table(module, name, known) for module, name in CONFIGS)])


def help_text(script: Path, *words: str) -> str:
    """Return what a script prints for --help, after other words."""
    output, arguments, path = io.StringIO(), sys.argv, list(sys.path)
    os.environ["COLUMNS"] = "110"
    sys.argv = [f"scripts/{script.name}", *words, "--help"]
    try:
        with contextlib.redirect_stdout(output), contextlib.suppress(SystemExit):
            runpy.run_path(str(script), run_name="__main__")
    finally:
        sys.argv, sys.path[:] = arguments, path
    return output.getvalue().rstrip()


def scripts_page() -> str:
    """Return scripts.md."""
    scripts = [script for script in sorted(SCRIPTS_DIR.glob("*.py")) if script.stem != "__init__"]
    parts = [f"## {script.name}\n\n```text\n{help_text(script)}\n```\n" for script in scripts]
    plot = SCRIPTS_DIR / "plot.py"
    for figure in runpy.run_path(str(plot))["FIGURES"]:
        parts.append(f"## plot.py {figure}\n\n```text\n{help_text(plot, figure)}\n```\n")
    return "\n".join([SCRIPTS_HEAD, *parts])


if __name__ == "__main__":
    os.chdir(SCRIPTS_DIR.parent)  # whence examples are written
    for name, text in {"settings.md": settings_page(), "scripts.md": scripts_page()}.items():
        (HERE / name).write_text(text, encoding="utf-8")
        print(HERE / name)
