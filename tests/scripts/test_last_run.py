"""Without a task, scripts take the last run of all tasks, or the task of the run that is named."""

import re
import runpy
import shlex
import shutil

import pytest
from support.scripts import LOADING, ROOT, assert_told_in_one_line, contents, run_here

from legged_torque.utils.options import Options
from legged_torque.utils.policies import POLICIES_DIR

FIRST, LAST = "2026-01-01_00-00-00", "2026-01-02_00-00-00"


@pytest.fixture
def logs(trained, tmp_path):
    """A folder of logs with a run of a1_position and a later one of a1_torque; neither is the default task."""
    for task, name in {"a1_position": FIRST, "a1_torque": LAST}.items():
        shutil.copytree(trained[task], tmp_path / "logs" / task / name)
    return tmp_path / "logs"


@pytest.mark.parametrize("script", LOADING)
def test_last_run_of_all_tasks(script, logs):
    """It is loaded with its task; a run by its path or its name brings its own; a task that differs is refused."""
    words = ["--device=cpu", *LOADING[script]]
    runs = {LAST: [], FIRST: [f"--load_run={FIRST}"], f"a1_position/{FIRST}": [f"--load_run=logs/a1_position/{FIRST}"]}
    for name, choice in runs.items():
        status, output, error = run_here(script, *words, *choice, root=logs.parent)
        assert (status, error) == (0, "")
        assert f"{name}/model_1.pt" in output
        for new in set(logs.glob("*/*")) - {logs / "a1_position" / FIRST, logs / "a1_torque" / LAST}:
            shutil.rmtree(new)  # of train.py --resume
    choice = ["--task=a1_position", f"--load_run=logs/a1_torque/{LAST}"]
    result = run_here(script, *words, *choice, root=logs.parent)
    assert_told_in_one_line(result, "is of task 'a1_torque', not 'a1_position'")


def test_one_name_of_two_runs(logs):
    """Which one is meant is asked for, and trainings that begin in the same second print paths."""
    run, run_words = logs / "a1_position" / FIRST, runpy.run_path(f"{ROOT}/scripts/train.py")["run_words"]
    assert run_words(Options(), str(run)) == f"--load_run={FIRST}"
    shutil.copytree(logs / "a1_torque" / LAST, logs / "a1_torque" / FIRST)
    told = f"logs/a1_position/{FIRST}, logs/a1_torque/{FIRST}"
    assert_told_in_one_line(run_here("evaluate.py", f"--load_run={FIRST}", root=logs.parent), told)
    assert run_words(Options(), str(run)) == f"--load_run={run}"


def test_two_rates_are_not_compared(logs):
    """Control steps of another length do not run beside each other."""
    other = shutil.copytree(logs / "a1_position" / FIRST, logs / "a1_position" / LAST)
    config = (other / "config.yaml").read_text()
    (other / "config.yaml").write_text(config.replace("decimation: 4", "decimation: 2"))
    words = ["--device=cpu", "--viewer=web", f"--load_run=logs/a1_position/{FIRST}", f"--compare={other}"]
    assert_told_in_one_line(run_here("play.py", *words, root=logs.parent), "runs of one rate, not 50 and 100 Hz")


def test_command_that_goes_on(logs):
    """A resume that has nothing left to do names a command that does go on."""
    words = ["--device=cpu", "--resume", "--logger=none", f"--load_run={FIRST}"]
    status, _, error = run_here("train.py", *words, root=logs.parent)
    command = error.partition("to go on: ")[2]
    assert status == 2 and command.startswith(f"python {ROOT}/scripts/train.py ")
    status, output, error = run_here("train.py", *shlex.split(command)[2:], root=logs.parent)
    assert (status, error) == (0, "") and f"logs/a1_position/{FIRST}/model_1.pt" in output
    assert [file.name for file in logs.glob("a1_position/*/model_2.pt")] == ["model_2.pt"]
    hints = re.findall(r"^(?:See|Measure|Take) .+?: (.+)$", output, re.MULTILINE)
    assert len(hints) == 4 and max(len(hint.replace(f"{ROOT}/", "")) for hint in hints) <= 80
    script, *rest = shlex.split(next(hint for hint in hints if "evaluate" in hint))[1:]
    status, output, _ = run_here("evaluate.py", *rest, "--steps=1", "--num_envs=2", root=logs.parent)
    assert script.endswith("evaluate.py") and status == 0 and "model_2.pt" in output


def test_last_export(logs):
    """sim2sim.py takes the newest policy that export.py has written; without one, it says what to do."""
    pytest.importorskip("onnxruntime", reason="the extra 'export' is not installed")
    words = ["--robots=1", "--steps=2"]
    assert_told_in_one_line(run_here("sim2sim.py", *words, root=logs.parent), "there is no exported policy in 'logs'")
    before = contents(POLICIES_DIR)
    for choice in ([f"--load_run={FIRST}"], [], ["--policy=a1/position"]):
        assert run_here("export.py", "--device=cpu", *choice, root=logs.parent)[0] == 0
    assert (logs / "a1" / "position" / "exported_1119" / "policy.onnx").is_file()
    assert contents(POLICIES_DIR) == before
    status, output, error = run_here("sim2sim.py", *words, root=logs.parent)
    assert (status, error) == (0, "") and output.startswith(f"a1_torque, model_1.pt of {LAST}, ")
    for task in ("a1_position", "a1_torque"):
        shutil.rmtree(logs / task)
    status, output, error = run_here("sim2sim.py", *words, root=logs.parent)
    assert (status, error) == (0, "") and output.startswith("a1_position, model_1119.pt of ")
