"""Policies that others publish: up to a stand-in for the Hugging Face Hub, and down from there."""

import functools
import runpy
import shlex
import shutil
from pathlib import Path

import pytest
import yaml
from huggingface_hub import constants
from support import hub
from support.scripts import ROOT, assert_told_in_one_line, run_here
from support.settings import error_of

from legged_torque.deploy import simulation
from legged_torque.deploy.policy import Policy
from legged_torque.envs import task_registry
from legged_torque.utils import devices
from legged_torque.utils.options import Options
from legged_torque.utils.policies import policy_dir
from legged_torque.utils.runs import load_config

FILES = {"README.md", "card.yaml", "config.yaml", "index.html", "model_1119.pt", "page.json"}
FILES |= {"policy.onnx", "policy.yaml"}


@pytest.fixture(scope="module")
def server():
    """The stand-in."""
    with hub.running() as running:
        yield running


@pytest.fixture
def script(server, tmp_path, monkeypatch):
    """Runs a script that takes the stand-in for the Hub."""
    files = f"{server.address}/{{repo_id}}/resolve/{{revision}}/{{filename}}"
    patched = {"ENDPOINT": server.address, "HUGGINGFACE_CO_URL_TEMPLATE": files}
    patched |= {"HF_HUB_CACHE": str(tmp_path / "cache")}
    for name, value in patched.items():
        monkeypatch.setattr(constants, name, value)
    monkeypatch.setenv("HF_TOKEN", "hf_none")
    monkeypatch.setattr(devices, "choose_offscreen_renderer", lambda: "no video, it takes long")
    (tmp_path / "here").mkdir()
    return functools.partial(run_here, root=tmp_path / "here")


def test_up_and_down(script, server):
    """What was published is played, and a file that is not the one of the card is refused."""
    status, output, errors = script("publish.py", "a1/position", "--push", "me/a1")
    assert status == 0 and f"Uploaded to {server.address}/me/a1" in output, errors
    model = server.models["me/a1"]
    assert {*model} >= FILES
    front = yaml.safe_load(model["README.md"].decode().split("---")[1])
    assert front["library_name"] == "legged_torque" and "tracking" in model["README.md"].decode()
    assert model["policy.onnx"] == (policy_dir("a1/position") / "policy.onnx").read_bytes()
    few = ["--robots=1", "--steps=2"]
    assert script("sim2sim.py", "hf:me/a1", *few)[0] == 0
    assert task_registry.load_run(Options(task=None, policy="hf:me/a1")).checkpoint.name == "model_1119.pt"
    server.models["me/other"] = model | {"policy.onnx": model["policy.onnx"] + b" "}
    status, _, errors = script("sim2sim.py", "hf:me/other", *few)
    assert status == 2 and errors.endswith("policy.onnx' is not the file that card.yaml describes\n")


def test_a_run_of_this_machine(tmp_path):
    """Its folders are not published: neither in settings nor in its command, of which all else stays."""
    source, run, home = policy_dir("a1/position"), tmp_path / "run", "/home/some one"
    for folder in (run / "exported", tmp_path / "out"):
        folder.mkdir(parents=True)
    shutil.copy(source / "policy.onnx", run / "exported")
    shutil.copy(source / "model_1119.pt", run)
    config = yaml.safe_load((source / "config.yaml").read_text())
    config["env"]["asset"]["file"], config["train"]["distillation"] = f"{home}/a1.xml", {"teachers": [f"{home}/a.pt"]}
    words = ["train.py", "--task", "a1_position", f"--log_root={home}/logs", "--task_file", f"{home}/mine.py"]
    words += ["--set", f"distillation.teachers=[{home}/a, '{Path.cwd()}/here/b']", "--set=sim.dt=1/2"]
    with (run / "config.yaml").open("w") as file:
        yaml.safe_dump(config | {"command": shlex.join(words)}, file, explicit_start=True, explicit_end=True)
    copy_policy = runpy.run_path(str(ROOT / "scripts" / "publish.py"))["copy_policy"]
    card = copy_policy(run / "exported" / "policy.onnx", tmp_path / "out", Policy("a1/position").description)
    command = ["train.py", "--task", "a1_position", "--log_root=logs", "--task_file", "mine.py"]
    command += ["--set", "distillation.teachers=[a, 'here/b']", "--set=sim.dt=1/2"]
    assert shlex.split(card["trained"]) == command
    config["env"]["asset"]["file"], config["train"]["distillation"] = "a1.xml", {"teachers": ["a.pt"]}
    assert load_config(tmp_path / "out") == config | {"command": card["trained"]}
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"config.yaml", "model_1119.pt", "policy.onnx"}


@pytest.mark.parametrize(
    "card", ["", "- 1", "files: {}", "files: 3", "files: {/dev/zero: 0}", "files: {../x: 0}", "a: ["]
)
def test_cards_of_strangers(script, server, card):
    """A card that is none is refused, and reads no file elsewhere."""
    server.models["me/odd"] = {"card.yaml": card.encode(), "policy.yaml": b"", "policy.onnx": b""}
    status, _, errors = script("sim2sim.py", "hf:me/odd")
    (line,) = [line for line in errors.splitlines() if "error: " in line]
    assert status == 2 and ("does not list the files" in line or "is not valid YAML" in line)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["sim2sim.py", "hf:me/none"], "cannot download the policy 'hf:me/none': 404"),
        (["sim2sim.py", "hf:none"], "cannot download the policy 'hf:none': "),
        (["publish.py", "a1/positoin"], "a1/position"),
        (["publish.py", "a1/position", "--out=."], "'.' exists"),
        (["publish.py", "a1/position", "--push=bad name"], "cannot upload to 'bad name': Repo id must"),
    ],
)
def test_mistakes(script, tmp_path, words, expected):
    """One line, status 2, and nothing written."""
    assert_told_in_one_line(script(*words), expected)
    assert not [*(tmp_path / "here").iterdir()]


def test_an_export_in_the_folder_of_the_command(script, tmp_path):
    """It is published by the name of its file alone."""
    shutil.copytree(policy_dir("a1/position"), tmp_path / "here", dirs_exist_ok=True)
    status, _, errors = script("publish.py", "policy.onnx", "--out=../out")
    assert status == 0 and {path.name for path in (tmp_path / "out").iterdir()} >= FILES, errors


def test_cards_that_lack_something(script, tmp_path, monkeypatch):
    """They are refused in a line, before anything is simulated; what they have beyond that does no harm."""
    write_cards = runpy.run_path(str(ROOT / "scripts" / "publish.py"))["write_cards"]
    shutil.copytree(policy_dir("a1/position"), folder := tmp_path / "here" / "mine")
    card = yaml.safe_load((folder / "card.yaml").read_text())
    write_cards(folder, card | {"names": "x", "rows": 3, "license_line": []})
    metrics = {name: [1.0, 0.1] for name in ("track_percentage", "falls_per_minute", "cost_of_transport")}
    wrong = [{"steps": "many"}, {"policy": 3}, {"task": None}, {"license": 3}, {"metrics": None}]
    wrong += [{"metrics": {"low": metrics | {"falls_per_minute": value}}} for value in ([1.0], 1.0, ["a", "b"])]
    for change in wrong:
        assert "must have policy, task, steps, and in metrics" in error_of(write_cards, folder, card | change)
    del card["steps"]
    (folder / "card.yaml").write_text(yaml.safe_dump(card))
    monkeypatch.setattr(simulation, "evaluate", lambda *_: pytest.fail("it is simulated"))
    assert_told_in_one_line(script("publish.py", "mine"), "(KeyError: 'steps')")
    assert [path.name for path in (tmp_path / "here").iterdir()] == ["mine"]


def test_no_network(script, monkeypatch):
    """Neither the Hub nor a copy of the policy is there."""
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    assert_told_in_one_line(script("sim2sim.py", "hf:me/first"), "cannot download the policy 'hf:me/first': ")
