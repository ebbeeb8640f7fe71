"""The package as it is installed: without the repository, and run from any directory."""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("CHANGELOG.md", "LICENSE", "MANIFEST.in", "README.md", "pyproject.toml", "setup.py")
FOLDERS = ("experiments", "legged_torque", "paper", "resources", "scripts", "tests")
SMALL = ["--num_envs=2", "--set=runner.num_steps_per_env=4", "--max_iterations=1", "--logger=none"]


def build(kind, source):
    """Build the "sdist" or the "wheel" of a folder of sources, without a network; return its file."""
    code = f"from setuptools import build_meta; build_meta.build_{kind}('dist')"
    result = subprocess.run([sys.executable, "-c", code], cwd=source, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    (file,) = (source / "dist").iterdir()
    return file


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder with the installed package, made from the source archive."""
    source, unpacked, site = (tmp_path_factory.mktemp(name) for name in ("source", "unpacked", "site"))
    for name in SOURCES:
        shutil.copy(ROOT / name, source)
    for name in FOLDERS:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__", "*.pyc"))
    shutil.unpack_archive(build("sdist", source), unpacked)
    (unpacked,) = unpacked.iterdir()
    with zipfile.ZipFile(build("wheel", unpacked)) as wheel:  # nothing has to be compiled: this installs it
        wheel.extractall(site)
    return site


RUN = """import json, runpy, sys
for script, *sys.argv[1:] in json.loads(sys.argv[1]):
    runpy.run_module(f"legged_torque.scripts.{script}", run_name="__main__", alter_sys=True)"""


def run(installed, folder, *commands):
    """Run installed scripts in a folder, one after the other in a process, which must end well; return the output."""
    environment = {key: value for key, value in os.environ.items() if key != "MUJOCO_GL"}
    environment |= {"PYTHONPATH": str(installed), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", RUN, json.dumps(commands)]
    done = subprocess.run(
        command, cwd=folder, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=200
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


def files(folder):
    """The names of all files below a folder."""
    found = (path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return {path.relative_to(folder).as_posix() for path in found}


def test_contents(installed):
    """The package holds its own files, the robots and the scripts, each once."""
    expected = files(ROOT / "legged_torque")
    folders = {"resources": "resources", "scripts": "scripts", "experiments": "descriptions", "paper": "paper"}
    expected |= {f"{inside}/{name}" for folder, inside in folders.items() for name in files(ROOT / folder)}
    assert files(installed / "legged_torque") == expected
    assert {path.name for path in installed.iterdir() if path.suffix != ".dist-info"} == {"legged_torque"}


def test_command_and_experiments(installed, tmp_path):
    """The console command is there, and finds the experiments that come with the package."""
    (points,) = installed.glob("*.dist-info/entry_points.txt")
    assert "legged-torque = legged_torque.utils.command:main" in points.read_text()
    code = "import legged_torque as l; print(*map(l.experiment_path, ('experiments/smoke.yaml', 'mine.yaml')))"
    environment = os.environ | {"PYTHONPATH": str(installed)}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    smoke, mine = done.stdout.split()
    assert Path(smoke).read_text() == (ROOT / "experiments" / "smoke.yaml").read_text()
    assert smoke.startswith(str(installed)) and mine == "mine.yaml"


def test_scripts_from_another_directory(installed, tmp_path):
    """Play, train, export, let the exported policy walk: all files land in the current directory."""
    task = ["--task=a1_torque_multihead", "--device=cpu"]
    play = ["play", *task, "--agent=random", "--num_envs=2", "--steps=3", "--video=walk.mp4"]  # first, for its renderer
    walk = ["sim2sim", "--robots=1", "--steps=3"]
    output = run(installed, tmp_path, play, ["train", *task, *SMALL], ["export", *task], walk)
    (trained,) = (tmp_path / "logs" / "a1_torque_multihead").iterdir()
    assert (trained / "model_1.pt").is_file() and (trained / "exported_1").is_dir() and "cost_of_transport" in output
    if "no video: " not in output:
        assert (tmp_path / "walk.mp4").read_bytes()[4:8] == b"ftyp"  # the mark of an mp4
    assert str(installed / "legged_torque" / "resources" / "robots") in output
    assert {path.name for path in tmp_path.iterdir()} <= {"logs", "walk.mp4"}
