"""Identification replays a log as CUDA graphs."""

import numpy as np
from support.one_leg import TRUTH, one_leg, record, sweep

from legged_torque.identification.worlds import HangingRobots


def test_replays_a_log(device, tmp_path):
    """Whatever the robots were before, they are where plain MuJoCo has a robot with their numbers."""
    cfg = one_leg(tmp_path)
    known = record(cfg, sweep(1.5))
    robots = HangingRobots(cfg, known, device, 4)
    for numbers in (2.0 * TRUTH, 0.5 * TRUTH, TRUTH):
        seen = robots.run(np.tile(numbers, (robots.num_worlds, 1, 1)), len(known.commands)).cpu().numpy()
    for number, atol in enumerate((2e-5, 2e-3)):
        np.testing.assert_allclose(seen[:, 5, number], known.measured[:, number], atol=atol)
    np.testing.assert_array_equal(seen[:, 0], seen[:, -1])
