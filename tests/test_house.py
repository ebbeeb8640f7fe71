"""The structure of the repository: directions of imports, no circles, and limits on lines."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LEVELS = [
    ("utils",),
    ("sim", "terrain"),
    ("motors", "envs.base.state"),
    ("sensors",),
    ("envs.base",),
    ("envs.robots", "envs.approaches", "envs.grounds", "importer"),
    ("envs",),
    ("learning",),
    ("deploy", "benchmark"),
    ("viewer", "experiments", "runtime", "identification"),
    ("paper",),
]
"""Parts of the package from low to high: one imports those of lower levels, no others. Scripts and tools are above."""
LEVEL_OF = {f"legged_torque.{part}": number for number, level in enumerate(LEVELS) for part in level}
MAX_LINES = 400  # of a file
LINES = {
    "legged_torque/benchmark": 193,
    "legged_torque/deploy": 1554,
    "legged_torque/envs": 5543,
    "legged_torque/experiments": 1124,
    "legged_torque/identification": 459,
    "legged_torque/importer": 1295,
    "legged_torque/learning": 4540,
    "legged_torque/motors": 1557,
    "legged_torque/runtime": 2192,
    "legged_torque/sensors": 321,
    "legged_torque/sim": 5952,
    "legged_torque/terrain": 574,
    "legged_torque/utils": 3575,
    "legged_torque/viewer": 2494,
    "scripts": 2069,
    "paper": 3214,
    "tools": 1484,
    "tests": 28227,
}
"""Budgets of lines of Python. Whoever needs more empties another folder first."""
MAX_PACKAGE = 33_487  # lines of legged_torque and scripts; 20,000 are the aim: lower it with every folder


def module_name(file):
    """A file's name as an import says it."""
    return ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def imports(tree, known):
    """Return (name, line) of each import of this repository, also inside of functions and for type checkers."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            inner = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in known else node.module for name in inner]
        else:
            continue
        ours = [name for name in dict.fromkeys(names) if name.split(".")[0] in ("legged_torque", "scripts", "tools")]
        found += [(name, node.lineno) for name in ours]
    return found


def part_of(module):
    """The part of LEVELS that a module is in; the package's own ``__init__`` and what is unknown are in none."""
    parts = module.split(".")
    prefixes = (".".join(parts[:length]) for length in range(len(parts), 0, -1))
    return next((prefix for prefix in prefixes if prefix in LEVEL_OF), None)


@pytest.fixture(scope="module")
def modules():
    """What each module of the package imports, see :func:`imports`."""
    files = {module_name(file): file for file in sorted((ROOT / "legged_torque").rglob("*.py"))}
    files |= {f"legged_torque.{module_name(file)}": file for file in sorted((ROOT / "paper").rglob("*.py"))}
    return {name: imports(ast.parse(file.read_text("utf-8")), files) for name, file in files.items()}


def test_every_module_has_its_level(modules):
    """Only the package's own ``__init__`` is outside of all parts."""
    assert [module for module in modules if part_of(module) is None] == ["legged_torque"]


def test_no_import_runs_upwards(modules):
    """A part imports itself, lower ones and the package's ``__init__``."""
    wrong = []
    for module, found in modules.items():
        own = part_of(module)
        for name, line in found:
            other = part_of(name)
            is_lower = name == "legged_torque" or (other and own and LEVEL_OF[other] < LEVEL_OF[own])
            if not is_lower and (other is None or other != own):
                wrong.append(f"{module}, line {line}: {name}")
    assert not wrong, "\n".join(wrong)


def test_no_import_circle(modules):
    """No module imports itself by way of others, not even for type checkers."""
    done, path = set(), []

    def visit(module):
        assert module not in path, " -> ".join([*path[path.index(module) :], module])
        if module not in done:
            path.append(module)
            for name, _ in modules.get(module, ()):
                visit(name)
            done.add(path.pop())

    for module in modules:
        visit(module)


def test_scripts_are_above_everything():
    """Scripts and tools import the package, never each other."""
    for file in [*(ROOT / "scripts").glob("*.py"), *(ROOT / "tools").glob("*.py")]:
        tree = ast.parse(file.read_text("utf-8"))
        assert not [name for name, _ in imports(tree, ()) if part_of(name) is None and name != "legged_torque"], file
        plain = [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
        assert not {path.stem for path in file.parent.glob("*.py")} & set(plain), file


def lines(folder):
    """Number of lines of each file of Python in a folder."""
    return {str(file.relative_to(ROOT)): len(file.read_text("utf-8").splitlines()) for file in folder.rglob("*.py")}


@pytest.mark.parametrize("folder", LINES)
def test_lines(folder):
    """No folder exceeds its budget, and no file what one reads in one sitting."""
    files = lines(ROOT / folder)
    total = sum(files.values())
    assert total <= LINES[folder]
    assert not {name: length for name, length in files.items() if length > MAX_LINES}


def test_lines_of_the_package():
    """All folders have a budget, and the package with its scripts one in all."""
    folders = {f"legged_torque/{path.name}" for path in (ROOT / "legged_torque").iterdir() if any(path.glob("*.py"))}
    assert folders <= set(LINES)
    total = sum(sum(lines(ROOT / folder).values()) for folder in ("legged_torque", "scripts"))
    assert total <= MAX_PACKAGE
