"""Experiments on a Ray cluster of two machines, here two nodes on one, with small stand-ins for the scripts."""

import contextlib
import io
import json
import os
import shutil
import signal
import threading
from pathlib import Path

import pytest
import torch
from support.experiments import SMALL, experiment_here, order, wait_for, write, write_scripts
from support.scripts import ROOT, assert_told_in_one_line
from support.settings import error_of

ray = pytest.importorskip("ray", reason="needs the extra: pip install -e .[ray]")

import legged_torque
from legged_torque.experiments import matrix, ray_launcher
from legged_torque.experiments.ray_node import Report, new_files, write_files

FAST = {
    "worker_niceness": 0,  # by default they wait for all other tests
    "health_check_initial_delay_ms": 0,
    "health_check_period_ms": 200,
    "health_check_timeout_ms": 60_000,  # for an answer: a machine that is just slow is not gone
    "health_check_failure_threshold": 2,
}
"""Settings by which Ray soon notices that a machine is gone, since nothing answers there, and does not yield."""


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    """A copy of the package, which the machines use, with stand-ins for the scripts."""
    stage = tmp_path_factory.mktemp("stage")
    shutil.copytree(ROOT / "legged_torque", stage / "legged_torque", ignore=shutil.ignore_patterns("__pycache__"))
    write_scripts(stage / "scripts")
    return stage


@pytest.fixture(scope="module")
def cluster(stage):
    """A cluster of two machines with a core each, and a head without one."""
    from ray.cluster_utils import Cluster

    handler = signal.getsignal(signal.SIGTERM)  # which Ray replaces
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_AUTH_MODE", "disabled")  # which would write a token into the home folder
        patch.setenv("RAY_TQDM_PATCH_PRINT", "0")  # which would stay in this process
        patch.setenv("PYTHONPATH", str(stage))
        head = {"num_cpus": 0, "include_dashboard": False, "_system_config": FAST}
        cluster = Cluster(initialize_head=True, head_node_args=head)
        for _ in range(2):
            cluster.add_node(num_cpus=1)
        yield cluster
        ray.shutdown()
        cluster.shutdown()
        signal.signal(signal.SIGTERM, handler)


@pytest.fixture
def here(stage, cluster, monkeypatch, tmp_path):
    """Run an experiment of two cells on the cluster, with the stand-ins."""
    monkeypatch.setattr(matrix, "SCRIPTS_DIR", stage / "scripts")
    monkeypatch.setattr(legged_torque, "SCRIPTS_DIR", stage / "scripts")
    monkeypatch.setattr(ray_launcher, "SEND_EVERY", 0.0)
    (stage / "scripts" / "order").write_text("")
    file = write(tmp_path / "m.yaml", SMALL | {"environments": {"low": ["low"]}})
    words = [file, f"--out={tmp_path / 'out'}", "--device=cpu", "--launcher=ray", f"--address={cluster.address}"]
    return lambda *more: experiment_here(*words, *more, tmp_path=tmp_path)


def node_of(cluster, process):
    """The node that a process, started by one of its own, belongs to."""
    nodes = {node.all_processes["raylet"][0].process.pid: node for node in cluster.worker_nodes}
    while process not in nodes:
        process = int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1])
    return nodes[process]


def during(stage, out, act):
    """Do something when both trainings wait in their third iteration and have sent a checkpoint."""
    (stage / "scripts" / "behaviour").write_text("slow")

    def wait_and_act():
        """Wait, in a thread of its own."""
        try:
            wait_for(lambda: len(list(out.glob("*/run_0/model_2.pt"))) == 2, 120)
            act()
        except BaseException:
            (stage / "scripts" / "behaviour").write_text("")  # they would wait forever
            raise

    thread = threading.Thread(target=wait_and_act)
    thread.start()
    return thread


def test_stop(here, stage, tmp_path):
    """Trainings save, their checkpoints come home, and the next call goes on from there."""
    out = tmp_path / "out"
    thread = during(stage, out, lambda: os.kill(os.getpid(), signal.SIGTERM))
    status, output, error = here()
    thread.join()
    assert (status, error) == (143, "interrupted\n"), output
    assert [(cell / "run_0" / "model_3.pt").is_file() for cell in out.glob("*-s1")] == [True] * 2
    (stage / "scripts" / "behaviour").write_text("")
    status, output, error = here()
    assert (status, error) == (0, "") and output.endswith("2 of 2 cells are done.\n")
    assert sorted(done for _, done, _ in order(stage / "scripts")) == ["0", "0", "3", "3"]


def test_a_machine_is_killed(here, stage, cluster, tmp_path):
    """The training that it ran goes on elsewhere from its last checkpoint; nothing else is done again."""
    out, lost = tmp_path / "out", SMALL["tasks"][0] + "-low-s1"

    def kill():
        """Kill the machine of the first cell; let the other go on."""
        (process,) = (int(process) for cell, _, process in order(stage / "scripts") if cell == lost)
        cluster.remove_node(node_of(cluster, process), allow_graceful=False)
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)  # all that runs on a machine goes with it
        (stage / "scripts" / "behaviour").write_text("")

    thread = during(stage, out, kill)
    status, output, error = here()
    thread.join()
    assert (status, error) == (0, ""), output + error
    assert f"{lost}: the machine was lost during training; it will be tried again | " in output
    trained = [(cell, done) for cell, done, _ in order(stage / "scripts")]
    other = SMALL["tasks"][1] + "-low-s1"
    assert sorted(trained) == [(lost, "0"), (lost, "2"), (other, "0")]
    for cell in (lost, other):
        result = json.loads((out / cell / "result_low.json").read_text())
        assert (result["experiment_name"], result["perturbation"]) == (cell, "low")
        assert (out / cell / ("run_1" if cell == lost else "run_0") / "model_4.pt").is_file()
        assert json.loads((out / cell / "times.json").read_text())["seconds"]["cpu training"] > 0.0
    names = {path.name for cell in (lost, other) for path in (out / cell).iterdir()}
    assert names == {"run_0", "run_1", "lock", "train.log", "evaluate.log", "times.json", "result_low.json"}


def test_other_code_is_refused(here, monkeypatch, tmp_path):
    """A machine with other code than this one's is named, and nothing is trained."""
    monkeypatch.setattr(legged_torque, "SCRIPTS_DIR", ROOT / "scripts")
    assert_told_in_one_line(here(), "code of legged_torque")
    assert not list(tmp_path.glob("out/*/run_*"))


def test_mistakes(here, tmp_path):
    """They are refused in one line."""
    assert_told_in_one_line(here("--jobs=2"), "--jobs is for GPUs on a cluster")
    assert_told_in_one_line(here("--device=cuda:0"), "--device must be auto, cuda or cpu, not 'cuda:0'")
    assert_told_in_one_line(here("--device=cuda"), "has no GPU")
    assert_told_in_one_line(here("--launcher=slurm"), "unknown launcher 'slurm'")
    assert_told_in_one_line(here("--launcher=local"), "--address is that of a Ray cluster")
    assert_told_in_one_line(here("--address=nowhere"), "--address must be auto or HOST:PORT, not 'nowhere'")
    assert_told_in_one_line(here("--address=127.0.0.1:1"), "there is no Ray cluster at address '127.0.0.1:1'")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["../x", "/tmp/x", "a/../../x", "", "a\0b"])
def test_files_stay_in_their_folder(name, tmp_path):
    """What a machine sends is written below the folder of the results, or not at all."""
    folder = tmp_path / "out"
    assert "would be written to" in error_of(write_files, folder, {"good": b"1", name: b"2"})
    assert not list(tmp_path.iterdir())


def test_what_a_machine_sends(tmp_path):
    """Files are sent when they are whole, even if they have been written before the last report, and once."""
    (tmp_path / "config.yaml").write_bytes(b"1")
    part, sent = tmp_path / "model_2.pt.17.part", {}
    part.write_bytes(b"2")
    assert new_files(tmp_path, sent) == {"config.yaml": b"1"}
    part.rename(tmp_path / "model_2.pt")
    assert new_files(tmp_path, sent) == {"model_2.pt": b"2"}
    assert new_files(tmp_path, sent) == {}
    (tmp_path / "config.yaml").write_bytes(b"10")
    assert new_files(tmp_path, sent) == {"config.yaml": b"10"}


def test_worlds_that_come_home_stay(tmp_path):
    """Of a report with several checkpoints, the worlds of the newest one are kept, and those before it go."""
    cell, data = matrix.Cell(tmp_path / "out" / "a-s1", "a1_torque", "low", 1, ()), io.BytesIO()
    torch.save({}, data)
    process = ray_launcher.RayProcess(None, None, cell, tmp_path / "log")
    for names in (("model_50", "worlds_50"), ("model_150", "model_100", "worlds_150"), ("model_120", "worlds_200")):
        files = {f"a-s1/run_0/{name}.pt": data.getvalue() for name in names}
        process._take(Report("a machine", files=files))
    left = {file.stem for file in (cell.folder / "run_0").iterdir()}
    assert left == {"model_50", "model_100", "model_120", "model_150", "worlds_150", "worlds_200"}
