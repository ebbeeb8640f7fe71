/** An exported policy: observations, actions and torques of one robot, as legged_torque/deploy/policy.py has them. */

const clip = (value, low, high) => Math.min(Math.max(value, low), high);

/** Returns the unscaled values of an observation term, by its name. */
const OBSERVATIONS = {
  projected_gravity: (policy, state) => state.gravity,
  angular_velocity: (policy, state) => state.angularVelocity,
  command: (policy, state, command) => command,
  joint_position: (policy, state) => state.qpos.map((q, i) => q - policy.nominalPose[i]),
  joint_velocity: (policy, state) => state.qvel,
  last_action: (policy) => policy.lastAction,
};

/** Returns the torque of an action term at a joint [N m], by the term's name. */
const ACTIONS = {
  position_residual: (policy, i, scaled, q, qd) =>
    policy.stiffness[i] * (policy.nominalPose[i] + scaled - q) - policy.damping[i] * qd,
  torque: (policy, i, scaled) => scaled,
};

/** Returns the torque that a motor makes of the one asked for, by its model; see legged_torque/motors/formulas.py. */
const MOTORS = {
  ideal: (policy, motor, i, torque) => clip(torque, ...policy.torqueLimits[i]),
  drive: (policy, motor, i, torque, q, qd) =>
    torque + motor.stiffness[i] * (policy.nominalPose[i] - q) - motor.damping[i] * qd,
  curve: (policy, motor, i, torque, q, qd) => {
    const share = (motor.no_load_speed[i] - Math.abs(qd)) / Math.max(motor.no_load_speed[i] - motor.knee_speed[i], 1e-6);
    const most = torque * qd > 0 ? motor.driving_torque[i] * clip(share, 0, 1) : motor.braking_torque[i];
    return clip(torque, -most, most);
  },
  friction: (policy, motor, i, torque, q, qd) => {
    const fading = Math.exp(-((qd / motor.stribeck_speed[i]) ** 2));
    const [held, moving] = [motor.static_friction[i], motor.coulomb_friction[i]];
    const dry = moving + motor.load_friction[i] * Math.abs(torque) + (held - moving) * fading;
    return torque - dry * Math.tanh(qd / motor.activation_speed[i]) - motor.viscous_friction[i] * qd;
  },
};

/** Runs a policy: observation() and act() once per control step, applyMotors() at every physics step. */
export class Policy {
  /** Takes the contents of page.json and a session of onnxruntime-web, whose class Tensor it needs. */
  constructor(page, session, Tensor) {
    const { description } = page;
    const byJoint = (values) => description.joint_order.map((name) => values[name]);
    this.joints = description.joint_order;
    this.nominalPose = byJoint(description.nominal_pose);
    this.stiffness = byJoint(description.gains.stiffness);
    this.damping = byJoint(description.gains.damping);
    this.torqueLimits = byJoint(description.torque_limits);
    this.timing = description.timing;
    this.motors = page.motors;
    this.terms = description.observations.terms;
    this.actions = description.actions;
    this.session = session;
    this.Tensor = Tensor;
    this.reset();
  }

  /** Starts an episode. */
  reset() {
    this.lastAction = new Array(this.actions.terms.length * this.joints.length).fill(0);
  }

  /** Returns the network's input; commands are v_x, v_y [m/s] and yaw rate [rad/s] in the trunk's frame. */
  observation(state, command) {
    const values = this.terms.map(({ name, scale, clip: [low, high] }) =>
      Array.from(OBSERVATIONS[name](this, state, command)).map((value, i) =>
        clip(value * (Array.isArray(scale) ? scale[i] : scale), low, high),
      ),
    );
    return Float32Array.from(values.flat());
  }

  /** Returns clipped mean actions; an error if they are not finite. */
  async act(observation) {
    const obs = new this.Tensor("float32", observation, [1, observation.length]);
    const { actions } = await this.session.run({ obs });
    if (!actions.data.every(Number.isFinite)) throw new Error("the network's actions are not finite");
    this.lastAction = Array.from(actions.data).map((action) => clip(action, ...this.actions.clip));
    return this.lastAction;
  }

  /** Returns the torques that actions ask for at joint positions [rad] and velocities [rad/s] [N m]. */
  wantedTorques(actions, qpos, qvel) {
    return this.joints.map((_, i) => {
      let torque = 0;
      this.actions.terms.forEach(({ name, scale, mixing_weight: weight }, term) => {
        const scaled = scale * actions[term * this.joints.length + i];
        torque += weight * ACTIONS[name](this, i, scaled, qpos[i], qvel[i]);
      });
      return torque;
    });
  }

  /** Returns what the motors make of torques that are asked for [N m]. */
  applyMotors(torques, qpos, qvel) {
    return torques.map((wanted, i) =>
      this.motors.reduce((made, motor) => MOTORS[motor.model](this, motor, i, made, qpos[i], qvel[i]), wanted),
    );
  }
}
