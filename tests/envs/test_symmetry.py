"""Mirror images: those of observations and actions against those of the physics, and what learning makes of them."""

import math

import pytest
import torch
from support.settings import get_cfgs
from support.symmetry import mirror_joints, mirror_policy
from tensordict import TensorDict
from torch import nn

from legged_torque import RESOURCES_DIR
from legged_torque.envs import task_registry
from legged_torque.envs.base.symmetry import with_mirror_images
from legged_torque.utils.config import set_by_path
from legged_torque.utils.errors import UserError
from legged_torque.utils.mirroring import counterparts

TASKS = ["a1_position", "a1_torque", "a1_torque_curriculum", "a1_torque_multihead"]
GROUPS = ("policy", "critic", "actions")
WORLDS, STEPS = 4, 4
SAMPLES = WORLDS * STEPS
DRAWN = 117
"""Numbers of a world that may be drawn at random."""


def mirror_qpos(qpos):
    """The plane y = 0 reflects positions in y and turns rotations about x and z around."""
    return torch.cat([qpos[:, :7] * torch.tensor([1.0, -1, 1, 1, -1, 1, -1]), mirror_joints(qpos[:, 7:])], dim=1)


def mirror_qvel(qvel):
    """Velocities are reflected as positions are; angular velocities about x and z change their sign."""
    return torch.cat([qvel[:, :6] * torch.tensor([1.0, -1, 1, -1, 1, -1]), mirror_joints(qvel[:, 6:])], dim=1)


def mirror_critic(obs):
    """The policy's, then linear velocity, height, contacts of the feet, and what is drawn at random."""
    policy, more, drawn = obs.split([obs.shape[1] - 8 - DRAWN, 8, DRAWN], dim=1)
    more = (more * torch.tensor([1.0, -1, 1, 1, 1, 1, 1, 1]))[:, [0, 1, 2, 3, 5, 4, 7, 6]]
    return torch.cat([mirror_policy(policy), more, mirror_drawn(drawn)], dim=1)


def mirror_drawn(drawn):
    """Mass, centre of mass, radius, feet; four per joint; three of the ground; then those of the controller.

    These are strength and offset per joint, the action scale, and two gains per joint.
    """
    trunk, feet, joints, ground, *control = drawn.split([5, 12, 48, 3, 12, 12, 1, 12, 12], dim=1)
    strength, offsets, action_scale, *gains = control
    strength, *gains = (values.reshape(-1, 4, 3)[:, [1, 0, 3, 2]].flatten(1) for values in (strength, *gains))
    feet = feet.reshape(-1, 4, 3)[:, [1, 0, 3, 2]] * torch.tensor([1.0, -1, 1])
    joints = joints.reshape(-1, 4, 4, 3)[:, :, [1, 0, 3, 2]]
    trunk = trunk * torch.tensor([1.0, 1, -1, 1, 1])
    control = [strength, mirror_joints(offsets), action_scale, *gains]
    return torch.cat([trunk, feet.flatten(1), joints.flatten(1), ground, *control], dim=1)


BY_HAND = {"policy": mirror_policy, "critic": mirror_critic, "actions": mirror_joints}


@pytest.fixture(scope="module")
def make_symmetric(make_task, tmp_path_factory):
    """Factory of tasks whose trunk, unlike the real one, has its mass in the middle, and that change nothing at random.

    Of its worlds, the second half is the mirror image of the first one, in states of all kinds.
    """
    file = tmp_path_factory.mktemp("symmetric") / "a1.xml"
    text = (RESOURCES_DIR / "robots/a1/a1.xml").read_text()
    for old, new in (
        ('pos="0 0.0041 -0.0005"', 'pos="0.003 0 -0.0005"'),
        ("-3.66e-05 -6.11e-05 -2.75e-05", "0 6e-4 0"),
    ):
        assert old in text
        text = text.replace(old, new)
    file.write_text(text)
    overrides = {
        "asset.file": str(file),
        "commands.resampling_probability": 0.0,
        "asset.terminate_after_contacts_on": [],
        "rewards.only_positive_rewards": False,
    }

    def make(name, num=32):
        task = make_task(name, 2 * num, **overrides)
        generator = torch.Generator().manual_seed(2)
        sim = task.sim
        qpos, qvel = sim.qpos[:num].clone(), torch.randn(num, 18, generator=generator)
        qpos[:, 2] = torch.linspace(0.1, 0.4, num)
        qpos[:, 3:7], qpos[:, 7:] = torch.tensor([1.0, 0.0, 0.0, 0.0]), task.default_dof_pos  # not what was drawn
        qpos[:, 3:7] += 0.2 * torch.randn(num, 4, generator=generator)
        qpos[:, 3:7] /= qpos[:, 3:7].norm(dim=1, keepdim=True)
        qpos[:, 7:] += 0.3 * torch.randn(num, 12, generator=generator)
        sim.qpos.copy_(torch.cat([qpos, mirror_qpos(qpos)]))
        sim.qvel.copy_(torch.cat([qvel, mirror_qvel(qvel)]))
        command = torch.randn(num, 3, generator=generator)
        task.commands.copy_(torch.cat([command, command * torch.tensor([1.0, -1.0, -1.0])]))
        return task

    return make


# --------------------------------------------------------------------------------------------------- mirror images


@pytest.mark.parametrize("name", TASKS)
def test_mirrored_twice(make_task, name):
    """Mirroring is what it is by hand, is no identity, and undoes itself."""
    task = make_task(name, 2)
    sizes = {key: value.shape[1] for key, value in task.get_observations().items()} | {"actions": task.num_actions}
    assert set(sizes) == set(GROUPS)
    for group, size in sizes.items():
        values = torch.randn(5, size)
        image = task.mirror(group, values)
        assert torch.equal(image, BY_HAND[group](values))
        assert not torch.equal(image, values) and torch.equal(task.mirror(group, image), values)


@pytest.mark.parametrize("name", TASKS)
def test_mirror_agrees_with_physics(make_symmetric, name):
    """The mirror image of a world, given mirrored actions, is seen as the mirror image of what is seen of the world."""
    task = make_symmetric(name)
    num = task.num_envs // 2
    generator = torch.Generator().manual_seed(3)
    touching = 0
    for _ in range(3):
        actions = torch.randn(num, task.num_actions, generator=generator)
        obs, rewards, dones, _ = task.step(torch.cat([actions, task.mirror("actions", actions)]))
        assert not dones.any()
        for group in ("policy", "critic"):
            seen, image = obs[group][:num], obs[group][num:]
            torch.testing.assert_close(image, task.mirror(group, seen), rtol=0, atol=5e-4)
            assert ((image - seen).abs().max(dim=1).values > 0.1).all()
        torch.testing.assert_close(mirror_qpos(task.sim.qpos[:num]), task.sim.qpos[num:], rtol=0, atol=1e-4)
        torch.testing.assert_close(rewards[num:], rewards[:num], rtol=0, atol=1e-3)
        assert rewards.abs().mean() > 0.01
        touching += int(task.feet_contact.sum())
    assert touching > num


def test_both_or_one_of_observations_and_actions(make_task):
    """What rsl_rl asks for: originals first, then their images; None stays None."""
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


def test_counterparts():
    """Parts are paired by name; one without a counterpart is refused."""
    pairs = [["FR", "FL"], ["right", "left"]]
    assert counterparts(["FR_hip_joint", "FL_hip_joint", "left_knee", "right_knee"], pairs) == (1, 0, 3, 2)
    with pytest.raises(UserError, match="'FR_hip' has no counterpart 'FL_hip'"):
        counterparts(["FR_hip", "left_hip"], pairs)
    with pytest.raises(UserError, match="'RL_hip' has no counterpart: asset"):
        counterparts(["RL_hip"], pairs)


# --------------------------------------------------------------------------------------------------- learning


@pytest.fixture(scope="module")
def make_runner(make_task):
    """Factory of runners with small networks and one update per rollout; flags by name."""

    def make(name="a1_torque", log_root=None, augmentation=True, loss=False, **overrides):
        _, train_cfg = task_registry.get_cfgs(name)
        settings = {
            "runner.num_steps_per_env": STEPS,
            "runner.logger": "none",
            "critic.hidden_dims": [16],
            "algorithm.num_mini_batches": 1,
            "algorithm.num_learning_epochs": 1,
            "algorithm.schedule": "fixed",
            "algorithm.symmetry_cfg.use_data_augmentation": augmentation,
            "algorithm.symmetry_cfg.use_mirror_loss": loss,
        }
        for path, value in {**settings, **overrides}.items():
            set_by_path(train_cfg, path, value)
        task = make_task(name, WORLDS)
        torch.manual_seed(0)
        return task_registry.make_alg_runner(task, train_cfg=train_cfg, log_root=log_root)[0]

    return make


def roll_out(runner):
    """Fill the storage; then change the policy, so that it is no longer the one that acted."""
    runner.collect_rollout()
    with torch.no_grad():
        for parameter in runner.alg.actor.mlp.parameters():
            parameter += 0.02 * torch.randn(parameter.shape)
    runner.alg.indices.copy_(torch.arange(SAMPLES))
    return runner.alg._gather()


def normal_log_prob(actions, mean, std):
    """Logarithm of the density of independent normal numbers."""
    return (-0.5 * ((actions - mean) / std) ** 2 - std.log() - 0.5 * math.log(2.0 * math.pi)).sum(dim=1)


@pytest.mark.parametrize("name", ["a1_torque", "a1_torque_multihead"])
@pytest.mark.parametrize("augmentation", [True, False])
def test_losses_of_an_update(make_runner, name, augmentation):
    """By hand: policy and value are learned from images too; the divergence is that of the originals alone."""
    runner = make_runner(name, augmentation=augmentation, **{"algorithm.use_clipped_value_loss": False})
    alg, batch = runner.alg, roll_out(runner)
    obs, actions, times = batch.observations, batch.actions, 1
    mean = alg.actor(obs).detach()
    old_mean, std = (values.clone() for values in batch.old_distribution_params)
    kl = (0.5 * ((mean - old_mean) / std) ** 2).sum(dim=1).mean()
    if augmentation:
        images = {group: BY_HAND[group](obs[group]) for group in ("policy", "critic")}
        obs = TensorDict({group: torch.cat([obs[group], image]) for group, image in images.items()}, [2 * SAMPLES])
        actions, times = torch.cat([actions, mirror_joints(actions)]), 2
        image_kl = (0.5 * ((alg.actor(obs).detach()[SAMPLES:] - old_mean) / std) ** 2).sum(dim=1).mean()
        assert abs(image_kl - kl) > 0.01 * kl
    std = std.repeat(times, 1)
    old_log_prob, advantages = (
        batch.old_actions_log_prob.flatten().repeat(times),
        batch.advantages.flatten().repeat(times),
    )
    ratio = torch.exp(normal_log_prob(actions, alg.actor(obs).detach(), std) - old_log_prob)
    surrogate = torch.max(-advantages * ratio, -advantages * ratio.clamp(0.8, 1.2)).mean()
    value = (alg.critic(obs).detach() - batch.returns.repeat(times, 1)).square().mean()
    losses = alg.update()
    assert losses["skipped_updates"] == 0.0
    assert losses["kl"] == pytest.approx(float(kl), rel=1e-4)
    assert losses["surrogate"] == pytest.approx(float(surrogate), rel=1e-4, abs=1e-5)
    assert losses["value"] == pytest.approx(float(value), rel=1e-4)


class Symmetrized(nn.Module):
    """The mean of a network and of its mirror image: what a symmetric policy is."""

    def __init__(self, network):
        """Keep the network."""
        super().__init__()
        self.network = network

    def forward(self, obs):
        """Return actions that are mirrored when observations are."""
        return 0.5 * (self.network(obs) + mirror_joints(self.network(mirror_policy(obs))))


@pytest.mark.parametrize("augmentation", [True, False])
def test_mirror_loss(make_runner, augmentation):
    """It is the mean square of what mirrored observations change, and nothing for a symmetric policy."""
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


def test_mirror_loss_makes_policies_symmetric(make_runner):
    """With nothing but the mirror loss to learn from, a policy becomes symmetric."""
    settings = {"value_loss_coef": 0.0, "entropy_coef": 0.0, "num_learning_epochs": 50, "learning_rate": 1e-3}
    settings |= {"symmetry_cfg.mirror_loss_coeff": 1.0}
    runner = make_runner(
        augmentation=False, loss=True, **{f"algorithm.{key}": value for key, value in settings.items()}
    )
    obs = roll_out(runner).observations["policy"]
    runner.alg.storage.advantages.zero_()
    mlp = runner.alg.actor.mlp

    def asymmetry():
        return float((mlp(mirror_policy(obs)) - mirror_joints(mlp(obs))).square().mean().detach())

    before = asymmetry()
    runner.alg.update()
    assert asymmetry() < 0.3 * before


@pytest.mark.parametrize("name", TASKS)
def test_who_learns_from_images(name):
    """All tasks of the A1 do, unless the paper's settings are asked for."""
    for words, expected in (((), True), (("--preset=paper",), False)):
        symmetry = get_cfgs(*words, task=name)[1].algorithm.symmetry_cfg
        assert symmetry.use_data_augmentation == expected and not symmetry.use_mirror_loss
