"""Policies trained with and without latency, where actions are late by 20 ms."""

from support.reproducible import finish, start

from legged_torque.envs import task_registry
from legged_torque.envs.base.evaluation import evaluation_cfg
from legged_torque.envs.base.metrics import measure
from legged_torque.utils.options import Options
from legged_torque.utils.task_registry import set_seed

TASK = "a1_torque_multihead"
SHORT = ["--preset=laptop", "--num_envs=1024", "--set=algorithm.lam=0.95", "--set=algorithm.gamma=0.98"]
SHORT += ["--set=algorithm.desired_kl=0.02", "--set=control.mixing.pd.t_start=9000000"]
SHORT += ["--set=control.mixing.pd.t_end=16000000"]
LATE = ["motors.delay.range=[0,20]", "motors.delay.unit=milliseconds", "sensing.delay.range=[0,1]"]
STEPS = 400  # of a measurement


def measured(folder, device, ms):
    """Tracking, and rms joint acceleration [rad/s^2], of the last policy below a folder with actions late by ``ms``."""
    changes = [f"motors.delay.range=[{ms},{ms}]", "motors.delay.unit=milliseconds", "sensing.delay.range=[0,0]"]
    options = Options(task=TASK, load_run=str(next(folder.glob("*/*/"))), num_envs=256, device=device, set=changes)
    run = task_registry.load_run(options)
    set_seed(1)
    env, runner = task_registry.make_loaded(run, options, evaluation_cfg(run.env_cfg, 256))
    last, squares = env.dof_vel.clone(), []

    def look(commands):
        """Note the mean squared acceleration of worlds that have not just started anew."""
        change = (env.dof_vel - last) / env.dt
        squares.append((change.square().mean(dim=1) * (env.episode_length_buf > 1)).mean())
        last.copy_(env.dof_vel)

    means = measure(env, runner.get_inference_policy(device), STEPS, look).means()
    runner.close()
    return float(means["track_percentage"]), float(sum(squares) / STEPS) ** 0.5


def test_latency_must_be_trained(device, tmp_path):
    """A policy that never saw latency shakes with 20 ms of it, and one that was trained with it does not."""
    words = [f"--task={TASK}", "--perturbation=none", *SHORT, f"--device={device}"]
    finish(
        start(tmp_path / "prompt", *words),
        start(tmp_path / "late", *words, *(f"--set={change}" for change in LATE)),
    )
    (prompt, quiet), (shaken, shaking) = (measured(tmp_path / "prompt", device, ms) for ms in (0, 20))
    (_, calm), (tracked, steady) = (measured(tmp_path / "late", device, ms) for ms in (0, 20))
    assert prompt > 0.5 and tracked > 0.5
    assert shaking > 2.0 * quiet and shaken < 0.8 * prompt
    assert steady < 1.6 * calm and tracked > shaken + 0.1
