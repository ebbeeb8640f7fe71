"""Trainings in the cloud, by wandb's own client: up to a stand-in for its server, and down from there."""

import functools
import json
import sys

import pytest
import wandb
import yaml
from support import hub
from support.scripts import SMALL, assert_told_in_one_line, run_here

from legged_torque.envs import task_registry
from legged_torque.utils.options import Options
from legged_torque.utils.runs import load_config
from legged_torque.viewer.training_viewer import TrainingViewer

POLICY, VIDEO = "wandb:me/p/first", b"of the last checkpoint"
RUN = {"id": "1", "tags": [], "state": "finished", "projectId": "1", "project": {"name": "p", "entity": {"name": "me"}}}
RUN |= {"user": {}, **dict.fromkeys(["config", "systemMetrics", "summaryMetrics"], "{}")}
RUN |= dict.fromkeys(["group", "jobType", "sweepName", "commit", "notes", "description", "historyKeys"])


class Server(hub.Handler):
    """What the client of wandb 0.31 asks for. Keeps the files of each run in memory: ``server.models[run][name]``."""

    def do_POST(self):  # noqa: N802 (http.server's name)
        """Answer the queries of GraphQL that matter; curves, texts and telemetry are dropped."""
        body = self.rfile.read(int(self.headers["Content-Length"] or 0))
        asked = json.loads(body) if self.path == "/graphql" else {"query": ""}
        values, files = asked.get("variables") or {}, {}
        if name := values.get("run") or values.get("name"):
            files = dict.fromkeys(values.get("files", []), b"") or self.server.models.get(name, {})
        nodes = [{"name": file, "sizeBytes": len(content)} for file, content in files.items()]
        for node in nodes:
            node["url"] = node["uploadUrl"] = f"{self.server.address}/{name}/{node['name']}"
        run = RUN | {"name": name, "displayName": name, "files": {"edges": [{"node": node} for node in nodes]}}
        answers = {
            "viewer {": {"viewer": {"id": "1", "entity": "me", "username": "me", "teams": {"edges": []}}},
            "mutation UpsertBucket": {"upsertBucket": {"bucket": run, "inserted": True}},
            "mutation CreateRunFiles": {"createRunFiles": {"runID": "1", "uploadHeaders": [], "files": nodes}},
            "query Run": {"project": {"run": run if files else None}},
        }
        self._answer({"data": next((answer for part, answer in answers.items() if part in asked["query"]), {})})

    def do_PUT(self):  # noqa: N802
        _, run, name = self.path.split("/", 2)
        self.server.models.setdefault(run, {})[name] = self.rfile.read(int(self.headers["Content-Length"]))
        self._answer({})

    def do_GET(self):  # noqa: N802
        _, run, name = self.path.split("/", 2)
        self._answer(self.server.models[run][name])


@pytest.fixture
def server(tmp_path, monkeypatch):
    """The stand-in, and a client that finds it."""
    with hub.running(Server) as running:
        variables = {"BASE_URL": running.address, "API_KEY": 40 * "a", "RUN_ID": "first", "CACHE_DIR": tmp_path / "c"}
        for name, value in variables.items():
            monkeypatch.setenv(f"WANDB_{name}", str(value))
        monkeypatch.setenv("HOME", str(tmp_path))  # which may have a key
        monkeypatch.setattr(wandb.Api, "_HTTP_TIMEOUT", 2)
        wandb.teardown()  # what it remembers of another server
        yield running
        wandb.teardown()


def test_up_and_down(server, tmp_path, tmp_path_factory, monkeypatch):
    """Settings, checkpoints and the last video go up; elsewhere the run is played."""

    def close(self, is_waiting):
        (folder,) = tmp_path.glob("logs/*/*_up")
        (folder / "last.mp4").write_bytes(VIDEO)

    monkeypatch.setattr(TrainingViewer, "close", close)
    assert run_here("train.py", *SMALL, "--logger=wandb", "--run_name=up", root=tmp_path)[0] == 0
    (run,), files = tmp_path.glob("logs/*/*_up"), server.models["first"]
    assert [content for name, content in files.items() if name.endswith(".mp4")] == [VIDEO]
    own = yaml.safe_load(files["config.yaml"])  # wandb's, of values
    assert own["env_cfg"]["value"]["env"]["num_envs"] == 2 and own["train_cfg"]["value"]["num_steps_per_env"] == 4
    script = functools.partial(run_here, root=tmp_path_factory.mktemp("elsewhere"))
    play = functools.partial(script, "play.py", f"--policy={POLICY}", "--device=cpu", "--num_envs=2", "--no_video")
    assert "track_percentage" in play("--steps=2")[1]
    for number, checkpoint in ((2, None), (0, 0)):
        loaded = task_registry.load_run(Options(task=None, policy=POLICY, checkpoint=checkpoint))
        assert loaded.checkpoint.read_bytes() == (run / f"model_{number}.pt").read_bytes()
        assert loaded.config == load_config(run)
    assert_told_in_one_line(play("--checkpoint=1"), "unknown checkpoint '1'; allowed: 0, 2")
    server.models["first"] = {"../config.yaml": b"", "../model_1.pt": b""}
    assert_told_in_one_line(play(), "Invalid path: '../config.yaml'")
    server.models["first"] = {"model_1.pt": b""}
    assert_told_in_one_line(play(), "it holds no settings and checkpoint")
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert_told_in_one_line(play(), "wandb is not installed; this needs the extra: pip install 'legged_torque[wandb]'")


@pytest.mark.parametrize(
    ("variable", "words", "expected"),
    [
        ("X=", ["play.py", "--policy=wandb:me/p/none"], "run 'wandb:me/p/none': Could not find run"),
        ("X=", ["play.py", "--policy=wandb:me/../first"], "it must be wandb:entity/project/run"),
        ("WANDB_API_KEY=", ["play.py", f"--policy={POLICY}"], "No API key configured"),
        ("WANDB_API_KEY=", ["train.py", *SMALL, "--logger=wandb"], "--logger wandb: No API key configured"),
        ("WANDB_BASE_URL=http://127.0.0.1:9", ["play.py", f"--policy={POLICY}"], "the run 'wandb:me/p/first': "),
    ],
)
def test_mistakes(server, tmp_path, monkeypatch, variable, words, expected):
    """No such run, no such name, no key, no network: one line."""
    monkeypatch.setenv(*variable.split("="))
    assert_told_in_one_line(run_here(*words, root=tmp_path), expected)
