"""Equivariant networks against mirror images by hand, and against learning from images."""

import pytest
import torch
from rsl_rl.models import MLPModel
from support.control import mirror_joints, mirror_policy
from support.rollouts import parameters, record_rollout
from support.settings import build_runner, error_of
from support.wide_ppo import MIRROR, Mirrored, build, choose, mirrored
from tensordict import TensorDict

from legged_torque.envs import task_registry
from legged_torque.envs.base.symmetry import Mirror
from legged_torque.learning.equivariance import MirroredWeights, are_known
from legged_torque.learning.ppo import OnDevicePPO
from legged_torque.learning.ppo.cpu_ppo import CpuPPO
from legged_torque.utils.config import to_dict
from legged_torque.utils.errors import UserError
from legged_torque.utils.mirroring import SCALAR, Mirroring

SYMMETRY = "algorithm.symmetry_cfg."
SMALL = {"actor.hidden_dims": [15, 8], "critic.hidden_dims": [9], "runner.logger": "none"}
ODD = {"sizes": ([9, 12], [7])}


@pytest.mark.parametrize("name", ["a1_torque", "a1_torque_multihead"])
def test_actions_are_mirrored(make_task, name):
    """After updates, those of a mirrored A1 are mirrored, and its state is worth the same."""
    runner = build_runner(make_task, name, **SMALL)
    actor, critic, task = runner.alg.actor, runner.alg.critic, runner.env
    before = {name: value.clone() for name, value in parameters(runner.alg).items()}
    runner.learn(3)
    assert runner.alg.symmetry is None
    assert all(not torch.equal(before[name], value) for name, value in parameters(runner.alg).items())
    obs = torch.randn(20, task.get_observations()["policy"].shape[1])
    actions, images = (actor(TensorDict({"policy": values}, [20])) for values in (obs, mirror_policy(obs)))
    torch.testing.assert_close(images, mirror_joints(actions), rtol=1e-4, atol=1e-5)
    assert (images - actions).abs().max() > 0.01
    seen = torch.randn(20, task.get_observations()["critic"].shape[1])
    values, images = (critic(TensorDict({"critic": part}, [20])) for part in (seen, task.mirror("critic", seen)))
    torch.testing.assert_close(images, values, rtol=1e-4, atol=1e-5)
    assert values.std() > 0.01


@pytest.mark.parametrize("kind", [OnDevicePPO, CpuPPO])
@pytest.mark.parametrize("multi_head", [False, True])
def test_the_same_is_learned_from_half_of_the_samples(kind, multi_head):
    """The gradient is that of learning from mirror images as well, also with an odd number of hidden units."""
    settings = {"multi_head": multi_head, "max_grad_norm": 1e9, "entropy_coef": 0.1, **ODD}
    alg, plain = build(kind, symmetric="networks", **settings), build(OnDevicePPO, symmetric="images", **settings)
    for own, other in zip(parameters(alg).values(), parameters(plain).values(), strict=True):
        other.copy_(own)
    record_rollout(alg)
    record_rollout(plain)
    assert torch.equal(plain.storage.actions, alg.storage.actions)
    with torch.no_grad():  # a policy that has moved since it acted
        for one in (alg, plain):
            one.actor.mlp.position_head[-1].weight.mul_(1.5) if multi_head else one.actor.mlp[-1].weight.mul_(1.5)
    choose([alg, plain], 0)
    alg.update_minibatch()
    plain.update_minibatch()
    assert plain.symmetry and not alg.symmetry
    for own, other in zip(alg._parameters, plain._parameters, strict=True):
        torch.testing.assert_close(own.grad, other.grad, rtol=1e-3, atol=1e-5 * float(other.grad.abs().max()) + 1e-7)
    torch.testing.assert_close(alg.losses, plain.losses, rtol=1e-4, atol=1e-5)


def test_they_stay_equivariant():
    """After many steps of Adam; initial weights have the usual spread."""
    alg, drawn = build(OnDevicePPO, symmetric="networks", **ODD), build(OnDevicePPO, **ODD)
    spread, expected = (float(one.actor.mlp[0].weight.detach().std()) for one in (alg, drawn))
    assert spread == pytest.approx(expected, rel=0.2)
    record_rollout(alg)
    for number in range(100):
        choose([alg], number)
        alg.update_minibatch()
    obs = TensorDict({name: torch.randn(30, len(MIRROR[name][0])) for name in ("policy", "critic")}, [30])
    images = TensorDict({name: mirrored(name, values) for name, values in obs.items()}, [30])
    torch.testing.assert_close(alg.actor(images), mirrored("actions", alg.actor(obs)), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(alg.critic(images), alg.critic(obs), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("part", ["actor", "critic"])
def test_networks_of_a_user(part):
    """Only of known classes one knows what the mirror images of their weights are."""
    alg = build(OnDevicePPO)
    assert are_known(alg.actor, alg.critic)
    getattr(alg, part).__class__ = type("Own", (MLPModel,), {})
    assert not are_known(alg.actor, alg.critic)


class Own(OnDevicePPO):
    """A PPO of a user, which may take other gradient steps."""


def test_mirror_images_that_have_no_weights():
    """Those of positions may not be torques of a multi-head actor, and mirroring twice changes nothing."""
    alg, maps = build(OnDevicePPO, multi_head=True), Mirrored("cpu").maps
    assert len(MirroredWeights(alg.actor, alg.critic, maps).order) == sum(map(torch.numel, alg._parameters))
    maps["actions"] = torch.tensor([3, 4, 5, 0, 1, 2]), torch.ones(6)
    with pytest.raises(UserError, match="the mirror images of positions are torques"):
        MirroredWeights(alg.actor, alg.critic, maps)
    for mirroring in (Mirroring((1, 2, 0), (1.0, 1.0, 1.0)), Mirroring((1, 0), (1.0, -1.0))):
        with pytest.raises(UserError, match="mirrored twice, 'wheels' in 'policy' is not what it was"):
            Mirror({"policy": [("height", SCALAR), ("wheels", mirroring)]}, "", "cpu")


@pytest.mark.parametrize(
    ("changes", "has_images"),
    [
        ({"algorithm.class_name": f"{__name__}:Own"}, True),
        ({"pretraining.function": "legged_torque.paper.gravity.pretraining:pretrain"}, True),
        ({SYMMETRY + "use_equivariant_networks": False}, True),
        ({SYMMETRY + "use_mirror_loss": True}, True),
        ({SYMMETRY + "use_data_augmentation": False}, False),
    ],
    ids=str,
)
def test_what_cannot_be_equivariant(make_task, changes, has_images):
    """It learns from mirror images, or from none where those are not wanted."""
    alg = build_runner(make_task, "a1_torque", **SMALL, **changes).alg
    assert alg.mirrored is None and (alg.symmetry is not None) == has_images


def test_networks_that_were_not_equivariant(make_task, tmp_path):
    """Those of a checkpoint are refused by name, and an older run, whose settings do not say it, had none."""
    without = {SYMMETRY + "use_equivariant_networks": False}
    runner = build_runner(make_task, "a1_torque", log_root=tmp_path, **SMALL, **without)
    runner.learn(1)
    with pytest.raises(UserError, match=r"not equivariant: they need --set algorithm\.symmetry_cfg\.use_equivariant"):
        build_runner(make_task, "a1_torque", **SMALL).load(f"{runner.log_dir}/model_1.pt")
    few = build_runner(make_task, "a1_torque", **{**SMALL, **without, "algorithm.num_mini_batches": 10**6})
    few.load(f"{runner.log_dir}/model_1.pt")  # to play, for which there are samples enough
    assert "more than the samples" in error_of(few.learn, 1)
    player = build_runner(make_task, "a1_torque", **SMALL)
    player.load(f"{runner.log_dir}/model_1.pt", {"actor": True})
    assert "not equivariant" in error_of(player.learn, 1)
    _, cfg = task_registry.get_cfgs("a1_torque")
    older = to_dict(cfg)
    assert older["algorithm"]["symmetry_cfg"].pop("use_equivariant_networks")
    assert not cfg.upgraded(older)["algorithm"]["symmetry_cfg"]["use_equivariant_networks"]
    assert cfg.upgraded({"seed": 3}) == {"seed": 3}
