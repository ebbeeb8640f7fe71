"""The presets that all tasks have."""

from typing import Any

from legged_torque.envs.base import distillation_config, flashsac_config


def standard_presets() -> dict[str, dict[str, Any]]:
    """Return the changes to the settings of task and training by the presets' names, see ``TrainingCfg.presets``."""
    thorough = {"runner": {"total_steps": 330_000_000}}
    named = {"parallel": {}, "laptop": laptop(), "thorough": thorough, "paper": paper()}
    return {**named, "flashsac": flashsac_config.preset(), "student": distillation_config.preset()}


def laptop() -> dict[str, Any]:
    """Return settings with which a robot walks soon on a CPU: few worlds, small networks, a short training."""
    steps = {"gamma": 0.97, "lam": 0.9, "desired_kl": 0.03}
    sizes = {"env": {"num_envs_cpu": 128}, "runner": {"total_steps": 20_000_000}, "algorithm": steps}
    networks = {name: {"hidden_dims": [128, 128]} for name in ("actor", "critic")}
    return {"linear_changes": 0.3, **sizes, **networks, "evaluation": {"interval": 500_000, "num_samples": 16_000}}


def paper() -> dict[str, Any]:
    """Return Table II; in the entropy, actions count by the weights of their torques, though."""
    ppo = {"num_learning_epochs": 5, "num_mini_batches": 32, "clip_param": 0.1, "gamma": 0.99, "lam": 0.9}
    ppo |= {"entropy_coef": 5e-4, "learning_rate": 1e-4, "max_grad_norm": 5.0}
    plain = {"schedule": "fixed", "annealing_start": 1.0, "use_mixed_precision": False}
    plain |= {"symmetry_cfg": {"use_data_augmentation": False}}
    rollouts = {"env": {"num_envs": 16, "num_envs_cpu": 16}, "runner": {"num_steps_per_env": 2000}}
    return {**rollouts, "algorithm": {**ppo, **plain}}
