"""The ports of the pages for those who come from elsewhere: each term is what the formula of the original says."""

import mujoco
import numpy as np
import pytest
import torch
from rsl_rl.algorithms import PPO
from support.documents import make, train

from legged_torque.envs import task_registry
from legged_torque.utils.errors import UserError
from legged_torque.utils.options import Options


def test_legged_gym(run_page):
    """The policy sees the height that the reward asks for; commands are those of the original, in chosen worlds."""
    run_page("docs/howto/from_legged_gym.md")
    task = make("a1_crouching", "commands.resampling_probability=0", num_envs=64)
    height = task.get_observations()["policy"][:, -1] / 5.0
    for _ in range(3):
        obs, _, dones, _ = task.step(torch.randn(64, 12))
        assert not dones.any()
        term = task.rewards.terms[task.reward_names.index("height")]
        torch.testing.assert_close(term, -20.0 * 0.02 * (task.sim.qpos[:, 2] - height) ** 2)
        torch.testing.assert_close(obs["policy"][:, -1] / 5.0, height)
    assert "base_height" not in task.reward_names and task.observations.policy_columns("height_command") == [45]
    drawn = []
    for _ in range(100):
        task.command_generator.resample(torch.ones(64, dtype=torch.bool))
        task.compute_observations()
        drawn.append(torch.cat([task.commands, task.obs_buf["policy"][:, -1:] / 5.0], dim=1))
    low, high = torch.cat(drawn).aminmax(dim=0)
    torch.testing.assert_close(low, torch.tensor([0.3, 0.0, -1.0, 0.2]), atol=0.01, rtol=0)
    torch.testing.assert_close(high, torch.tensor([1.0, 0.0, 1.0, 0.3]), atol=0.01, rtol=0)
    assert low[0] >= 0.3 and low[3] >= 0.2 - 1e-6 and high[0] <= 1.0 and high[3] <= 0.3 + 1e-6
    before = drawn[-1]
    seen = task.reset(3)["policy"][:, -1] / 5.0
    is_new = torch.arange(64) == 3
    assert torch.equal((seen - before[:, 3]).abs() > 1e-6, is_new)
    assert torch.equal((task.commands != before[:, :3]).any(dim=1), is_new)
    assert "height_command" in task.world_state_dict()["task"]
    train(make("a1_crouching"), "a1_crouching")


def test_mjlab(run_page):
    """Power and foot heights are those of MuJoCo; the masses of calves are drawn one by one, at resets alone."""
    run_page("docs/howto/from_mjlab.md")
    task = make("go1_ported", "domain_rand.keep_fixed=[foot_pos]", num_envs=64)
    model, names = task.sim.mj_model, ("FR", "FL", "RR", "RL")
    data, feet = mujoco.MjData(model), [model.geom(f"{name}_foot").id for name in names]
    calves = [model.body(f"{name}_calf").id for name in names]
    masses = task.sim.field("body_mass")[:, calves].clone()
    for _ in range(3):
        obs, rewards, dones, _ = task.step(torch.randn(64, 12))
        assert not dones.any()
        power, height = np.zeros(64), np.zeros((64, 4))
        for world, (qpos, qvel, ctrl) in enumerate(zip(task.sim.qpos, task.sim.qvel, task.sim.ctrl, strict=True)):
            data.qpos, data.qvel, data.ctrl = qpos, qvel, ctrl
            mujoco.mj_forward(model, data)
            moved = [model.joint(f"{name}_calf_joint").dofadr[0] for name in names]
            power[world] = np.abs(data.qfrc_actuator[moved] * data.qvel[moved]).sum()
            height[world] = data.geom_xpos[feet, 2]
        term = task.rewards.terms[task.reward_names.index("calf_power")]
        np.testing.assert_allclose(term, -1e-3 * 0.02 * power, rtol=1e-4, atol=1e-7)
        np.testing.assert_allclose(rewards, task.rewards.terms.sum(dim=0), rtol=1e-4, atol=1e-6)
        assert (rewards < 0.0).any()
        columns = task.observations.policy_columns("foot_height")
        np.testing.assert_allclose(obs["critic"][:, columns], 5.0 * height, atol=1e-4)
        mirrored = task.mirror("policy", obs["policy"])[:, columns]
        assert torch.equal(mirrored, obs["policy"][:, columns][:, [1, 0, 3, 2]])
        assert 0.08 < (obs["policy"] - obs["critic"][:, :49])[:, columns].abs().max() <= 5.0 * 0.02 + 1e-5
    assert torch.equal(task.sim.field("body_mass")[:, calves], masses)
    ratio = masses / torch.tensor(model.body_mass[calves], dtype=torch.float32)
    assert ratio.min() >= 0.8 - 1e-6 and ratio.max() <= 1.2 + 1e-6 and ratio.std(dim=0).min() > 0.08
    assert torch.corrcoef(ratio.T).triu(diagonal=1).abs().max() < 0.4
    task.reset(3)
    is_new = (task.sim.field("body_mass")[:, calves] != masses).any(dim=1)
    assert torch.equal(is_new, torch.arange(64) == 3)
    train(make("go1_ported"), "go1_ported")


def test_rsl_rl(run_page, tmp_path):
    """rsl_rl's own runner and PPO train the page's task; it loads checkpoints of this library, which refuses its."""
    theirs = run_page("docs/howto/from_rsl_rl.md")["runner"]
    assert type(theirs.alg) is PPO and theirs.env.total_steps == 2 * 24 * 4
    ours, _ = task_registry.make_alg_runner(theirs.env, "a1_torque", Options(device="cpu"), log_root=None)
    ours.save(str(tmp_path / "ours.pt"))
    assert not torch.equal(theirs.alg.actor.mlp[0].weight, ours.alg.actor.mlp[0].weight)
    theirs.load(str(tmp_path / "ours.pt"))
    assert torch.equal(theirs.alg.actor.mlp[0].weight, ours.alg.actor.mlp[0].weight)
    with pytest.raises(UserError, match="lacks the entry infos"):
        ours.load(str(tmp_path / "logs" / "own" / "model_1.pt"))
