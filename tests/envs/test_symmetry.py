"""Mirror images of observations and actions, and learning from them; test_robots.py compares with the physics."""

import math

import pytest
import torch
from support.control import mirror_joints, mirror_policy
from support.settings import build_runner, error_of, get_cfgs
from tensordict import TensorDict
from torch import nn

from legged_torque.envs.approaches.torque import TorqueRobot
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.base.observations import ObservationTerm
from legged_torque.envs.base.symmetry import with_mirror_images
from legged_torque.envs.tasks import A1TorqueCfg
from legged_torque.learning.ppo.cpu_ppo import CpuPPO
from legged_torque.learning.ppo.torch_ppo import TorchPPO
from legged_torque.utils.errors import UserError
from legged_torque.utils.mirroring import VECTOR, Mirroring, counterparts

TASKS = ["a1_position", "a1_torque", "a1_torque_curriculum", "a1_torque_multihead"]
GROUPS = ("policy", "critic", "actions")
WORLDS, STEPS = 4, 4
SAMPLES = WORLDS * STEPS
DRAWN = 117
"""Numbers of a world that may be drawn at random."""


def mirror_critic(obs):
    """The policy's observations, then linear velocity, height, contacts of the feet, and random parameters."""
    policy, more, drawn = obs.split([obs.shape[1] - 8 - DRAWN, 8, DRAWN], dim=1)
    more = (more * torch.tensor([1.0, -1, 1, 1, 1, 1, 1, 1]))[:, [0, 1, 2, 3, 5, 4, 7, 6]]
    return torch.cat([mirror_policy(policy), more, mirror_drawn(drawn)], dim=1)


def mirror_drawn(drawn):
    """Trunk, feet, four per joint, ground; then strength and offset per joint, action scale, two gains per joint."""
    trunk, feet, joints, ground, *control = drawn.split([5, 12, 48, 3, 12, 12, 1, 12, 12], dim=1)
    strength, offsets, action_scale, *gains = control
    strength, *gains = (values.reshape(-1, 4, 3)[:, [1, 0, 3, 2]].flatten(1) for values in (strength, *gains))
    feet = feet.reshape(-1, 4, 3)[:, [1, 0, 3, 2]] * torch.tensor([1.0, -1, 1])
    joints = joints.reshape(-1, 4, 4, 3)[:, :, [1, 0, 3, 2]]
    trunk = trunk * torch.tensor([1.0, 1, -1, 1, 1])
    control = [strength, mirror_joints(offsets), action_scale, *gains]
    return torch.cat([trunk, feet.flatten(1), joints.flatten(1), ground, *control], dim=1)


BY_HAND = {"policy": mirror_policy, "critic": mirror_critic, "actions": mirror_joints}


@pytest.mark.parametrize("name", TASKS)
def test_mirrored_twice(make_task, name):
    """Mirroring is as by hand, no identity, and its own inverse."""
    task = make_task(name, 2)
    sizes = {key: value.shape[1] for key, value in task.get_observations().items()} | {"actions": task.num_actions}
    assert set(sizes) == set(GROUPS)
    for group, size in sizes.items():
        values = torch.randn(5, size)
        image = task.mirror(group, values)
        assert torch.equal(image, BY_HAND[group](values))
        assert not torch.equal(image, values) and torch.equal(task.mirror(group, image), values)


def test_both_or_one_of_observations_and_actions(make_task):
    """The result is as rsl_rl needs it: originals first, then their images; None stays None."""
    task = make_task("a1_torque_multihead", 2)
    obs = TensorDict({name: torch.randn(3, value.shape[1]) for name, value in task.get_observations().items()}, [3])
    actions = torch.randn(3, 24)
    both, images = with_mirror_images(task, obs, actions)
    assert both.batch_size == (6,) and images.shape == (6, 24)
    for group in ("policy", "critic"):
        assert torch.equal(both[group], torch.cat([obs[group], BY_HAND[group](obs[group])]))
    assert torch.equal(images, torch.cat([actions, mirror_joints(actions)]))
    only, nothing = with_mirror_images(task, obs, None)
    assert nothing is None and torch.equal(only["critic"], both["critic"])
    nothing, only = with_mirror_images(task, None, actions)
    assert nothing is None and torch.equal(only, images)


def test_groups_with_more_axes():
    """Vectors of feet and a table of four numbers in groups of their own are mirrored number by number."""

    class Robot(TorqueRobot):
        def observation_terms(self):
            feet, table = self.symmetry.feet.of_vectors(VECTOR), Mirroring((2, 3, 0, 1), (1.0, -1.0, 1.0, -1.0))
            own = {"feet": (feet, torch.ones(2, 4, 3)), "table": (table, torch.ones(2, 2, 2))}
            groups = [ObservationTerm(name, lambda v=v: v, mirror, group=name) for name, (mirror, v) in own.items()]
            return [*super().observation_terms(), *groups]

    cfg = A1TorqueCfg()
    cfg.env.num_envs = 2
    mirror, feet = Robot(cfg).mirror, torch.randn(5, 4, 3)
    assert torch.equal(mirror("feet", feet), feet[:, [1, 0, 3, 2]] * torch.tensor([1.0, -1.0, 1.0]))
    assert mirror("table", torch.tensor([[[0.0, 1.0], [2.0, 3.0]]])).tolist() == [[[2.0, -3.0], [0.0, -1.0]]]


def test_counterparts():
    """Parts are paired by name; one without a counterpart is refused."""
    pairs = [["FR", "FL"], ["right", "left"]]
    assert counterparts(["FR_hip_joint", "FL_hip_joint", "left_knee", "right_knee"], pairs) == (1, 0, 3, 2)
    with pytest.raises(UserError, match="'FR_hip' has no counterpart 'FL_hip'"):
        counterparts(["FR_hip", "left_hip"], pairs)
    with pytest.raises(UserError, match="'RL_hip' has no counterpart: asset"):
        counterparts(["RL_hip"], pairs)


UNLIKE = {
    "init_state.default_joint_angles.FL_hip_joint=0.5": (-0.1, 0.5),
    "control.stiffness={FR: 20, FL: 60, R: 20}": (20, 60),
    "control.damping={FR: 0.5, F: 1, R: 0.5}": (0.5, 1),
    "motors.drive.stiffness={FR: 0, F: 30, R: 0}": (0, 30),
}


@pytest.mark.parametrize("change", UNLIKE)
def test_settings_of_one_side(change):
    """A pose or gains that differ between left and right leave no mirror image: the same action is other torques."""
    words = ("--num_envs=1", f"--set={change}")
    cfg, _ = get_cfgs(*words, "--set=motors.chain=[delay, drive, ideal]", task="a1_position")
    message = error_of(lambda: LeggedRobot(cfg).mirror)
    assert "has {} for 'FR_hip_joint' and {} for 'FL_hip_joint'".format(*UNLIKE[change]) in message
    assert message.startswith(change[:14]) and "symmetry_cfg.use_data_augmentation=false" in message
    if "drive" in change:  # which counts in the chain alone
        assert LeggedRobot(get_cfgs(*words, task="a1_position")[0]).mirror


def test_offsets_to_one_side(make_task):
    """Hips that every draw turns to the left have no mirror image among the draws."""
    ranges = {"domain_rand.joint_offset": {"add": [0.0, 0.02]}}
    message = error_of(lambda: make_task("a1_position", 1, **ranges).mirror)
    assert "random parameter 'joint_offset' is not known, or leaves its range" in message


@pytest.fixture(scope="module")
def make_runner(make_task):
    """Factory of runners with small networks and one update per rollout; flags by name."""

    def make(name="a1_torque", augmentation=True, loss=False, **overrides):
        settings = {
            "runner.num_steps_per_env": STEPS,
            "runner.logger": "none",
            "critic.hidden_dims": [16],
            "algorithm.num_mini_batches": 1,
            "algorithm.num_learning_epochs": 1,
            "algorithm.schedule": "fixed",
            "algorithm.symmetry_cfg.use_data_augmentation": augmentation,
            "algorithm.symmetry_cfg.use_equivariant_networks": False,
            "algorithm.symmetry_cfg.use_mirror_loss": loss,
        }
        return build_runner(make_task, name, WORLDS, **{**settings, **overrides})

    return make


def roll_out(runner):
    """Fill the storage; then change the policy, so that it is no longer the one that acted."""
    runner.collect_rollout()
    with torch.no_grad():
        for parameter in runner.alg.actor.mlp.parameters():
            parameter += 0.02 * torch.randn(parameter.shape)
    runner.alg.indices.copy_(torch.arange(len(runner.alg.indices)))
    return runner.alg._gather()


def normal_log_prob(actions, mean, std):
    """Logarithm of the density of independent normal numbers."""
    return (-0.5 * ((actions - mean) / std) ** 2 - std.log() - 0.5 * math.log(2.0 * math.pi)).sum(dim=1)


@pytest.mark.parametrize("name", ["a1_torque", "a1_torque_multihead"])
def test_losses_of_an_update(make_runner, name):
    """By hand: policy and value are also learned from images; the divergence is that of the originals alone."""
    runner = make_runner(name, **{"algorithm.use_clipped_value_loss": False})
    alg, batch = runner.alg, roll_out(runner)
    seen = {group: batch.observations[group] for group in ("policy", "critic")}
    both = {group: torch.cat([values, BY_HAND[group](values)]) for group, values in seen.items()}
    obs, actions = TensorDict(both, [2 * SAMPLES]), torch.cat([batch.actions, mirror_joints(batch.actions)])
    old_mean, std = (values.clone() for values in batch.old_distribution_params)
    means = alg.actor(obs).detach()
    kl, image_kl = ((0.5 * ((mean - old_mean) / std) ** 2).sum(dim=1).mean() for mean in means.split(SAMPLES))
    assert abs(image_kl - kl) > 0.01 * kl
    old_log_prob = batch.old_actions_log_prob.flatten().repeat(2)
    advantages = batch.advantages.flatten().repeat(2)
    ratio = torch.exp(normal_log_prob(actions, means, std.repeat(2, 1)) - old_log_prob)
    surrogate = torch.max(-advantages * ratio, -advantages * ratio.clamp(0.8, 1.2)).mean()
    value = (alg.critic(obs).detach() - batch.returns.repeat(2, 1)).square().mean()
    losses = alg.update()
    assert losses["skipped_updates"] == 0.0
    assert losses["kl"] == pytest.approx(float(kl), rel=1e-4)
    assert losses["surrogate"] == pytest.approx(float(surrogate), rel=1e-4, abs=1e-5)
    assert losses["value"] == pytest.approx(float(value), rel=1e-4)


@pytest.mark.parametrize("name", ["a1_torque", "a1_torque_multihead"])
@pytest.mark.parametrize("augmentation", [True, False])
def test_losses_on_a_cpu(make_runner, name, augmentation):
    """They and their gradients are those of torch's operations, for half of the samples in any order."""
    runner = make_runner(name, augmentation=augmentation, **{"algorithm.num_mini_batches": 2})
    roll_out(runner)
    runner.alg.indices.copy_(torch.randperm(SAMPLES)[: SAMPLES // 2])
    found = []
    for kind in (CpuPPO, TorchPPO):
        runner.alg.optimizer.zero_grad()
        loss, numbers = kind.loss(runner.alg)
        loss.backward()
        found.append([numbers, *(parameter.grad for parameter in runner.alg._parameters)])
    torch.testing.assert_close(*found, rtol=1e-4, atol=1e-6)


class Symmetrized(nn.Module):
    """A symmetric policy: the mean of a network and of its mirror image."""

    def __init__(self, network):
        """Keep the network."""
        super().__init__()
        self.network = network

    def forward(self, obs):
        """Return actions that are mirrored when observations are."""
        return 0.5 * (self.network(obs) + mirror_joints(self.network(mirror_policy(obs))))


@pytest.mark.parametrize("augmentation", [True, False])
def test_mirror_loss(make_runner, augmentation):
    """It is the mean square of the change by mirrored observations, and 0 for a symmetric policy."""
    runner = make_runner(augmentation=augmentation, loss=True)
    alg, batch = runner.alg, roll_out(runner)
    obs, actor = batch.observations["policy"], alg.actor

    def loss_now():
        batch = alg._gather()
        alg.symmetry.augment_batch(batch, SAMPLES)
        return float(alg.symmetry.compute_loss(actor, batch, SAMPLES).detach())

    expected = (actor.mlp(mirror_policy(obs)) - mirror_joints(actor.mlp(obs))).square().mean().detach()
    assert expected > 1e-3
    assert loss_now() == pytest.approx(float(expected), rel=1e-4)
    actor.mlp = Symmetrized(actor.mlp)
    assert actor(batch.observations).abs().mean() > 0.01
    assert loss_now() < 1e-10


@pytest.mark.parametrize(("words", "expected"), [((), True), (("--preset=paper",), False)])
def test_augmentation_is_the_default(words, expected):
    """Tasks learn from mirror images, unless the paper's settings are asked for."""
    symmetry = get_cfgs(*words, task="a1_torque")[1].algorithm.symmetry_cfg
    assert symmetry.use_data_augmentation == expected and not symmetry.use_mirror_loss
