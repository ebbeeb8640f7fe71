"""An off-policy learner from outside the package, in a task from outside the package."""

import copy

import torch
from rsl_rl.modules import MLP
from support.point_masses import PointMasses, assert_holds_points, make_trainer
from support.settings import build_runner, error_of

from legged_torque.learning.protocols import check_methods

GAMMA, BATCH, CAPACITY = 0.9, 64, 100


class Policy(torch.nn.Module):
    """Bounded actions from the group "policy"."""

    def __init__(self, num_obs, num_actions):
        super().__init__()
        self.mlp = MLP(num_obs, num_actions, [32], "elu")

    def forward(self, obs):
        return torch.tanh(self.mlp(obs["policy"]))


class TDLearner:
    """Deterministic policy gradient, with a replay buffer on the device."""

    capturable = False
    needs_next_obs = True

    def __init__(self, num_obs, num_actions, num_envs, device):
        self.actor = Policy(num_obs, num_actions).to(device)
        self.critic = MLP(num_obs + num_actions, 1, [64], "elu").to(device)
        self.target = copy.deepcopy(self.critic)
        self.optimizers = [torch.optim.Adam(module.parameters(), 3e-3) for module in (self.actor, self.critic)]
        sizes = {"obs": num_obs, "actions": num_actions, "rewards": 1, "ended": 1, "next_obs": num_obs}
        self.buffer = {name: torch.zeros(CAPACITY, num_envs, size, device=device) for name, size in sizes.items()}
        self.count = 0

    @classmethod
    def construct_algorithm(cls, obs, env, cfg, device):
        return cls(obs["policy"].shape[1], env.num_actions, env.num_envs, device)

    def act(self, obs):
        actions = self.actor(obs)
        return (actions + 0.3 * torch.randn_like(actions)).clamp(-1.0, 1.0)

    def observe(self, t):
        ended = t.dones & ~t.time_outs  # after a time-out an episode would have gone on
        kept = (t.obs["policy"], t.actions, t.rewards[:, None], ended[:, None], t.next_obs["policy"])
        for rows, values in zip(self.buffer.values(), kept, strict=True):
            rows[self.count % CAPACITY] = values
        self.count += 1

    def due(self):
        return self.count >= 16

    def update(self):
        losses = torch.stack([self.take_step() for _ in range(10)]).mean(dim=0)
        return {"actor": losses[0], "critic": losses[1], "learning_rate": 3e-3}

    def take_step(self):
        rows = torch.randint(min(self.count, CAPACITY), (BATCH,)), torch.randint(self.buffer["obs"].shape[1], (BATCH,))
        obs, actions, rewards, ended, next_obs = (values[rows] for values in self.buffer.values())
        with torch.no_grad():
            following = self.target(torch.cat([next_obs, self.actor({"policy": next_obs})], dim=1))
            wanted = rewards + GAMMA * (1.0 - ended) * following
        critic_loss = (self.critic(torch.cat([obs, actions], dim=1)) - wanted).square().mean()
        actor_loss = -self.critic(torch.cat([obs, self.actor({"policy": obs})], dim=1)).mean()
        for loss, model in ((actor_loss, self.actor), (critic_loss, self.critic)):
            model.zero_grad()
            loss.backward(inputs=list(model.parameters()))
        for optimizer in self.optimizers:
            optimizer.step()
        for old, new in zip(self.target.parameters(), self.critic.parameters(), strict=True):
            old.data.lerp_(new.data, 0.05)
        return torch.stack([actor_loss, critic_loss]).detach()

    def policy(self):
        return self.actor

    def parts(self):
        names = ("actor", "critic", "target", "actor_optimizer", "critic_optimizer")
        return dict(zip(names, (self.actor, self.critic, self.target, *self.optimizers), strict=True))

    def state_dict(self):
        state = {name: copy.deepcopy(part.state_dict()) for name, part in self.parts().items()}
        return {**state, "buffer": {name: rows.clone() for name, rows in self.buffer.items()}, "count": self.count}

    def load_state_dict(self, state):
        for name, part in self.parts().items():
            part.load_state_dict(state[name])
        for name, rows in self.buffer.items():
            rows.copy_(state["buffer"][name])
        self.count = state["count"]


def test_it_learns_to_hold_point_masses():
    """Its policy drives every point to 0, from which it was anywhere before."""
    torch.manual_seed(0)
    trainer = make_trainer(TDLearner)
    assert_holds_points(trainer)
    assert int(trainer.env.total_steps) == 60 * 8 * 8


def test_next_observations_are_those_before_resets():
    """Every kept transition is that of the points' motion, also where an episode has ended."""
    torch.manual_seed(1)
    trainer = make_trainer(TDLearner)
    trainer.learn(6)
    kept = {name: rows[: trainer.alg.count] for name, rows in trainer.alg.buffer.items()}
    torch.testing.assert_close(kept["next_obs"], kept["obs"] + 0.2 * kept["actions"])
    began_anew = (kept["obs"][1:] - kept["next_obs"][:-1]).abs() > 1e-6
    assert began_anew.any() and not began_anew.all()


def test_no_update_before_it_is_due(tmp_path):
    """Two rollouts of 8 steps come before the first update; all of them count as iterations."""
    trainer = make_trainer(TDLearner, tmp_path)
    before = copy.deepcopy(trainer.alg.policy().state_dict())
    trainer.learn(1)
    assert all(torch.equal(value, before[name]) for name, value in trainer.alg.policy().state_dict().items())
    trainer.learn(1)
    assert not all(torch.equal(value, before[name]) for name, value in trainer.alg.policy().state_dict().items())
    assert trainer.current_learning_iteration == 2


def test_two_and_two_are_four(tmp_path):
    """A training that was resumed has the same bits as one that never stopped, the replay buffer included."""
    for folder, iterations in (("whole", 4), ("half", 2), ("resumed", 2)):
        torch.manual_seed(3)
        trainer = make_trainer(TDLearner, tmp_path / folder)
        if folder == "resumed":
            trainer.resume(str(tmp_path / "half" / "model_2.pt"))
        trainer.learn(iterations)
    whole, resumed = (torch.load(tmp_path / name / "model_4.pt", weights_only=True) for name in ("whole", "resumed"))
    assert resumed["iter"] == whole["iter"] == resumed["count"] // 8 == 4
    for name in ("actor", "critic", "target", "buffer"):
        assert whole[name].keys() and all(torch.equal(value, resumed[name][key]) for key, value in whole[name].items())


def test_what_does_not_fit_is_refused(make_task):
    """The lines name the learner, the task and what is missing."""
    deaf = type("Deaf", (TDLearner,), {"observe": property()})
    message = error_of(make_trainer, deaf)
    assert message == "algorithm.class_name: Deaf is no learner, it lacks observe"
    message = error_of(check_methods, type("Idle", (TDLearner,), {"construct_algorithm": None}))
    assert message == "algorithm.class_name: Idle is no learner, it lacks construct_algorithm"
    message = error_of(build_runner, make_task, "a1_torque", **{"algorithm.class_name": "PPO"})  # rsl_rl's own
    assert message.endswith(": PPO is no learner, it lacks observe, due, policy, state_dict, load_state_dict")
    blind = type("Blind", (TDLearner,), {"policy": lambda learner: None})
    assert error_of(make_trainer, blind) == "Blind.policy must return what computes actions, not None"
    mute = make_trainer(type("Mute", (TDLearner,), {"update": lambda learner: None}))
    assert error_of(mute.learn, 2) == "Mute.update must return a dictionary of numbers, not None"
    forgetful = type("Forgetful", (PointMasses,), {"keep_final_observations": property()})
    message = error_of(make_trainer, TDLearner, task=forgetful())
    assert message == "TDLearner needs observations before resets, which Forgetful does not keep"


def test_a_learner_of_one_process(tmp_path, monkeypatch):
    """It does not train in several, in which it may act; without a log, its steps are counted, too."""
    trainer = make_trainer(TDLearner)
    trainer.learn(2)
    trainer.save(str(tmp_path / "model.pt"))
    state = torch.load(tmp_path / "model.pt", weights_only=True)
    assert state["infos"]["total_timesteps"] == 2 * 8 * trainer.env.num_envs and state["infos"]["seconds"] > 0.0
    monkeypatch.setenv("WORLD_SIZE", "2")
    make_trainer(TDLearner)
    assert error_of(make_trainer, TDLearner, tmp_path).startswith("TDLearner trains in one process only")
