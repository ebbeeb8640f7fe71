"""``mujoco.sysid``, MuJoCo's own identification, finds the same of a joint whose other numbers it knows."""

import mujoco
import numpy as np
import pytest
from support.one_leg import NUMBERS, PERIOD, TRUTH, fixed, record, sweep

from legged_torque.identification.fit import Problem
from legged_torque.identification.worlds import HangingRobots

sysid = pytest.importorskip("mujoco.sysid", reason="this MuJoCo has no sysid")
pytest.importorskip("colorama", reason="not installed: pip install 'mujoco[sysid]'")
STEP, THIGH = 5e-4, "FR_thigh_joint"


def test_same_as_sysid(leg):
    """Armature and Coulomb friction of the thigh, from its positions."""
    recording, spec, params = record(leg, sweep(2.0)), fixed(leg, STEP), sysid.ParameterDict()
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    for motor, bias in zip(spec.actuators, TRUTH[3], strict=True):
        motor.biastype, motor.biasprm[:3] = mujoco.mjtBias.mjBIAS_AFFINE, (20.0 * bias, -20.0, -0.5)
        motor.ctrllimited = False
    sensed = {"objtype": mujoco.mjtObj.mjOBJ_JOINT, "objname": THIGH}
    spec.add_sensor(name=THIGH, type=mujoco.mjtSensor.mjSENS_JOINTPOS, **sensed)
    for name, high in {"armature": 0.1, "frictionloss": 1.0}.items():
        change = lambda spec, to, name=name: setattr(spec.joint(THIGH), name, to.value[0])  # noqa: E731
        params.add(sysid.Parameter(name, 0.3 * high, min_value=1e-3 * high, max_value=high, modifier=change))
    model, substeps = spec.compile(), round(PERIOD / STEP)
    steps, ticks = np.arange(substeps * len(recording.commands)), np.arange(len(recording.commands))
    sent = np.maximum(steps - round(TRUTH[4, 0] / STEP), 0) // substeps
    control = sysid.TimeSeries(steps * STEP, 20.0 * recording.commands[sent, 1])
    seen = recording.measured[:, 0] + TRUTH[3]
    positions = sysid.TimeSeries.from_names(ticks * PERIOD + STEP, seen[:, 1:2], model)
    start = sysid.create_initial_state(model, seen[0], recording.measured[0, 1], np.zeros(0))
    sequences = sysid.ModelSequences("leg", spec, "sweep", start, control, positions)
    found, _ = sysid.optimize(params, sysid.build_residual_fn(models_sequences=[sequences]), verbose=False)
    numbers, _, _ = Problem(HangingRobots(leg, recording, "cpu"), recording).refine(1.02 * NUMBERS, lambda: None)
    np.testing.assert_allclose(numbers[[1, 7]], found.as_vector(), rtol=0.01)
