"""Write the generated pages of docs/ from code, README and others: ``python docs/reference/generate.py``."""

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
from legged_torque.envs import LeggedRobot, TorqueRobot
from legged_torque.envs.approaches import (
    decap_config,
    fast_config,
    multi_head_config,
    sata_config,
    torque_config,
    torque_curriculum_config,
    torque_gravity,
    variable_stiffness_config,
)
from legged_torque.envs.base import (
    commands_config,
    distillation_config,
    flashsac_config,
    legged_robot_config,
    linear_change,
)
from legged_torque.envs.base.actions import ControlParameters
from legged_torque.envs.base.base_task import BaseTask
from legged_torque.envs.base.state import RobotState
from legged_torque.envs.robots import a1, anymal_c, g1, go1, go2
from legged_torque.motors import model_config
from legged_torque.sim.engine import Engine
from legged_torque.utils.config import successors
from legged_torque.utils.limits import describe, types_of

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
LINKS = ("Ideal", "Drive", "Lag", "Friction", "Thermal", "Quantize", "Muscle", "Encoder", "Network", "Joints")
SECTIONS = {f"{name}Cfg": f"motors.{name.lower()}." for name in LINKS}
SECTIONS |= {"CommandsCfg": "commands.", "MotorsCfg": "motors."}
SECTIONS |= {"FlashSACCfg": "flashsac.", "DistillationCfg": "distillation."}
"""Where the settings of some classes stand."""
CONFIGS = (
    (linear_change, "LinearChange"),
    (legged_robot_config, "LeggedRobotCfg"),
    (commands_config, "CommandsCfg"),
    *((model_config, f"{name}Cfg") for name in ("Motors", "Model", "Curve", *LINKS)),
    (legged_robot_config, "LeggedRobotCfgPPO"),
    (flashsac_config, "FlashSACCfg"),
    (distillation_config, "DistillationCfg"),
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
    (fast_config, "FastCfg"),
    (fast_config, "FastCfgPPO"),
    (multi_head_config, "MultiHeadTwoRatesCfg"),
    (variable_stiffness_config, "VariableStiffnessCfg"),
    (decap_config, "DecapCfg"),
    (sata_config, "SataCfg"),
    (sata_config, "SataCfgPPO"),
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


TASK_HEAD = """# Task attributes and hooks

Made by `python docs/reference/generate.py` from docstrings. `self` is the task in a method of a task class; from Python
it is what [`make_env`](../howto/python.md) returns. Every row of a tensor is a world. The world frame has z up. The
trunk's frame has x forwards, y to the left and z up, and moves with the trunk. Inside a step,
write only in place (`copy_`, `masked_fill_`), see [the rules](../concepts.md#code-inside-a-step).

Tensors of `self.state` and `self.control` are attributes of the task too, under the same names.

## Hooks

Methods that a subclass may override. Call `super()` to keep what the base does.

| method | what it does |
|---|---|
| `_reward_<term>()` | A reward term, not weighted, used if `rewards.scales.<term>` is not 0. Shape: (num_envs,). |
| `_termination_<term>()` | An end of episodes, used if `terminations.<term>` is not 0. Shape: (num_envs,), bool. |
"""
NAMES_HEAD = """# Old names

Made by `python docs/reference/generate.py` from `legged_torque/utils/successors.yaml`: names of
[legged_gym](../howto/from_legged_gym.md), and of this library before settings were renamed. A task that uses one is
refused in these words.
"""
HOOKS = (
    (LeggedRobot, "action_terms"),
    (LeggedRobot, "_compute_torques"),
    (LeggedRobot, "observation_terms"),
    (LeggedRobot, "random_parameters"),
    (LeggedRobot, "curriculum_values"),
    (BaseTask, "update_curriculum"),
    (BaseTask, "_post_physics_step_callback"),
    (BaseTask, "state_dict"),
    (BaseTask, "load_state_dict"),
    (TorqueRobot, "actions_for"),
)
"""Methods that a subclass may override, of the class that has them."""
COMPUTED = ("base_height", "foot_pos", "foot_vel", "foot_contact_force", "body_pos", "body_vel")
"""Members of the state that are computed where they are used."""
METHODS = ("step", "get_observations", "reset", "set_state", "keep", "mirror", "episode_length_buf", *COMPUTED)
"""Methods and properties of tasks that others call."""
OWNERS = (
    ("self", LeggedRobot, "Task"),
    ("self", BaseTask, "Learning"),
    ("self.state", RobotState, "State"),
    ("self.control", ControlParameters, "Constants of the control laws"),
    ("self.sim", Engine, "Physics engine"),
)
"""How to get at an object, its class, whose docstring lists attributes, and a title; tensors are also the task's."""
UNLISTED = {
    "num_envs": "Number of worlds.",
    "num_dof": "Number of joints.",
    "num_actions": "Number of actions.",
    "dof_names": "Names of the joints, in the order of all vectors of joints.",
    "foot_names": "Names of the feet, in the order of all vectors of feet.",
    "dt": "Control step [s].",
    "max_episode_length": "Control steps of an episode that ends by time.",
    "cfg": "The settings.",
    "reward_names": "Names of the reward terms with a scale that is not 0.",
    "episode_sums": "Weighted sums of each term over the episode so far. Shape: (terms, num_envs).",
    "command_generator": "What draws the commands.",
    "terrain": "The ground.",
    "asset": "What was read from the robot's file.",
    "symmetry": "Mirror images of joints and feet.",
    "motor_strength": "Factors on torques. Shape: (num_envs, num_dof).",
    "dof_pos_limits": "Joint limits, narrowed by `rewards.soft_dof_pos_limit` [rad]. Shape: (num_dof, 2).",
    "penalized_contact_indices": "Places of the geoms of `asset.penalize_contacts_on` in contacts. Shape: (geoms,).",
    "termination_contact_indices": "Those of `asset.terminate_after_contacts_on`. Shape: (geoms,).",
    "steps_before": "In evaluations, steps besides the episode's that count for time-outs. Shape: (num_envs,), int64.",
    "held_joints": "1 for each joint of `rewards.held_joints`, else 0. Shape: (num_dof,).",
}
"""Attributes of tasks that no docstring lists."""


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
            if name.startswith("_"):
                continue
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
    section = SECTIONS.get(name, "")
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


def plain(text: str) -> str:
    """Return text of a docstring as a cell of a table."""
    text = re.sub(r":\w+:`~?[\w.]*?(\w+)`", r"`\1`", text).replace("``", "`").replace("|", "\\|")
    return " ".join(text.split())


def attribute_rows(owner: str, cls: type) -> list[str]:
    """Return rows of the attributes that a class's docstring lists."""
    text = (inspect.getdoc(cls) or "").partition("Attributes:\n")[2].partition("\n\n")[0]
    found = re.findall(r"^    (\w[\w, ]*): (.*(?:\n     +.*)*)", text, re.MULTILINE)
    result = []
    for names, meaning in found:
        path = "self" if cls in (RobotState, ControlParameters) and "Shape" in meaning else owner
        result.append(attribute_row([f"{path}.{name}" for name in names.split(", ")], meaning))
    return result


def attribute_row(names: list[str], meaning: str) -> str:
    """Return the row of attributes that share a meaning; what follows "Shape:" in it is the last column."""
    text, _, shape = plain(meaning).partition("Shape: ")
    text, _, shapes = text.partition("Shapes: ")
    return f"| {', '.join(f'`{name}`' for name in names)} | {text.strip()} | {(shape or shapes).rstrip('.')} |"


def task_page() -> str:
    """Return task.md."""
    parts = [TASK_HEAD.rstrip()]
    for cls, name in HOOKS:
        method = getattr(cls, name)
        arguments = ", ".join(list(inspect.signature(method).parameters)[1:])
        where = f"In `{cls.__name__}`: " if not hasattr(LeggedRobot, name) else ""
        parts.append(f"| `{name}({arguments})` | {where}{plain(inspect.getdoc(method) or '')} |")
    parts += ["", "## Methods and properties", "", "| name | what it does |", "|---|---|"]
    for name in METHODS:
        member = inspect.getattr_static(RobotState if name in COMPUTED else LeggedRobot, name)
        is_method = inspect.isfunction(member)
        signature = f"({', '.join(list(inspect.signature(member).parameters)[1:])})" if is_method else ""
        parts.append(f"| `{name}{signature}` | {plain(inspect.getdoc(member) or '')} |")
    for owner, cls, title in OWNERS:
        parts += ["", f"## {title}", "", "| attribute | meaning [unit] | shape |", "|---|---|---|"]
        if cls is LeggedRobot:
            parts += [attribute_row([f"self.{name}"], meaning) for name, meaning in UNLISTED.items()]
        parts += [row for row in attribute_rows(owner, cls) if row not in parts]
    return "\n".join([*parts, ""])


def names_page() -> str:
    """Return old_names.md."""
    parts = [NAMES_HEAD.rstrip()]
    for kind in ("settings", "methods", "attributes"):
        parts += ["", f"## {kind.capitalize()}", "", "| old name | what to use |", "|---|---|"]
        parts += [f"| `{name}` | {plain(text)} |" for name, text in successors(kind).items()]
    return "\n".join([*parts, ""])


def of_site(file: str) -> str:
    """Return a document of the root as a page of the site, with links that lead to pages."""
    text = (ROOT / file).read_text("utf-8")
    text = re.sub(r"^!\[[^\]]*\]\(https:.*\n+", "", text, flags=re.MULTILINE)  # nothing is loaded from elsewhere
    text = text.replace("](docs/", "](")
    for name, page in OF_SITE.items():
        text = text.replace(f"]({name}", f"]({page}")
    return text


OF_SITE = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
"""Documents of the root, and the pages that the site has of them."""
OF_CODE = {
    "reference/settings.md": settings_page,
    "reference/scripts.md": scripts_page,
    "reference/task.md": task_page,
    "reference/old_names.md": names_page,
}
"""Pages by what makes them."""
PAGES = (*OF_SITE.values(), *OF_CODE)
"""Paths of the generated pages in docs/."""


def pages() -> dict[str, str]:
    """Return the generated pages by their paths in docs/."""
    return {page: of_site(file) for file, page in OF_SITE.items()} | {page: make() for page, make in OF_CODE.items()}


if __name__ == "__main__":
    os.chdir(SCRIPTS_DIR.parent)  # whence examples are written
    for page, text in pages().items():
        (HERE.parent / page).write_text(text, encoding="utf-8")
        print(HERE.parent / page)
