"""Importing a robot's file never runs code from it, and the script writes both of its files or none."""

import functools

import pytest
from support.robot_files import as_mjcf, urdf
from support.scripts import ROOT, assert_told_in_one_line, run_here

from legged_torque.envs import robots, task_registry, tasks
from legged_torque.envs.base.asset import load_asset
from legged_torque.importer.mjcf import mjcf
from legged_torque.importer.robot import import_robot
from legged_torque.importer.settings import settings
from legged_torque.utils.errors import UserError

HARMFUL = ["FL_'+str(open('PWNED', 'w'))+'", "FL_&quot;+str(open('PWNED', 'w'))+&quot;", "FL_&#10;x", "FL_\\", "FL_é"]


@pytest.mark.parametrize("name", HARMFUL)
@pytest.mark.parametrize("place", ["FL_calf", "LF_HAA", "LF_hip", "base"])
def test_names_that_are_code(tmp_path, name, place):
    """Names of bodies, joints and links are refused before they can become parts of a settings module."""
    source = as_mjcf("") if place == "FL_calf" else urdf()
    assert f'"{place}"' in source
    file = tmp_path / "robot.xml"
    file.write_text(source.replace(f'"{place}"', f'"{name}"'), encoding="utf-8")
    with pytest.raises(UserError, match="names may have letters, digits"):
        import_robot(file)


def test_files_whose_names_are_code(tmp_path, monkeypatch):
    """The name of the file, and that of the folder of its MJCF, are no code either, and its MJCF stays XML."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "a\"+str(open('PWNED', 'w'))+\"\nopen('PWNED', 'w')"
    folder.mkdir()
    file = folder / 'dog\nopen("PWNED", "w")#""" --->.urdf'
    file.write_text(urdf())
    robot = import_robot(file, "dog")
    mjcf(robot)
    parts: dict = {"__name__": "dog"}
    exec(compile(settings(robot, str(folder / "dog.xml")), "dog.py", "exec"), parts)
    assert parts["DogCfg"]().asset.file == str(folder / "dog.xml")
    assert not (tmp_path / "PWNED").exists()


def test_a_broken_module(tmp_path, monkeypatch, capsys):
    """It is reported in a line, and the other robots are there."""
    (tmp_path / "broken.py").write_text("class Cfg(:\n")
    before = [parts[0] for parts in tasks.further_robots()]
    monkeypatch.setattr(robots, "__path__", [*robots.__path__, str(tmp_path)])
    assert [parts[0] for parts in tasks.further_robots()] == before
    assert "Note: the robot 'broken' is missing: SyntaxError" in capsys.readouterr().err


def test_script(tmp_path, monkeypatch):
    """The script writes both files once, says what simulates the robot, and writes over nothing."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dog.urdf").write_text(urdf())
    run = functools.partial(run_here, "import_robot.py", "dog.urdf", root=tmp_path)
    status, output, _ = run("--out", "new")
    assert status == 0 and "sim.engine 'fused' simulates it" in output
    assert output.endswith(f"Train it: python {ROOT}/scripts/train.py --task_file new/dog.py --task=dog_position\n")
    before = task_registry._tasks
    monkeypatch.setattr(task_registry, "_tasks", dict(task_registry._tasks))
    task_registry.import_files(["new/dog.py"])
    assert {"dog_position", "dog_torque_multihead", "dog_rough_torque_scan"} <= set(task_registry.names())
    assert len(load_asset(task_registry.get_cfgs("dog_torque")[0]).feet) == 4
    monkeypatch.setattr(task_registry, "_tasks", before)
    assert sorted(path.name for path in (tmp_path / "new").glob("dog.*")) == ["dog.py", "dog.xml"]
    assert_told_in_one_line(run("--out", "new"), "exists")
    assert_told_in_one_line(run("--name", "class"), "be no keyword of Python, not 'class'")
    assert_told_in_one_line(run("--name", "random"), "there is another module 'random'; see --name")
    (tmp_path / "own.xml").write_text(as_mjcf(""))
    own = run_here("import_robot.py", "own.xml", "--force", root=tmp_path)
    assert_told_in_one_line(own, "'own.xml' is the file to import; --name and --out write elsewhere")
    assert (tmp_path / "own.xml").read_text() == as_mjcf("") and not list(tmp_path.glob("random.*"))
    assert_told_in_one_line(run("--name", "go2_torque"), "names that are taken, as 'go2_torque_gravity'")
    assert run("--name", "cat")[0] == 0
    assert sorted(path.name for path in tmp_path.glob("cat.*")) == ["cat.py", "cat.xml"]  # outside of a clone
    for number in ("1e20", "0"):
        assert run("--name", "hen", "--torque_limit", number)[0] == 2
    assert not list(tmp_path.glob("hen.*"))


def test_robots_of_the_library(tmp_path, monkeypatch):
    """Those that nobody has imported are not written over."""
    monkeypatch.setattr("legged_torque.utils.files.write_whole", lambda *file: pytest.fail("something was written"))
    (tmp_path / "go2.urdf").write_text(urdf())
    refused = run_here("import_robot.py", str(tmp_path / "go2.urdf"), "--force", root=ROOT)
    assert_told_in_one_line(refused, "the robot 'go2' was not imported, and stays as it is; see --name")


def test_robots_of_the_clone(tmp_path, monkeypatch, capsys):
    """Modules in envs/robots are robots, others and helpers beside them are none, nor are two robots in one."""
    (tmp_path / "dog.urdf").write_text(urdf())
    text = settings(import_robot(tmp_path / "dog.urdf"), "resources/robots/dog/dog.xml")
    (tmp_path / "dog.py").write_text(text)
    helper = "from legged_torque.envs.robots.a1 import A1Cfg\ndef half(number):\n    return number / 2\n"
    (tmp_path / "legs_of_many.py").write_text(helper)
    monkeypatch.setattr(robots, "__path__", [*robots.__path__, str(tmp_path)])
    (found,) = [parts for parts in tasks.further_robots() if parts[0] in ("dog", "legs_of_many")]
    assert [name for name, *_ in tasks.tasks_of(*found)][:2] == ["dog_position", "dog_torque"]
    (tmp_path / "two.py").write_text(text + "class B(DogCfg): pass\n")
    assert "two" not in [name for name, *_ in tasks.further_robots()]
    assert "'two' is missing: UserError: it must have one class of this kind, not DogCfg, B" in capsys.readouterr().err
