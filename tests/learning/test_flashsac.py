"""FlashSAC as a learner: what it learns, what it keeps, how it exports, and what is refused."""

import math

import numpy as np
import pytest
import torch
from support.point_masses import make_trainer
from support.scripts import SMALL, assert_told_in_one_line, run_here
from support.settings import error_of, get_cfgs
from torch.utils._python_dispatch import TorchDispatchMode

from legged_torque.envs import task_registry
from legged_torque.learning.flashsac import FlashSAC
from legged_torque.learning.flashsac.returns import projected
from legged_torque.utils.config import to_dict
from legged_torque.utils.task_registry import set_seed

TINY = ("hidden_dim=16", "num_blocks=1")
SIZES = [f"flashsac.{network}.{size}" for network in ("actor", "critic") for size in TINY]
SIZES += ["flashsac.mini_batch_size=64", "flashsac.buffer_min_length=64", "flashsac.replay_buffer_size=4000"]
SIZES += ["flashsac.critic.num_bins=21", "evaluation.interval=0", "runner.logger=none"]


def settings(*changes):
    """What a trainer of point masses needs of the settings, changed like those of a command line."""
    words = [f"--set={change}" for change in (*SIZES, "flashsac.action_bound=1", *changes)]
    _, train_cfg = get_cfgs("--preset=flashsac", *words)
    chosen = to_dict(train_cfg)
    chosen["algorithm"]["symmetry_cfg"]["use_data_augmentation"] = False
    return {name: chosen[name] for name in ("flashsac", "algorithm", "pretraining")} | {
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]}
    }


def make(*changes, folder=None, task=None):
    """A trainer of FlashSAC in point masses."""
    return make_trainer(FlashSAC, folder, task, **settings(*changes))


def make_runner(task, root=None, **env):
    """A runner of a robot's task in few worlds."""
    words = [f"--set={change}" for change in SIZES] + [f"--set={path}={value}" for path, value in env.items()]
    env_cfg, train_cfg = get_cfgs("--preset=flashsac", "--num_envs=4", *words, task=task)
    set_seed(0)
    env, _ = task_registry.make_env(task, None, env_cfg)
    return task_registry.make_alg_runner(env, task, train_cfg=train_cfg, log_root=root)[0]


def test_it_learns_to_hold_point_masses():
    """Its policy drives every point to 0, from which it was anywhere before."""
    torch.manual_seed(0)
    changes = ("flashsac.learning_rate_peak=3e-3", "flashsac.learning_rate_end=1e-3", "algorithm.gamma=0.9")
    trainer = make("flashsac.updates_per_step=1", "flashsac.critic_target_update_tau=0.05", *changes)
    trainer.learn(60, init_at_random_ep_len=True)
    x = torch.linspace(-1.0, 1.0, 9)[:, None]
    with torch.no_grad():
        for _ in range(15):
            x = x + 0.2 * trainer.alg.policy()({"policy": x})
    assert float(x.abs().max()) < 0.15


def test_losses():
    """They are those of the paper in loops; gradients of the actor's loss do not reach the critic."""
    torch.manual_seed(0)
    trainer = make("flashsac.updates_per_step=1")
    trainer.learn(3)
    alg, batch = trainer.alg, trainer.alg.replay.sample(8, 3, 0.99)
    values, temperature = alg.critic.values, float(alg.log_temperature.exp())
    torch.manual_seed(5)
    loss, (actor_loss, entropy, _) = alg.actor_loss(batch)
    torch.manual_seed(5)
    actions, log_density, _ = alg.actor.sample(torch.cat([batch.obs, batch.next_obs]), learning=True)
    log_probs, _ = alg.critic(batch.obs, actions[:8], learning=False)
    earned = (log_probs.exp() * values).sum(dim=-1)
    rows = [temperature * float(log_density[i]) - min(float(earned[0, i]), float(earned[1, i])) for i in range(8)]
    assert float(actor_loss) == pytest.approx(np.mean(rows), rel=1e-4)
    assert float(entropy) == pytest.approx(-float(log_density[:8].mean()), rel=1e-5)
    target = 0.5 * math.log(2.0 * math.pi * math.e * 0.15**2)  # of one action
    (grad,) = torch.autograd.grad(loss, alg.log_temperature, retain_graph=True)
    assert float(grad) == pytest.approx(temperature * (float(entropy) - target), rel=1e-4)
    grads = torch.autograd.grad(loss, [*alg.actor.parameters()], retain_graph=True)
    assert all(bool(part.abs().sum() > 0.0) for part in grads)

    batch = batch.__class__(**{**vars(batch), "weights": torch.tensor([0.0] + [1.0] * 7)})
    torch.manual_seed(6)
    loss, _ = alg.critic_loss(batch)
    torch.manual_seed(6)
    with torch.no_grad():
        actions, log_density, _ = alg.actor.sample(batch.next_obs, learning=False)
        both = torch.cat([batch.obs, batch.next_obs]), torch.cat([batch.actions, actions])
        target_log_probs, predicted = alg.target(*both, learning=True)[0][:, 8:], alg.critic(*both, learning=True)[0]
        losses = []
        for i in range(1, 8):
            means = [float((target_log_probs[k, i].exp() * values).sum()) for k in (0, 1)]
            probs = target_log_probs[int(means[1] < means[0]), i].exp()
            soft = values - temperature * float(log_density[i])
            places = float(batch.rewards[i] / alg.reward_scale.scale()) + float(batch.discounts[i]) * soft
            wanted = projected(probs[None], places[None], values)[0]
            losses += [-float((wanted * predicted[k, i]).sum()) for k in (0, 1)]
    assert float(loss) == pytest.approx(np.mean(losses), rel=1e-4)


@pytest.mark.parametrize("save", [True, False])
def test_resume(tmp_path, capsys, save):
    """With its replay, a resumed training has the bits of one that never stopped; without, it says so and goes on."""
    change = f"flashsac.save_replay={save}"
    for folder, iterations in (("whole", 4), ("half", 2), ("resumed", 2)):
        torch.manual_seed(3)
        trainer = make(change, "flashsac.updates_per_step=1", folder=tmp_path / folder)
        if folder == "resumed":
            trainer.resume(str(tmp_path / "half" / "model_2.pt"))
        trainer.learn(iterations)
    whole, resumed = (torch.load(tmp_path / name / "model_4.pt", weights_only=True) for name in ("whole", "resumed"))
    same = [
        all(torch.equal(value, resumed[part][name]) for name, value in whole[part].items())
        for part in ("actor_state_dict", "critic_state_dict", "critic_target_state_dict", "reward_scale_state_dict")
    ]
    assert all(same) == save
    assert whole["num_updates"] == 4 * 8 and resumed["num_updates"] == (32 if save else 16 + 8)
    assert ("The replay starts empty" in capsys.readouterr().out) != save


def test_nothing_waits_for_the_host_and_tensors_stay():
    """Acting, observing and a gradient step read no number from the device, and move no tensor that they keep."""

    class NoWaiting(TorchDispatchMode):
        def __torch_dispatch__(self, function, types, args=(), kwargs=None):
            name = str(function)
            assert not any(part in name for part in ("_local_scalar_dense", "nonzero", "masked_select")), name
            return function(*args, **(kwargs or {}))

    trainer = make()
    trainer.learn(2)
    alg, task = trainer.alg, trainer.env

    def addresses():
        state = {**alg.state_dict.__self__.world_state_dict()["replay"]} if alg.settings["save_replay"] else {}
        tensors = [*state.values(), *alg.noise.tensors().values(), *alg.reward_scale.buffers(), alg.returns]
        tensors += [*alg.actor.state_dict().values(), *alg.target.state_dict().values(), alg.learning_rate]
        return [tensor.data_ptr() for tensor in tensors]

    before, obs = addresses(), task.get_observations()
    with NoWaiting(), torch.no_grad():
        actions = alg.act(obs)
    after, rewards, dones, extras = task.step(actions)
    parts = (obs, actions, rewards, dones, extras["time_outs"], after, extras["final_observations"], extras)
    from legged_torque.learning.protocols import Transition

    with NoWaiting():
        with torch.no_grad():
            alg.observe(Transition(*parts))
        for actor_learns in (True, False):
            alg.take_gradient_step(actor_learns)
    assert addresses() == before


def test_numbers_that_are_not_finite():
    """A gradient step with one of them changes no weight, is counted, and training is told that nothing is learned."""
    trainer = make("flashsac.updates_per_step=1", "flashsac.mini_batch_size=500")
    trainer.learn(2)
    trainer.alg.replay._steps["_rewards"].fill_(math.nan)
    before = {name: value.clone() for name, value in trainer.alg.critic.named_parameters()}
    numbers = trainer.alg.update()
    assert numbers["skipped_updates"] >= 8
    assert all(torch.equal(value, before[name]) for name, value in trainer.alg.critic.named_parameters())


@pytest.mark.parametrize("task", ["a1_position", "a1_torque_multihead", "a1_rough_position_scan"])
def test_robots_learn_and_export(task, tmp_path):
    """Every parameter of actor and critics moves, half of each batch is mirror images, and an export is the policy."""
    pytest.importorskip("onnxruntime")
    from legged_torque.deploy.export import export_policy
    from legged_torque.deploy.policy import Policy

    runner = make_runner(task, tmp_path)
    alg, env = runner.alg, runner.env
    before = {name: value.clone() for name, value in (*alg.actor.named_parameters(), *alg.critic.named_parameters())}
    runner.learn(3, init_at_random_ep_len=True)
    for name, value in (*alg.actor.named_parameters(), *alg.critic.named_parameters()):
        assert torch.isfinite(value).all() and not torch.equal(value, before[name]), name
    batch = alg._sample()
    assert len(batch.obs) == len(batch.weights) == 2 * 64
    for name, values in (
        ("policy", batch.next_obs["policy"]),
        ("critic", batch.obs["critic"]),
        ("actions", batch.actions),
    ):
        torch.testing.assert_close(env.mirror(name, values[64:]), values[:64])
    if task == "a1_torque_multihead":
        model, training = alg.policy().eval(), {"run": "r", "checkpoint": "m", "iterations": 3, "total_steps": 96}
        _, unsupported = export_policy(env, model, tmp_path / "out", task, training)
        obs = env.get_observations()
        with torch.no_grad():
            expected = model(obs).numpy()
        policy = Policy(tmp_path / "out")
        np.testing.assert_allclose([policy.act(row) for row in obs["policy"].numpy()], expected, atol=1e-5)
        assert not unsupported and 0.0 < np.abs(expected).max() <= 4.0


REFUSED = {
    "flashsac.mini_batch_size=0": "flashsac.mini_batch_size must be at least 1",
    "flashsac.critic.num_bins=1": "flashsac.critic.num_bins must be from 2",
    "flashsac.buffer_min_length=4001": "flashsac.replay_buffer_size, 4000",
    "flashsac.buffer_min_length=7": "flashsac.buffer_min_length must be from 8",
    "flashsac.replay_buffer_size=10**12": "flashsac.replay_buffer_size",
    "flashsac.replay_buffer_size=900_000_000_000": "GiB",
    "algorithm.symmetry_cfg.use_mirror_loss=true": "use_mirror_loss",
    "algorithm.clip_param=0.1": "algorithm.clip_param is not read",
    "actor.hidden_dims=[8]": "actor.hidden_dims is not read",
    "algorithm.class_name=mine:Learner": "mine:Learner",
}


@pytest.mark.parametrize("change", REFUSED)
def test_mistakes(tmp_path, change):
    """One line, exit status 2, and no run."""
    words = [
        f"--set={item}"
        for item in (*SIZES, change)
        if not item.startswith(change.split("=")[0] + "=") or item == change
    ]
    small = [word for word in SMALL if "num_steps_per_env" not in word]
    result = run_here("train.py", *small, "--preset=flashsac", *words, root=tmp_path)
    assert_told_in_one_line(result, REFUSED[change])
    assert not list(tmp_path.rglob("config.yaml"))


def test_settings_of_flashsac_are_refused_with_ppo():
    """PPO would not read them."""
    assert "flashsac.n_steps is not read" in error_of(get_cfgs, "--set=flashsac.n_steps=1")
