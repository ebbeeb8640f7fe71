"""Settings of decaying action priors, see :mod:`~legged_torque.envs.approaches.decap`."""

from legged_torque.envs.approaches.torque_config import TorqueCfg
from legged_torque.utils.config import Section
from legged_torque.utils.limits import Fraction, Positive


class DecapCfg(TorqueCfg):
    """Settings of torque control with a decaying bias; the authors' gains are 20 N m/rad and 0.5 N m s/rad."""

    class control:
        class decap(Section):
            gamma: Fraction = 0.99  # factor on the bias every
            k: Positive = 409_600.0  # total steps: the authors' 100 control steps, in 4096 worlds
            record: str = ""  # CSV file of the reference by joint [rad], from an episode's start; empty: nominal pose
            row_time: Positive = 0.02  # [s] for which a row of it is the reference

            def scale_steps(self, factor: float) -> None:
                """Let the bias decay in ``factor`` times the steps."""
                self.k *= factor

    class rewards:
        imitation_temperature: Positive = 10.0  # of the term

        class scales:
            imitation_angles: float = 0.0  # joint angles near the reference; the authors try 0.75 to 15
