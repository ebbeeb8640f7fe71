"""The order of the house: which folder may import which, no circles, no file too long to read."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LEVELS = [
    ("utils",),
    ("learning.settings",),
    ("sim", "terrain", "motors"),
    ("envs.base",),
    ("envs.robots", "envs.approaches", "envs.grounds", "importer"),
    ("envs",),
    ("learning",),
    ("deploy", "benchmark"),
    ("viewer", "experiments"),
    ("paper",),
]
"""Folders of the package from low to high: one imports those of lower levels, no others. Scripts are above all."""
LEVEL_OF = {f"legged_torque.{folder}": number for number, level in enumerate(LEVELS) for folder in level}
MAX_LINES = 400


def module_name(file):
    """A file's name as an import says it."""
    return ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def imports(tree, known):
    """What a module imports of this repository, also inside of functions.

    Args:
        tree: The parsed module.
        known: Names of all modules.

    Returns:
        (name of the module, line, whether it is for type checkers only) of each import.
    """
    blocks = [node for node in ast.walk(tree) if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)]
    for_types = {inner for block in blocks for statement in block.body for inner in ast.walk(statement)}
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"  # ruff says so, too
            inner = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in known else node.module for name in inner]
        else:
            continue
        ours = [name for name in dict.fromkeys(names) if name.split(".")[0] in ("legged_torque", "scripts")]
        found += [(name, node.lineno, node in for_types) for name in ours]
    return found


def folder_of(module):
    """The folder of LEVELS that a module is in; the package's own ``__init__`` and what is unknown are in none."""
    parts = module.split(".")
    prefixes = (".".join(parts[:length]) for length in range(len(parts), 0, -1))
    return next((prefix for prefix in prefixes if prefix in LEVEL_OF), None)


@pytest.fixture(scope="module")
def house():
    """What each module of the package imports, see :func:`imports`."""
    files = {module_name(file): file for file in sorted((ROOT / "legged_torque").rglob("*.py"))}
    files |= {f"legged_torque.{module_name(file)}": file for file in sorted((ROOT / "paper").rglob("*.py"))}
    return {name: imports(ast.parse(file.read_text("utf-8")), files) for name, file in files.items()}


def test_every_folder_has_its_level(house):
    """Only the package's own ``__init__`` is outside of all folders."""
    assert [module for module in house if folder_of(module) is None] == ["legged_torque"]


def test_no_import_runs_upwards(house):
    """A folder imports itself, lower ones and the package's ``__init__``, for type checkers as well."""
    wrong = []
    for module, found in house.items():
        own = folder_of(module)
        for name, line, _ in found:
            other = folder_of(name)
            is_lower = name == "legged_torque" or (other and own and LEVEL_OF[other] < LEVEL_OF[own])
            if not is_lower and (other is None or other != own):
                wrong.append(f"{module}, line {line}: {name}")
    assert not wrong, "\n".join(wrong)


def test_no_import_circle(house):
    """No module imports itself by way of others; what is for type checkers only does not count."""
    edges = {module: [name for name, _, for_types in found if not for_types] for module, found in house.items()}
    done, path = set(), []

    def visit(module):
        assert module not in path, " -> ".join([*path[path.index(module) :], module])
        if module not in done:
            path.append(module)
            for name in edges.get(module, ()):
                visit(name)
            done.add(path.pop())

    for module in edges:
        visit(module)


def test_scripts_are_above_everything():
    """A script imports the package, never another script."""
    for file in (ROOT / "scripts").glob("*.py"):
        found = imports(ast.parse(file.read_text("utf-8")), ())
        siblings = [path.stem for path in file.parent.glob("*.py")]
        assert not [name for name, _, _ in found if folder_of(name) is None and name != "legged_torque"], file
        plain = [node for node in ast.walk(ast.parse(file.read_text("utf-8"))) if isinstance(node, ast.Import)]
        assert not [alias.name for node in plain for alias in node.names if alias.name in siblings], file


def test_files_are_short_enough_to_read():
    """No file of the package or of the scripts is longer than what one reads in one sitting."""
    files = [file for folder in ("legged_torque", "scripts") for file in (ROOT / folder).rglob("*.py")]
    lengths = {str(file.relative_to(ROOT)): len(file.read_text("utf-8").splitlines()) for file in files}
    assert not {name: length for name, length in lengths.items() if length > MAX_LINES}


def test_reading_of_imports():
    """Imports are found wherever they stand, and those for type checkers are told apart."""
    tree = ast.parse(
        "import legged_torque.utils.math\n"
        "from legged_torque.sim import graph, missing\n"
        "if TYPE_CHECKING:\n    from legged_torque.envs.base.legged_robot import LeggedRobot\n"
        "def later():\n    from legged_torque import learning\n    import numpy\n"
    )
    known = {"legged_torque.sim.graph", "legged_torque.learning"}
    assert sorted(imports(tree, known)) == [
        ("legged_torque.envs.base.legged_robot", 4, True),
        ("legged_torque.learning", 6, False),
        ("legged_torque.sim", 2, False),
        ("legged_torque.sim.graph", 2, False),
        ("legged_torque.utils.math", 1, False),
    ]
    assert [folder_of(f"legged_torque.{name}") for name in ("envs", "envs.base.x", "sim.fused.y", "z")] == [
        "legged_torque.envs",
        "legged_torque.envs.base",
        "legged_torque.sim",
        None,
    ]
