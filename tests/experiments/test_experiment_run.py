"""Order, failures, locks and signals of an experiment, with stand-ins for the scripts, and for NVIDIA's service."""

import fcntl
import json
import os
import signal
import threading
from pathlib import Path

import pytest
import torch
from support.experiments import SMALL, experiment_here, order, wait_for, write, write_scripts
from support.scripts import assert_told_in_one_line, contents

from legged_torque.experiments import matrix as experiment
from legged_torque.experiments import run as experiment_run
from legged_torque.experiments.job import Job
from legged_torque.experiments.local_launcher import GPU_JOBS, MPS, LocalLauncher, LocalProcess, multi_process_service
from legged_torque.experiments.matrix import CellState, read_matrix
from legged_torque.utils.errors import UserError


@pytest.fixture
def stage(tmp_path, monkeypatch):
    """The folder of the stand-ins, which are started in place of the scripts."""
    monkeypatch.setattr(experiment_run, "POLL", 0.01)
    monkeypatch.setattr(experiment, "SCRIPTS_DIR", write_scripts(tmp_path / "stage"))
    return tmp_path / "stage"


def trained(stage):
    """The cells that were trained, in their order, and the iterations that they had before."""
    return [f"{cell} from {before}" if before != "0" else cell for cell, before, _ in order(stage)]


def test_order_and_commands(stage, tmp_path):
    """A seed comes before the next one; the scripts get the options of the cell and of the file."""
    values = SMALL | {"seeds": [3, 1], "environments": {"low": ["low", "high"], "high": ["high"]}}
    values |= {"ranges": "hard", "preset": "thorough"}
    file, out = write(tmp_path / "m.yaml", values), tmp_path / "out"
    status, output, error = experiment_here(file, f"--out={out}", "--device=cpu", tmp_path=tmp_path)
    assert (status, error) == (0, "")
    cells = [f"{task}-{name}-s{seed}" for seed in (3, 1) for name in ("low", "high") for task in SMALL["tasks"]]
    assert trained(stage) == cells and (out / "experiment.yaml").read_bytes() == file.read_bytes()
    log = (out / "a1_torque-high-s3" / "train.log").read_text()
    words = "--task=a1_torque --seed=3 --perturbation=high --set=runner.total_steps=128 --device=cpu"
    assert {*words.split(), "--ranges=hard", "--preset=thorough"} <= set(log.splitlines()[0].split())
    result = json.loads((out / "a1_torque-low-s3" / "result_high.json").read_text())
    assert (result["perturbation"], result["num_envs"], result["steps"]) == ("high", "256", "2000")
    assert output.count("training on cpu took") == 8 and output.count("evaluation in") == 12
    assert "8 of 8 cells done, " in output and "time left unknown" in output and " left\n" in output


def test_a_cell_that_fails_does_not_stop_the_others(stage, tmp_path):
    """It is tried once more; status 1, the end of its log is shown; the next call tries it, and only it, again.

    Without settings that can be read it fails as well; ``--dry-run`` says so.
    """
    file, out = write(tmp_path / "m.yaml", SMALL), tmp_path / "out"
    (stage / "behaviour").write_text("fail a1_position-low-s1")
    status, output, error = experiment_here(file, f"--out={out}", "--device=cpu", tmp_path=tmp_path)
    assert status == 1 and "1 of 2 cells are done." in output
    assert output.count("training has failed with exit status 1; it will be tried again | ") == 1
    assert error.startswith("a1_position-low-s1: training has failed with exit status 1\n")
    assert str(out / "a1_position-low-s1" / "train.log") in error and error.endswith("    something broke\n")
    (stage / "behaviour").write_text("")
    status, output, error = experiment_here(file, f"--out={out}", "--device=cpu", tmp_path=tmp_path)
    assert (status, error) == (0, "") and "2 of 2 cells are done." in output
    failed, other = "a1_position-low-s1", "a1_torque-low-s1"
    assert trained(stage) == [failed, failed, other, failed]
    (config,) = out.glob(f"{failed}/*/config.yaml")
    config.write_text(config.read_text().replace("max_iterations: 4,", ""))
    listed = experiment_here(file, f"--out={out}", "--device=cpu", "--dry-run", tmp_path=tmp_path)
    status, _, error = experiment_here(file, f"--out={out}", "--device=cpu", tmp_path=tmp_path)
    assert status == 1 and error.endswith(" lack max_iterations\n") and listed == (0, f"{error}{other}: done\n", "")


def test_a_lock_that_cannot_be_taken_fails_its_cell_only(stage, tmp_path):
    """The reason is one line, and the other cell is done."""
    file, out = write(tmp_path / "m.yaml", SMALL), tmp_path / "out"
    (out / "a1_position-low-s1" / "lock").mkdir(parents=True)
    status, output, error = experiment_here(file, f"--out={out}", "--device=cpu", tmp_path=tmp_path)
    lock = out / "a1_position-low-s1" / "lock"
    assert (status, error) == (1, f"a1_position-low-s1: cannot write '{lock}': Is a directory\n")
    assert "1 of 2 cells are done." in output and trained(stage) == ["a1_torque-low-s1"]


def test_a_log_that_is_deleted(stage, tmp_path, monkeypatch):
    """It ends nothing, although its last lines are asked for."""
    file, out, problem = write(tmp_path / "m.yaml", SMALL), tmp_path / "out", Job.problem
    (stage / "behaviour").write_text("fail a1_position-low-s1")
    monkeypatch.setattr(Job, "problem", lambda self: self.log.unlink(missing_ok=True) or problem(self))
    status, output, error = experiment_here(file, f"--out={out}", "--device=cpu", tmp_path=tmp_path)
    assert status == 1 and "1 of 2 cells are done." in output and error.endswith("train.log:\n")


def test_a_training_that_is_killed_is_tried_again(stage, tmp_path):
    """It goes on from its last checkpoint, in the same call."""
    file, out = write(tmp_path / "m.yaml", SMALL | {"tasks": ["a1_torque"]}), tmp_path / "out"
    (stage / "behaviour").write_text("killed once")
    status, output, error = experiment_here(file, f"--out={out}", "--device=cpu", tmp_path=tmp_path)
    assert "a1_torque-low-s1: training was ended by signal 9; it will be tried again | " in output
    assert trained(stage) == ["a1_torque-low-s1", "a1_torque-low-s1 from 2"]
    assert (status, error) == (0, "") and (out / "a1_torque-low-s1" / "result_high.json").is_file()


@pytest.mark.parametrize(
    ("behaviour", "message"),
    [("early", "training has ended after 2 of 4 iterations"), ("broken", "evaluation in low has left no readable")],
)
def test_steps_that_only_seem_to_succeed(stage, tmp_path, behaviour, message):
    """Exit status 0 is not enough; what is incomplete does not become a result."""
    file, out = write(tmp_path / "m.yaml", SMALL), tmp_path / "out"
    (stage / "behaviour").write_text(behaviour)
    status, _, error = experiment_here(file, f"--out={out}", "--device=cpu", "--jobs=2", tmp_path=tmp_path)
    assert status == 1 and error.count(message) == 2 and not list(out.glob("*/result_*.json"))
    (stage / "behaviour").write_text("")
    assert experiment_here(file, f"--out={out}", "--device=cpu", tmp_path=tmp_path)[0] == 0
    assert len(list(out.glob("*/result_*.json"))) == 4
    assert any(" from 2" in line for line in trained(stage)) == (behaviour == "early")


def break_pipe(monkeypatch, word):
    """Let the experiment print nothing with this word: its reader has ended."""

    def gone(*texts, **options):
        if word in texts[0]:
            raise BrokenPipeError
        print(*texts, **options)

    monkeypatch.setattr(experiment_run, "print", gone, raising=False)


def start_to_stop(out, number):
    """Start a thread that sends this process a signal when a training is under way; return it."""

    def stop():
        wait_for(lambda: any("iteration 3 of 4" in log.read_text() for log in out.glob("*/train.log")))
        os.kill(os.getpid(), number)

    thread = threading.Thread(target=stop)
    thread.start()
    return thread


def test_stop_where_nobody_reads(stage, tmp_path, monkeypatch):
    """Trainings are asked once and save, too, if the reader of the output has ended by the same Ctrl-C."""
    file, out = write(tmp_path / "m.yaml", SMALL), tmp_path / "out"
    (stage / "behaviour").write_text("slow")
    break_pipe(monkeypatch, "Stopping")
    asked, terminate = [], LocalProcess.terminate
    monkeypatch.setattr(LocalProcess, "terminate", lambda self: asked.append(self) or terminate(self))
    thread = start_to_stop(out, signal.SIGINT)
    experiment_here(file, f"--out={out}", "--device=cpu", tmp_path=tmp_path)
    thread.join()
    assert len(asked) == 1 and max(path.name for path in out.glob("*/*/model_*")) == "model_3.pt"


def test_nobody_reads(stage, tmp_path, monkeypatch):
    """The trainings in work are asked to stop, and no other is begun."""
    file, out = write(tmp_path / "m.yaml", SMALL), tmp_path / "out"
    break_pipe(monkeypatch, " took ")
    assert experiment_here(file, f"--out={out}", "--device=cpu", tmp_path=tmp_path)[0] == 130
    assert trained(stage) == ["a1_position-low-s1"]


def test_a_terminal_that_closes():
    """It may send its signal twice, which is one request; a second one of another kind counts."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup it would be ignored
    try:
        with experiment_run.CountedStop() as stop:
            for number, count in ((signal.SIGHUP, 1), (signal.SIGHUP, 1), (signal.SIGTERM, 2)):
                os.kill(os.getpid(), number)
                assert stop.count == count
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stop(stage, tmp_path, number):
    """Trainings save before this process ends with the status of the signal, and go on the next time."""
    file, out = write(tmp_path / "m.yaml", SMALL), tmp_path / "out"
    (stage / "behaviour").write_text("slow")
    thread = start_to_stop(out, number)
    status, output, error = experiment_here(file, f"--out={out}", "--device=cpu", tmp_path=tmp_path)
    thread.join()
    assert (status, error) == (128 + number, "interrupted\n")
    assert "Stopping: " in output and "0 of 2 cells are done." in output
    assert max(path.name for path in out.glob("*/*/model_*")) == "model_3.pt"
    (stage / "behaviour").write_text("")
    assert experiment_here(file, f"--out={out}", "--device=cpu", tmp_path=tmp_path)[0] == 0
    assert trained(stage) == ["a1_position-low-s1", "a1_position-low-s1 from 3", "a1_torque-low-s1"]


def test_a_cell_that_another_process_works_on(stage, tmp_path):
    """It is left for later, reported once, and begun when the other process lets it go."""
    file, out = write(tmp_path / "m.yaml", SMALL), tmp_path / "out"
    (out / "a1_position-low-s1").mkdir(parents=True)
    lock, other = (out / "a1_position-low-s1" / "lock").open("a"), out / "a1_torque-low-s1" / "result_high.json"
    fcntl.flock(lock, fcntl.LOCK_EX)
    thread = threading.Thread(target=lambda: (wait_for(other.is_file), lock.close()))
    thread.start()
    status, output, error = experiment_here(file, f"--out={out}", "--device=cpu", tmp_path=tmp_path)
    thread.join()
    assert (status, error) == (0, "")
    assert output.count("a1_position-low-s1: another process works on it; left for later\n") == 1
    assert trained(stage) == ["a1_torque-low-s1", "a1_position-low-s1"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"train": {"runner.total_steps": 64}}, "train.runner.total_steps is 64, was 128; give another --out"),
        ({"train": {}}, "train.runner.total_steps is not set, was 128"),
        ({"ranges": "hard"}, "ranges is hard, was not set"),
        ({"sweeps": {"ground_friction": {}}}, "sweeps.ground_friction is {}, was not set"),
        ({"environments": {"low": ["low"]}}, "environments.low had high as well"),
    ],
)
def test_changed_settings_are_refused(change, message, tmp_path):
    """A folder holds results of the same settings only."""
    out = tmp_path / "out"
    out.mkdir()
    write(out / "experiment.yaml", SMALL)
    file, before = write(tmp_path / "m.yaml", SMALL | change), contents(out)
    for words in ([], ["--dry-run"]):
        result = experiment_here(file, f"--out={out}", "--device=cpu", *words, tmp_path=tmp_path)
        assert_told_in_one_line(result, message)
    assert contents(out) == before


def test_more_cells_are_added(stage, tmp_path):
    """More tasks, environments and seeds may come into a folder; what is there already stays."""
    file, out = write(tmp_path / "m.yaml", SMALL | {"tasks": ["a1_torque"]}), tmp_path / "out"
    assert experiment_here(file, f"--out={out}", "--device=cpu", tmp_path=tmp_path)[0] == 0
    write(file, SMALL | {"environments": {"high": ["high"], "low": ["doubled", "low", "high"]}, "seeds": [2, 1]})
    assert experiment_here(file, f"--out={out}", "--device=cpu", "--jobs=3", tmp_path=tmp_path)[0] == 0
    assert len(trained(stage)) == len(set(trained(stage))) == 8
    assert (out / "a1_torque-low-s1" / "result_doubled.json").is_file()
    assert read_matrix(out / "experiment.yaml").seeds == [2, 1]


def test_lost_and_broken_results_are_made_again(stage, tmp_path):
    """They come from another evaluation, not from another training; nothing else is touched."""
    file, out = write(tmp_path / "m.yaml", SMALL), tmp_path / "out"
    words = [file, f"--out={out}", "--device=cpu"]
    assert experiment_here(*words, tmp_path=tmp_path)[0] == 0
    before = contents(out)
    lost, broken = out / "a1_position-low-s1" / "result_high.json", out / "a1_torque-low-s1" / "result_low.json"
    lost.unlink()
    broken.write_text('{"half": ')
    status, output, error = experiment_here(*words, tmp_path=tmp_path)
    assert (status, error) == (0, "") and output.count(" took ") == 2 and len(trained(stage)) == 2
    assert json.loads(lost.read_text())["perturbation"] == "high"
    assert json.loads(broken.read_text())["perturbation"] == "low"
    changed = {path.name for path, state in contents(out).items() if before.get(path) != state}
    cells = {lost.parent.name, broken.parent.name}
    assert changed == {"result_high.json", "result_low.json", "evaluate.log", "times.json", *cells}


def test_what_a_training_has_measured_is_not_evaluated_again(stage, tmp_path):
    """Trainings measure in all environments of their cells; only where none did, a process evaluates."""
    file, out = write(tmp_path / "m.yaml", SMALL | {"tasks": ["a1_torque"]}), tmp_path / "out"
    words = [file, f"--out={out}", "--device=cpu"]
    (stage / "behaviour").write_text("measure evaluations.csv evaluations_high.csv")
    status, output, error = experiment_here(*words, tmp_path=tmp_path)
    assert (status, error) == (0, "") and "1 of 1 cells are done" in output and "evaluation in" not in output
    assert not list(out.glob("*/result*"))
    assert "'--set=evaluation.also=[\"high\"]'" in next(out.glob("*/train.log")).read_text()
    next(out.glob("*/*/evaluations_high.csv")).write_text("steps\n")  # the disk was full
    assert experiment_here(*words, "--dry-run", tmp_path=tmp_path)[1] == "a1_torque-low-s1: evaluate in high\n"
    (checkpoint,) = out.glob("*/*/model_4.pt")
    checkpoint.rename(checkpoint.with_name("model_3.pt"))  # a training that is not whole has measured nothing for good
    listed = experiment_here(*words, "--dry-run", tmp_path=tmp_path)[1]
    assert listed == "a1_torque-low-s1: resume after 3 of 4 iterations, evaluate in low, high\n"


def test_tiles_are_crossed_after_training(stage, tmp_path):
    """That, a sweep and a condition are steps of their own, done again alone; other tiles are refused."""
    values = SMALL | {"tasks": ["a1_torque"], "grounds": {"kinds": ["flat", "pits"], "levels": [0, 0.5]}}
    values["sweeps"] = {"ground_friction": {"domain_rand.ground_friction": {"set": [0.4, 1.2]}}}
    values["conditions"] = {"late": {"motors.delay.range": [2, 2]}}
    file, out = write(tmp_path / "m.yaml", values), tmp_path / "out"
    words = [file, f"--out={out}", "--device=cpu"]
    (stage / "behaviour").write_text("measure evaluations.csv evaluations_high.csv")
    assert experiment_here(*words, tmp_path=tmp_path)[0] == 0
    cell = out / "a1_torque-low-s1"
    log, result = (cell / "evaluate.log").read_text().splitlines()[0], cell / "grounds.json"
    assert " --num_envs=40 --terrain flat pits --level 0.0 0.5 " in log and "--perturbation" not in log
    assert json.loads(result.read_text())["experiment_name"] == cell.name and not list(cell.glob("*.part"))
    swept = json.loads((cell / "sweep_ground_friction.json").read_text())  # test_sweep.py gives it to the script
    assert (swept["sweep"], swept["perturbation"]) == ("ground_friction", "none")
    assert swept["set"].startswith("domain_rand.ground_friction=")
    late = json.loads((cell / "condition_late.json").read_text())
    assert (late["perturbation"], late["set"]) == ("none", "motors.delay.range=[2, 2]") and "sweep" not in late
    result.unlink()
    listed = experiment_here(*words, "--dry-run", tmp_path=tmp_path)[1]
    assert listed == "a1_torque-low-s1: evaluate in rough ground\n"
    assert experiment_here(*words, tmp_path=tmp_path)[0] == 0
    assert result.is_file() and len(trained(stage)) == 1
    write(file, values | {"grounds": {"kinds": ["flat"], "levels": [0, 0.5]}})
    message = "grounds.kinds is ['flat'], was ['flat', 'pits']; give another --out"
    assert_told_in_one_line(experiment_here(*words, tmp_path=tmp_path), message)


def test_results_of_another_training_are_not_kept(stage, tmp_path):
    """If the runs are gone and a result is missing, all results come from the new training."""
    file, out = write(tmp_path / "m.yaml", SMALL | {"tasks": ["a1_torque"]}), tmp_path / "out"
    (out / "a1_torque-low-s1").mkdir(parents=True)
    (out / "a1_torque-low-s1" / "result_low.json").write_text("{}")
    assert experiment_here(file, f"--out={out}", "--device=cpu", tmp_path=tmp_path)[0] == 0
    assert json.loads((out / "a1_torque-low-s1" / "result_low.json").read_text())["perturbation"] == "low"


@pytest.fixture
def places(stage, tmp_path, monkeypatch):
    """Start evaluations of a launcher: their devices, and the variables by which they see one GPU and some cores."""
    names = ("CUDA_VISIBLE_DEVICES", "OMP_NUM_THREADS")
    shown = f"import os; print('{{}} {{}}\\n'.format(*map(os.environ.get, {names})), end='')"  # in one piece
    (stage / "evaluate.py").write_text(shown + "\nwhile not os.path.exists('ended'): pass")
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(12)), raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 64)  # of which others have the rest
    monkeypatch.chdir(tmp_path)
    matrix = read_matrix(write(tmp_path / "m.yaml", SMALL))

    def start(launcher, count):
        """Start some, and let them end when all are there."""
        (cell, *_), log = matrix.cells(tmp_path), tmp_path / "log"
        Path("ended").unlink(missing_ok=True)
        with log.open("wb") as output, (tmp_path / "lock").open("wb") as lock:
            state = CellState(4, 4, ["low"])
            processes = [launcher.start(matrix, cell, state, output, lock) for _ in range(count)]
        Path("ended").touch()
        assert [process.wait() for process in processes] == [0] * count
        return [process.place for process in processes], log.read_text().split()

    return start


def test_devices(places, monkeypatch):
    """A step goes where the fewest are, sees that GPU only, and shares the cores with the others."""
    cpu = LocalLauncher("auto", 3)
    assert (cpu.device, cpu.room(), places(cpu, 2)) == ("cpu", 3, (["cpu"] * 2, ["None", "4"] * 2))
    assert LocalLauncher("cpu", None).room() == 1
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    for visible, names in {None: "01", "3,5": "35"}.items():
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible) if visible else None
        launcher = LocalLauncher("auto", 2)
        where, variables = places(launcher, 4)
        assert (launcher.device, launcher.room()) == ("cuda:0", 4) and where == ["cuda:0", "cuda:1"] * 2
        assert sorted(variables[::2]) == sorted(names * 2) and variables[1::2] == ["3"] * 4
    assert places(LocalLauncher("cuda:1", 1), 1) == (["cuda:1"], ["5", "None"])
    assert LocalLauncher("auto", None).room() == 2 * GPU_JOBS


@pytest.fixture
def program(tmp_path, monkeypatch):
    """A program that notes arguments, input, folder and devices, and may refuse; returns where it notes them."""
    notes, file = tmp_path / "notes", tmp_path / MPS
    noted = '$*|$([ "$1" ] || cat)|$CUDA_MPS_PIPE_DIRECTORY|$CUDA_VISIBLE_DEVICES'
    stays = f'[ "$1" ] && {{ sleep 60 & echo $! > {notes}.pid; }}'  # with its output open, as a service does
    file.write_text(f'#!/bin/sh\necho "{noted}" >> {notes}\n{stays}\necho "it is $1"\n[ ! -e {notes}.no ]\n')
    file.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    yield notes
    os.kill(int(notes.with_name("notes.pid").read_text()), signal.SIGKILL)  # fails if it was waited for


def test_mps(program, monkeypatch):
    """It runs with a folder of its own while the context is open, also when that ends by an error, and no longer."""
    monkeypatch.setenv("CUDA_MPS_PIPE_DIRECTORY", "/mine")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,3")  # would be 0, 1 to programs that use the service
    before = dict(os.environ)
    with pytest.raises(KeyError), multi_process_service() as variables:
        (folder,) = set(variables.values())
        assert variables.keys() == {"CUDA_MPS_PIPE_DIRECTORY", "CUDA_MPS_LOG_DIRECTORY"}
        assert os.path.isdir(folder) and program.read_text() == f"-d||{folder}|\n"
        raise KeyError
    assert program.read_text().splitlines()[1:] == [f"|quit|{folder}|"]
    assert dict(os.environ) == before and not os.path.exists(folder)


def test_mps_that_refuses(program):
    """Its words are the error, and the work is not begun."""
    program.with_name("notes.no").touch()
    with pytest.raises(UserError, match=f"--mps: {MPS} says: it is -d"), multi_process_service():
        raise AssertionError("the service has not started")
