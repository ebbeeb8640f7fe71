"""Exports of random policies, for tests; importing this skips a module where the extra is not installed."""

import pytest
import torch

for package in ("onnx", "onnxruntime", "jsonschema"):
    pytest.importorskip(package, reason=f"{package} is not installed: pip install -e .[export]")

from legged_torque import RESOURCES_DIR
from legged_torque.deploy.export import export_policy
from legged_torque.envs import task_registry

XML = RESOURCES_DIR / "robots/a1/a1.xml"
TRAINING = {"run": "run", "checkpoint": "model_7.pt", "iterations": 7, "total_steps": 20_000_000}


def export_random(make_task, name, folder, normalization=False, supported=True, groups=("policy",), **overrides):
    """Export a small random network of a task after 20 million steps; return the task and the model.

    ``supported`` says whether ``policy.yaml`` can describe all of the task; ``groups`` are those that the actor reads.
    """
    task = make_task(name, num_envs=3, **overrides)
    task.load_state_dict({"total_steps": torch.tensor(TRAINING["total_steps"]), "num_diverged": torch.tensor(0)})
    _, train_cfg = task_registry.get_cfgs(name)

    class Normalizing(type(train_cfg.actor)):
        obs_normalization: bool = normalization

    train_cfg.actor = Normalizing()
    train_cfg.actor.hidden_dims, train_cfg.obs_groups.actor = [16, 16], list(groups)
    torch.manual_seed(3)
    runner, _ = task_registry.make_alg_runner(task, name, train_cfg=train_cfg, log_root=None)
    model = runner.alg.policy()
    if normalization:
        model.obs_normalizer._mean.normal_()
        model.obs_normalizer._std.uniform_(0.5, 2.0)
    model.eval()
    difference, unsupported = export_policy(task, model, folder, name, TRAINING)
    assert difference < 1e-5
    assert supported == (not unsupported), unsupported
    return task, model


def change(path, value):
    """A change of one entry by its dotted path; None deletes it."""

    def apply(description):
        *parents, last = [int(key) if key.isdigit() else key for key in path.split(".")]
        for key in parents:
            description = description[key]
        if value is None:
            del description[last]
        else:
            description[last] = value

    return apply
