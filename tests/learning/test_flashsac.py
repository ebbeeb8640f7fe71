"""FlashSAC as a learner, its pieces against torch's own operations, and formulas in loops."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from support.point_masses import PointMasses, assert_holds_points, make_trainer
from support.scripts import SMALL, assert_told_in_one_line, run_here
from support.settings import error_of, get_cfgs
from torch.distributions import Normal, TanhTransform, TransformedDistribution
from torch.utils._python_dispatch import TorchDispatchMode

from legged_torque.envs import task_registry
from legged_torque.envs.tasks import A1TorqueCfgPPO
from legged_torque.learning import checkpoint
from legged_torque.learning.flashsac import FlashSAC
from legged_torque.learning.flashsac.exploration import RepeatedNoise
from legged_torque.learning.flashsac.networks import Trunk, UnitBatchNorm, UnitLinear, bound_weights, squashed
from legged_torque.learning.flashsac.replay import Replay
from legged_torque.learning.flashsac.returns import RewardScale, projected
from legged_torque.learning.protocols import Transition
from legged_torque.utils.config import to_dict

SIZES = [f"flashsac.{network}.{size}" for network in ("actor", "critic") for size in ("hidden_dim=64", "num_blocks=1")]
SIZES += ["flashsac.mini_batch_size=64", "flashsac.buffer_min_length=128", "flashsac.replay_buffer_size=4000"]
SIZES += ["flashsac.critic.num_bins=21", "flashsac.updates_per_step=1", "evaluation.interval=0", "runner.logger=none"]


def make(*changes, folder=None):
    """A trainer of FlashSAC in point masses, with settings changed like those of a command line."""
    words = [f"--set={change}" for change in (*SIZES, "flashsac.action_bound=1", "algorithm.gamma=0.9", *changes)]
    cfg = to_dict(get_cfgs("--preset=flashsac", *words)[1])
    cfg["algorithm"]["symmetry_cfg"]["use_data_augmentation"] = False
    used = {name: cfg[name] for name in ("flashsac", "algorithm", "pretraining")}
    return make_trainer(FlashSAC, folder, **used, obs_groups={"actor": ["policy"], "critic": ["policy"]})


def test_it_learns_to_hold_point_masses():
    """Its policy drives every point to 0, from which it was anywhere before."""
    torch.manual_seed(1)
    faster = ("flashsac.learning_rate_peak=2e-3", "flashsac.critic_target_update_tau=0.05")
    trainer = make("flashsac.critic.num_bins=51", *faster)
    assert_holds_points(trainer, within=0.3)


def test_losses():
    """They are those of the paper in loops, and the temperature follows the entropy."""
    torch.manual_seed(0)
    trainer = make()
    trainer.learn(3)
    alg, batch = trainer.alg, trainer.alg.replay.sample(8, 3, 0.9)
    values, temperature = alg.critic.values, alg.log_temperature.detach().exp()
    torch.manual_seed(5)
    loss, (actor_loss, entropy, _) = alg.actor_loss(batch)
    torch.manual_seed(5)
    actions, log_density, _ = alg.actor.sample(torch.cat([batch.obs, batch.next_obs]), learning=True)
    earned = (alg.critic(batch.obs, actions[:8], learning=False)[0].exp() * values).sum(dim=-1)
    rows = [temperature * log_density[i] - min(earned[0, i], earned[1, i]) for i in range(8)]
    torch.testing.assert_close(actor_loss, torch.stack(rows).mean().detach())
    torch.testing.assert_close(entropy, -log_density[:8].mean().detach())
    target = 0.5 * math.log(2.0 * math.pi * math.e * 0.15**2)  # of one action
    (grad,) = torch.autograd.grad(loss, alg.log_temperature, retain_graph=True)
    torch.testing.assert_close(grad, temperature * (entropy - target))

    batch = dataclasses.replace(batch, weights=torch.tensor([0.0] + [1.0] * 7))
    torch.manual_seed(6)
    loss, _ = alg.critic_loss(batch)
    torch.manual_seed(6)
    actions, log_density, _ = alg.actor.sample(batch.next_obs, learning=False)
    both = torch.cat([batch.obs, batch.next_obs]), torch.cat([batch.actions, actions])
    targets, predicted = alg.target(*both, learning=True)[0][:, 8:], alg.critic(*both, learning=True)[0]
    losses = []
    for i in range(1, 8):
        probs = min((targets[k, i].exp() for k in (0, 1)), key=lambda probs: float((probs * values).sum()))
        places = batch.rewards[i] / alg.reward_scale.scale()
        places = places + batch.discounts[i] * (values - temperature * log_density[i])
        wanted = projected(probs[None], places[None], values)[0]
        losses += [-(wanted * predicted[k, i]).sum() for k in (0, 1)]
    torch.testing.assert_close(loss, torch.stack(losses).mean())


@pytest.mark.parametrize("save", [True, False])
def test_resume(tmp_path, capsys, save):
    """With its replay, a resumed training has the bits of one that never stopped; without, it says so and goes on."""
    for folder, iterations in (("whole", 4), ("half", 2), ("resumed", 2)):
        torch.manual_seed(3)
        trainer = make(f"flashsac.save_replay={save}", "flashsac.learning_rate_end=3e-4", folder=tmp_path / folder)
        if folder == "resumed":
            trainer.resume(str(tmp_path / "half" / "model_2.pt"))
        trainer.learn(iterations)
    whole, resumed = (torch.load(tmp_path / name / "model_4.pt", weights_only=True) for name in ("whole", "resumed"))
    parts = [part for part in whole if part.startswith(("actor_state", "critic_state", "critic_target", "reward"))]
    same = [torch.equal(value, resumed[part][name]) for part in parts for name, value in whole[part].items()]
    assert len(parts) == 4 and all(same) == save
    assert (whole["num_updates"], resumed["num_updates"]) == (24, 24 if save else 16)
    assert ("The replay starts empty" in capsys.readouterr().out) != save


def test_worlds_that_do_not_fit(tmp_path, capsys):
    """The replay starts anew with the worlds: its last step and the first of other worlds are none of one episode."""
    trainer = make("flashsac.save_replay=true", folder=tmp_path)
    trainer.learn(2)
    state = torch.load(tmp_path / "model_2.pt", weights_only=True)
    worlds = torch.load(tmp_path / "worlds_2.pt", weights_only=True)
    worlds["processes"][0]["worlds"]["of_an_earlier_version"] = torch.zeros(1)
    state["infos"]["worlds"] = checkpoint.write(tmp_path / "worlds_2.pt", worlds)
    torch.save(state, tmp_path / "model_2.pt")
    resumed = make("flashsac.save_replay=true")
    resumed.resume(str(tmp_path / "model_2.pt"))
    assert "start anew, and what the learner keeps of them: " in capsys.readouterr().out
    assert int(trainer.alg.replay.count) > 0 and int(resumed.alg.replay.count) == 0


@pytest.mark.parametrize(("rows", "steps", "fits"), [(6, 9, True), (8, 5, True), (8, 9, False), (4, 5, False)])
def test_a_ring_of_another_size(rows, steps, fits):
    """What a ring of 6 rows has kept goes on in one of 6, or in one that has not been full; elsewhere it is refused."""
    task = PointMasses(num_envs=4)
    rings = [Replay(task.get_observations(), ["policy"], 1, 4 * size, torch.float32, "cpu") for size in (6, rows)]
    rings[0].allocate()
    task.keep_final_observations, obs = True, task.get_observations()
    for _ in range(steps):
        after, rewards, dones, extras = task.step(actions := 2.0 * torch.rand(4, 1))
        rest = (dones, extras["time_outs"], after, extras["final_observations"], extras)
        rings[0].add(Transition(obs, actions, rewards, *rest), actions)
        obs = after
    if not fits:
        with pytest.raises(ValueError, match=f"replay_buffer_size is {4 * rows} steps, and "):
            rings[1].load_state_dict(rings[0].state_dict())
        return
    rings[1].load_state_dict(rings[0].state_dict())
    drawn = []
    for ring in rings:
        torch.manual_seed(0)
        drawn.append(ring.sample(50, 2, 0.9))
    assert torch.equal(drawn[0].rewards, drawn[1].rewards) and drawn[1].weights.all()


class NoWaiting(TorchDispatchMode):
    """Refuses operations whose results the host needs."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        assert not any(part in str(function) for part in ("_local_scalar", "nonzero", "masked_select")), function
        return function(*args, **(kwargs or {}))


def test_nothing_waits_for_the_host_and_tensors_stay():
    """Acting, observing and a gradient step read no number from the device, and move no tensor that they keep."""
    trainer = make("flashsac.save_replay=true")
    trainer.learn(2)
    alg, task = trainer.alg, trainer.env

    def addresses():
        state = alg.world_state_dict()
        tensors = [*state["replay"].values(), *state["noise"].values(), *alg.reward_scale.buffers(), alg.learning_rate]
        return [t.data_ptr() for t in (*tensors, *alg.actor.state_dict().values(), *alg.target.state_dict().values())]

    before, obs = addresses(), task.get_observations()
    with NoWaiting(), torch.no_grad():
        actions = alg.act(obs)
    after, rewards, dones, extras = task.step(actions)
    parts = (obs, actions, rewards, dones, extras["time_outs"], after, extras["final_observations"], extras)
    with NoWaiting(), torch.no_grad():
        alg.observe(Transition(*parts))
    with NoWaiting():
        for actor_learns in (True, False):
            alg.take_gradient_step(actor_learns)
    assert addresses() == before


def test_numbers_that_are_not_finite():
    """Gradient steps of the critic with them change no weight and are counted."""
    trainer = make()
    trainer.learn(3)
    trainer.env.step = lambda actions, step=trainer.env.step: [
        math.nan * x if i == 1 else x for i, x in enumerate(step(actions))
    ]
    for _ in range(60):
        trainer.collect_rollout()
    before = [value.clone() for value in trainer.alg.critic.parameters()]
    assert trainer.alg.update()["skipped_updates"] >= 8
    torch.testing.assert_close([*trainer.alg.critic.parameters()], before)


@pytest.mark.parametrize("task", ["a1_torque_multihead", "a1_rough_position_scan"])
def test_robots_learn_and_export(task, tmp_path):
    """Every parameter moves, half of each batch is mirror images, and an export gives the policy's actions."""
    pytest.importorskip("onnxruntime")
    from legged_torque.deploy.export import export_policy
    from legged_torque.deploy.policy import Policy

    env_cfg, cfg = get_cfgs("--preset=flashsac", "--num_envs=4", *(f"--set={change}" for change in SIZES), task=task)
    env, _ = task_registry.make_env(task, None, env_cfg)
    runner, _ = task_registry.make_alg_runner(env, task, train_cfg=cfg, log_root=None)
    alg = runner.alg
    named = [*alg.actor.named_parameters(), *alg.critic.named_parameters()]
    before = [value.clone() for _, value in named]
    runner.learn(6, init_at_random_ep_len=True)
    assert not [name for (name, value), old in zip(named, before, strict=True) if torch.equal(value, old)]
    batch = alg._sample()
    for name, values in {**batch.obs, **batch.next_obs, "actions": batch.actions}.items():
        assert len(values) == len(batch.rewards) == 2 * 64
        torch.testing.assert_close(env.mirror(name, values[64:]), values[:64])
    if "scan" not in task:
        export_policy(
            env,
            alg.policy(),
            tmp_path / "out",
            task,
            dict.fromkeys(("run", "checkpoint"), "") | dict.fromkeys(("iterations", "total_steps"), 6),
        )
        obs, policy = env.get_observations(), Policy(tmp_path / "out")
        expected = alg.policy()(obs).detach().numpy()
        np.testing.assert_allclose([policy.act(row) for row in obs["policy"].numpy()], expected, atol=1e-5)
        assert 0.0 < np.abs(expected).max() <= 2.0


REFUSED = yaml.safe_load(Path(__file__).with_name("flashsac.yaml").read_text("utf-8"))["refused"]


@pytest.mark.parametrize(("change", "told"), REFUSED)
def test_mistakes(tmp_path, change, told):
    """One line, exit status 2, and no run."""
    words = [f"--set={item}" for item in (*SIZES, change)]
    result = run_here("train.py", *SMALL, "--preset=flashsac", *words, root=tmp_path)
    assert_told_in_one_line(result, told)
    assert not [*tmp_path.rglob("config.yaml")]


class DecayingCfgPPO(A1TorqueCfgPPO):
    """PPO with an optimizer that would shrink an actor that does not learn yet."""

    class algorithm(A1TorqueCfgPPO.algorithm):
        optimizer: str = "adamw"


def test_settings_of_other_learners_are_refused(make_task):
    """PPO would not read those of FlashSAC; only PPO has a critic that can learn first."""
    assert "flashsac.n_steps is not read" in error_of(get_cfgs, "--set=flashsac.n_steps=1")
    warmup = "pretraining.critic_warmup_iterations"
    assert get_cfgs(f"--set={warmup}=5")[1].pretraining.critic_warmup_iterations == 5
    for preset in ("flashsac", "student"):
        assert error_of(get_cfgs, f"--preset={preset}", f"--set={warmup}=5").startswith(f"{warmup} is not read by ")
    cfg = DecayingCfgPPO()
    cfg.pretraining.critic_warmup_iterations = 5
    refused = error_of(task_registry.make_alg_runner, make_task("a1_torque", 4), train_cfg=cfg, log_root=None)
    assert refused.startswith(f"{warmup} needs ")


@pytest.mark.parametrize("copies", [(), (2,)])
def test_aligned_products(copies):
    """Those of a GPU are those of torch, with their gradients, for sizes that are no multiples of eight."""
    layer, inputs = UnitLinear(45, 101, copies), torch.randn(*copies, 45, 6, requires_grad=True)
    found = []
    for outputs in (layer(inputs), layer.aligned_product(inputs)):
        assert outputs.shape == (*copies, 101, 6)
        found.append([outputs, *torch.autograd.grad(outputs.pow(3).sum(), (inputs, layer.weight))])
    torch.testing.assert_close(*found)


@pytest.mark.parametrize("copies", [(), (2,)])
def test_batch_normalization(copies):
    """Outputs, gradients and running statistics are torch's, of each copy alone, in learning and in use."""
    torch.manual_seed(0)
    ours, inputs = UnitBatchNorm(5, copies), (3.0 * torch.randn(*copies, 5, 40) + 1.0).requires_grad_()
    for parameter in (ours.scale, ours.shift):
        torch.nn.init.uniform_(parameter, 0.5, 1.5)
    index, theirs = (1,) * len(copies), torch.nn.BatchNorm1d(5, momentum=0.01)
    theirs.load_state_dict({"weight": ours.scale[index], "bias": ours.shift[index]}, strict=False)
    twin = inputs[index].detach().T.requires_grad_()
    for learning in (True, False):
        outputs, expected = ours(inputs, learning), theirs.train(learning)(twin)
        pairs = (outputs, (inputs, ours.scale, ours.shift)), (expected, (twin, theirs.weight, theirs.bias))
        grads = [torch.autograd.grad(y[index if y is outputs else ()].pow(3).sum(), x) for y, x in pairs]
        torch.testing.assert_close(outputs[index].T, expected)
        torch.testing.assert_close(
            [grads[0][0][index].T, *(grad[index] for grad in grads[0][1:])], list(grads[1]), atol=1e-3, rtol=1e-4
        )
    torch.testing.assert_close(ours.mean[index], theirs.running_mean)
    torch.testing.assert_close(ours.var[index], theirs.running_var)


def test_norms_are_bounded():
    """Rows of weights have the norm 1, normalizations sqrt(size), and so have features of any input."""
    torch.manual_seed(0)
    trunk = Trunk(7, 16, 2, (2,))
    with torch.no_grad():
        for parameter in trunk.parameters():
            parameter.add_(3.0 * torch.randn_like(parameter))
    bound_weights(trunk)
    for module in (module for module in trunk.modules() if hasattr(module, "bound")):
        if isinstance(module, UnitLinear):
            torch.testing.assert_close(module.weight.norm(dim=-1), torch.ones(module.weight.shape[:-1]))
        else:
            norms = torch.cat(list(module.parameters()), dim=-1).norm(dim=-1)
            torch.testing.assert_close(norms, torch.full((2,), math.sqrt(module.scale.shape[-1])))
    features = trunk((1e3 * torch.randn(30, 7)).expand(2, 30, 7), True) / trunk.norm.scale.unsqueeze(-1)
    torch.testing.assert_close(features.norm(dim=1), torch.full((2, 30), 4.0), atol=1e-3, rtol=1e-3)


def test_log_density_of_squashed_actions():
    """It and its gradients are those of torch's transformed distribution; it is finite where tanh has saturated."""
    torch.manual_seed(0)
    mean, std, draw = torch.randn(3, 6, 2, dtype=torch.float64).unbind()
    parameters = mean.requires_grad_(), (std.abs() + 0.1).detach().requires_grad_()
    actions, ours = squashed(*parameters, draw)
    theirs = TransformedDistribution(Normal(*parameters), TanhTransform(cache_size=1)).log_prob(actions).sum(dim=1)
    torch.testing.assert_close(ours, theirs)
    grads = [torch.autograd.grad(part.sum(), parameters, retain_graph=True) for part in (ours, theirs)]
    torch.testing.assert_close(grads[0], grads[1])
    assert torch.isfinite(squashed(torch.full((1, 1), 60.0), torch.ones(1, 1), torch.zeros(1, 1))[1])


def test_projection():
    """It is C51's, in loops; the mean stays where no place is outside of the values."""
    rng, values = np.random.default_rng(0), np.linspace(-2.0, 2.0, 9)
    probs, places = rng.dirichlet(np.ones(9), size=20), rng.normal(0.0, 2.0, (20, 9))
    places[0], places[1], places[2:10] = values, 0.3, np.clip(places[2:10], -2.0, 2.0)
    expected = np.zeros((20, 9))
    for row, prob, place in zip(expected, probs, places, strict=True):
        for share, at in zip(prob, (np.clip(place, -2.0, 2.0) + 2.0) / 0.5, strict=True):
            low = min(int(at), 7)
            row[low] += share * (low + 1 - at)
            row[low + 1] += share * (at - low)
    ours = projected(*(torch.as_tensor(part, dtype=torch.float32) for part in (probs, places, values))).numpy()
    np.testing.assert_allclose(ours, expected, atol=1e-6)
    np.testing.assert_allclose(ours[:10] @ values, (probs * places).sum(axis=1)[:10], atol=1e-5)


def test_reward_scale():
    """It is the larger of the deviation of all returns and the largest one over the bound, of each episode alone.

    A reward that is not finite counts as 0.
    """
    rng = np.random.default_rng(0)
    rewards, dones = rng.normal(0.5, 1.0, (50, 4)), rng.random((50, 4)) < 0.1
    rewards[[5, 20, 35], [0, 1, 2]] = math.nan, math.inf, -math.inf
    for bound in (1.0, 100.0):
        ours, running, now, returns = RewardScale(0.9, bound), torch.zeros(4), np.zeros(4), []
        for reward, done in zip(rewards, dones, strict=True):
            ours.follow(running, torch.tensor(reward, dtype=torch.float32), torch.tensor(done))
            now = 0.9 * now + np.where(np.isfinite(reward), reward, 0.0)
            returns.append(now)
            now = np.where(done, 0.0, now)
        assert float(ours.scale()) == pytest.approx(max(np.std(returns), np.abs(returns).max() / bound), rel=1e-5)


def test_noise_is_repeated():
    """Runs of equal noise have lengths with probabilities in proportion to n^-2; its numbers are standard normal."""
    torch.manual_seed(0)
    noise = RepeatedNoise(3, 2, 2.0, 4, "cpu")
    rows = torch.stack([noise.next().clone() for _ in range(6000)])
    ends = np.flatnonzero((rows[1:] != rows[:-1]).any(dim=(1, 2)).numpy()) + 1
    shares, weights = np.bincount(np.diff(ends), minlength=5)[1:] / (len(ends) - 1), 1.0 / np.arange(1, 5) ** 2
    np.testing.assert_allclose(shares, weights / weights.sum(), atol=0.03)
    drawn = rows[ends]
    assert abs(float(drawn.mean())) < 0.03 and abs(float(drawn.std()) - 1.0) < 0.03


@pytest.mark.parametrize(("steps", "num_steps"), [(30, 1), (90, 3)])
def test_replay(steps, num_steps):
    """Samples are what has happened, also across ends of episodes and after the ring has been filled."""
    torch.manual_seed(0)
    task, happened, left_out = PointMasses(num_envs=4), {}, set()
    task.keep_final_observations, task.max_episode_length, obs = True, 7, task.get_observations()
    replay = Replay(obs, ["policy"], 1, 4 * 40, torch.float32, "cpu")
    replay.allocate()
    for number in range(steps):  # kept by the observation before a step, which no other step has
        actions = 2.0 * torch.rand(4, 1)
        after, rewards, dones, extras = task.step(actions)
        final, time_outs = extras["final_observations"], extras["time_outs"]
        replay.add(Transition(obs, actions, rewards, dones, time_outs, after, final, extras), actions)
        parts = (obs["policy"], actions, rewards, final["policy"], after["policy"], dones, time_outs)
        for key, *row in zip(*(part.flatten().tolist() for part in parts), strict=True):
            happened[key] = (number, *row)
        left_out |= set(after["policy"].flatten()[time_outs].tolist())
        obs = after
    batch, seen, ends = replay.sample(3000, num_steps, 0.9), set(), set()
    parts = (batch.obs["policy"], batch.actions, batch.rewards, batch.discounts, batch.next_obs["policy"])
    kept = batch.weights.bool()
    for key, action, reward, discount, next_obs in zip(*(part.flatten()[kept].tolist() for part in parts), strict=True):
        number, own_action, total, final, after, done, timed_out = happened[key]
        factor = 0.9
        while not done and factor > 1.01 * 0.9**num_steps:
            _, _, more, final, after, done, timed_out = happened[after]
            total, factor = total + factor * more, 0.9 * factor
        seen.add(key)
        ends.add((done, timed_out))
        wanted = (own_action, total, 0.0 if done and not timed_out else factor)
        assert (action, reward, discount) == pytest.approx(wanted, rel=1e-5)
        assert next_obs == final or (done and not timed_out)
    young = {key for key, (number, *_) in happened.items() if steps - 40 <= number < steps - num_steps}
    assert seen == young - left_out and ends == {(False, False), (True, False), (True, True)}
