"""Tasks outside the package: files that are named, packages that are installed, and the example that shows both."""

import re
import runpy
import sys

import pytest
import yaml
from support.scripts import ROOT, assert_light, assert_told_in_one_line, contents, run_here
from support.settings import error_of, parse

from legged_torque.envs import task_registry
from legged_torque.experiments.matrix import CellState, read_matrix, step_words
from legged_torque.utils.errors import UserError

EXAMPLE = ROOT / "examples" / "quiet_walker"
FILE = EXAMPLE / "quiet_walker.py"
REGISTER = "from legged_torque.envs import A1TorqueCfg, A1TorqueCfgPPO, task_registry\n"
REGISTER += "task_registry.register('{}', 'legged_torque.envs:TorqueRobot', A1TorqueCfg(), A1TorqueCfgPPO())\n"
SMALL = ["--device=cpu", "--num_envs=2", "--set=runner.num_steps_per_env=4", "--max_iterations=1", "--logger=none"]


@pytest.fixture(autouse=True)
def apart(monkeypatch):
    """What a test registers and imports is forgotten after it."""
    monkeypatch.setattr(task_registry, "_tasks", dict(task_registry._tasks))
    monkeypatch.setattr(task_registry, "_looks_for_installed", True)
    monkeypatch.setattr(sys, "path", list(sys.path))
    before = set(sys.modules)
    yield
    for name in ("quiet_walker", "quiet_robot", "theirs", "broken", "offered", "faulty"):
        if name not in before:
            sys.modules.pop(name, None)


def install(folder, **modules):
    """Make a folder to import from in which a package offers modules, given with their text, as entry points."""
    info = folder / "theirs-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n")
    points = [f"{name} = {name}\n" for name in modules]
    (info / "entry_points.txt").write_text("".join(["[legged_torque.tasks]\n", *points]))
    for name, text in modules.items():
        (folder / f"{name}.py").write_text(text)
    sys.path.insert(0, str(folder))


def test_the_example(monkeypatch):
    """Its own tests pass where legged_torque is all that is installed."""
    monkeypatch.syspath_prepend(EXAMPLE)
    names = runpy.run_path(str(EXAMPLE / "test_quiet_walker.py"))
    tests = [value for name, value in names.items() if name.startswith("test_")]
    assert len(tests) == 2
    for test in tests:
        test()


def test_the_page_shows_the_entry_point():
    """As the example has it."""
    page = (ROOT / "docs" / "howto" / "own_tasks.md").read_text()
    point = re.search(r"^```toml\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL)[1]
    assert point in (EXAMPLE / "pyproject.toml").read_text()


def test_a_named_file(tmp_path):
    """A training of its task, and the next commands, which name the file; a run alone does not make it known."""
    words = [f"--task_file={FILE}", "--task=a1_quiet_walker"]
    status, output, error = run_here("train.py", *words, *SMALL, root=tmp_path)
    assert (status, error) == (0, "")
    (run,) = (tmp_path / "logs" / "a1_quiet_walker").iterdir()
    assert f"--task_file={FILE} --load_run=" in output
    assert yaml.safe_load((run / "config.yaml").read_text())["task"] == "a1_quiet_walker"


def test_a_run_names_no_file(tmp_path):
    """An entry in a run's settings or in the description of an experiment is not listened to."""
    (tmp_path / "theirs.py").write_text("raise AssertionError\n")
    plan = {"tasks": ["a1_position"], "environments": {"none": ["none"]}, "seeds": [1]}
    file = tmp_path / "plan.yaml"
    file.write_text(yaml.safe_dump(plan | {"task_files": [str(tmp_path / "theirs.py")]}))
    assert "unknown experiment key 'task_files'" in error_of(read_matrix, file)


def test_answers_come_before_torch(tmp_path):
    """A file whose class is only named is listed without anything heavy."""
    assert_light({("train.py", "--list", f"--task_file={FILE}"): 0}, tmp_path)


OWN = """from legged_torque.envs import A1TorqueCfg, A1TorqueCfgPPO, task_registry

class OwnCfgPPO(A1TorqueCfgPPO):
    class runner: total_steps, num_steps_per_env = 128_000, 8
    class actor: hidden_dims = [64, 64]
    class critic: hidden_dims = [128, 128]

class OwnCfg(A1TorqueCfg):
    class env: num_envs = 512

task_registry.register("own", "legged_torque.envs:TorqueRobot", OwnCfg(), type("Variant", (OwnCfgPPO,), {})())
"""


@pytest.mark.parametrize(("task", "kept"), [("own", ""), ("own", "runner.total_steps"), ("a1_torque", "")])
def test_what_the_preset_for_cpus_replaces(task, kept, tmp_path, capsys):
    """A note names the settings of the file that change, not those of the library, and a preset that keeps them."""
    (tmp_path / "theirs.py").write_text(OWN)
    task_registry.import_files([tmp_path / "theirs.py"])
    new_settings = runpy.run_path(str(ROOT / "scripts" / "train.py"))["new_settings"]
    options = parse(f"--task={task}", *([f"--set={kept}=256000"] if kept else []))
    _, train_cfg = new_settings(options)
    assert options.preset == "laptop" and train_cfg.actor.hidden_dims == [128, 128]
    names = [name for name in ("runner.total_steps", "actor.hidden_dims") if name != kept]
    said = f"Note: on a CPU, the preset laptop replaces the task's own {', '.join(names)}; --preset parallel keeps them"
    assert capsys.readouterr().out == (f"{said}\n" if task == "own" else "")
    if task == "own":
        _, train_cfg = new_settings(parse("--task=own", "--preset=parallel"))
        assert (train_cfg.runner.total_steps, train_cfg.actor.hidden_dims) == (128_000, [64, 64])
        assert not capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("x = 1\n", "'theirs.py': it registers no task"),
        ("def f(:\n", "'theirs.py' cannot be imported: line 1 of 'theirs.py': SyntaxError"),
        ("import sys\nsys.exit()\n", "'theirs.py' cannot be imported: line 2 of 'theirs.py': SystemExit"),
        ("raise GeneratorExit\n", "'theirs.py' cannot be imported: line 1 of 'theirs.py': GeneratorExit"),
        (REGISTER.format("x").replace("'x'", "5"), "'theirs.py': the name of a task must be a text"),
        (None, "--task_file: there is no file 'theirs.py'"),
    ],
)
def test_files_of_no_use(text, told, tmp_path):
    """The reason is one line, nothing is written, and the tasks are as before."""
    if text is not None:
        (tmp_path / "theirs.py").write_text(text)
    before, tasks = contents(tmp_path), task_registry.names()
    result = run_here("train.py", "--task_file=theirs.py", "--task=a1_torque", *SMALL, root=tmp_path)
    assert_told_in_one_line(result, told)
    sys.modules.pop("theirs", None)
    assert {path for path in contents(tmp_path) if "__pycache__" not in path.parts} == set(before)
    assert task_registry.names() == tasks


ALONE = """
from legged_torque.envs import A1TorqueCfg, A1TorqueCfgPPO, TorqueRobot, task_registry

class Alone(TorqueRobot):
    def _reward_torques(self):
        return self.torques.square().mean()

task_registry.register("faulty", Alone, A1TorqueCfg(), A1TorqueCfgPPO())
"""


TRAINING = """
from legged_torque.envs import A1TorqueCfg, A1TorqueCfgPPO, task_registry
from legged_torque.utils.config import Section

class Cfg(A1TorqueCfgPPO):
{}

task_registry.register("faulty", "legged_torque.envs:TorqueRobot", A1TorqueCfg(), Cfg())
"""
RUNNER = TRAINING.format("    class runner:\n        class_name = 'OnPolicyRunner'")
CURIOUS = TRAINING.format("    class algorithm:\n        class rnd_cfg(Section):\n            weight: float = 1.0")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (ALONE, "reward term 'torques' must be float32 (2,) on cpu, not float32 () on cpu"),
        (RUNNER, "runner.class_name must name legged_torque.learning.runner:OnPolicyRunner or what inherits it, not"),
        (CURIOUS, "does not support algorithm.rnd_cfg"),
    ],
    ids=["reward", "runner", "rnd_cfg"],
)
def test_what_cannot_train(text, message, tmp_path):
    """It is found before the run has a folder."""
    (tmp_path / "faulty.py").write_text(text)
    told = run_here("train.py", "--task_file=faulty.py", "--task=faulty", *SMALL, root=tmp_path)
    assert_told_in_one_line(told, message)
    assert not (tmp_path / "logs").exists()


def test_a_name_that_is_taken(tmp_path):
    """A file does not stand in for a module that is installed."""
    (tmp_path / "yaml.py").write_text(REGISTER.format("theirs"))
    (tmp_path / "__main__.py").write_text(REGISTER.format("theirs"))  # the script that runs
    for name in ("yaml", "__main__"):
        with pytest.raises(UserError, match=f"there is another module '{name}'; rename the file"):
            task_registry.import_files([tmp_path / f"{name}.py"])


def test_installed_packages(tmp_path, capsys):
    """Their tasks are known when they are asked for, not before; a broken package is reported, and spoils nothing."""
    install(tmp_path, offered=REGISTER.format("their_task"), faulty="import nothing_of_this_name\n")
    task_registry.get_cfgs("a1_torque")
    assert "offered" not in sys.modules
    env_cfg, _ = task_registry.get_cfgs("their_task")
    assert env_cfg.control.torque_scale == 8.0 and task_registry.names()[-1] == "their_task"
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "Note: the entry point 'faulty = faulty' cannot be imported: line 1 of 'faulty.py': ModuleNotFound" in told


def test_experiments_pass_the_file_on(tmp_path):
    """Each step gets the file, by its absolute path; a cluster, whose machines lack it, is refused."""
    plan = {"tasks": ["a1_quiet_walker"], "environments": {"none": ["none"]}, "seeds": [1]}
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(plan))
    matrix = read_matrix(tmp_path / "plan.yaml", [str(FILE)])
    (cell,) = matrix.cells(tmp_path)
    words = step_words(matrix, cell, CellState(0, None, ["none"]), "cpu")
    assert words[0] == "train.py" and f"--task_file={FILE}" in words
    words = ["plan.yaml", f"--task_file={FILE}", "--launcher=ray"]
    assert_told_in_one_line(run_here("experiment.py", *words, root=tmp_path), "on a cluster, install the tasks")
