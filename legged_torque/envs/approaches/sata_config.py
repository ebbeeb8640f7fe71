"""Settings of SATA, see :mod:`~legged_torque.envs.approaches.sata`."""

from legged_torque.envs.approaches.fast_config import FastCfg, FastCfgPPO
from legged_torque.envs.approaches.torque_config import TorqueCfg
from legged_torque.motors.model_config import MuscleCfg
from legged_torque.utils.config import Section
from legged_torque.utils.limits import Fraction, NotNegative


class SataCfg(FastCfg, TorqueCfg):
    """Settings of torque control by muscles that grow; a grown robot has its whole torque, and acts at 200 Hz."""

    class motors:
        choices = {"ideal": ["delay", "muscle", "ideal"]}
        chain = ["delay", "muscle", "ideal"]

        class muscle(MuscleCfg):  # between the policy's torques and the limits
            pass

        class delay:
            loss = 0.1

    class sensing:
        class delay:
            loss = 0.1

    class control:
        torque_scale = 5.0

        class growth(Section):  # the way to a grown robot: exp(-exp(-k (t - t_mid))), t in total steps
            k: NotNegative = 3e-5 / 4096  # [1/total steps]; both for 4096 worlds, unconfirmed by the authors
            t_mid: NotNegative = 24_000.0 * 4096  # [total steps]
            torque: Fraction = 0.3  # share of the torque limits at first
            rate: Fraction = 0.5  # share of control steps with new actions at first

    class rewards:
        class scales:
            fatigue: float = -0.05  # wanted torques of tired joints; ours


class SataCfgPPO(FastCfgPPO):
    """Training of a robot until it is grown to 99%."""

    class runner:
        total_steps = 750_000_000
