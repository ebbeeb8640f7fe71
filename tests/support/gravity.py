"""A small gravity pre-training."""

TASK = "a1_torque_gravity"
SMALL = ["--device=cpu", "--num_envs=16"]
FEW = {"num_rounds": 2, "num_epochs": 3, "batch_size": 16}
CONFIGURATIONS, STEPS = 41, 6
STD = "distribution.log_std_param"


def words_of(**changes):
    """Changes of the settings of pre-training, as words of a command line."""
    return [f"--set=pretraining.{name}={value}" for name, value in changes.items()]
