/** The robot in MuJoCo; vectors of joints are in the policy's order and about its axes, not the MJCF's. */

const FOLDER = "/robot";

export class Robot {
  /** Takes the module @mujoco/mujoco, the robot's files by name, the first of them the MJCF, and page.json. */
  constructor(mujoco, files, page) {
    this.mujoco = mujoco;
    this.page = page;
    mujoco.FS.mkdir(FOLDER);
    for (const [name, content] of files) mujoco.FS.writeFile(`${FOLDER}/${name}`, content);
    this.model = mujoco.MjModel.from_xml_path(`${FOLDER}/${files[0][0]}`);
    this.model.opt.timestep = 1 / page.description.timing.physics_frequency;
    this.data = new mujoco.MjData(this.model);
    const { qpos, dofs, motors, signs, torque_per_control, ending_geoms } = page.robot;
    Object.assign(this, { qposadr: qpos, dofadr: dofs, motors, signs, torquePerControl: torque_per_control });
    this.ending = new Set(ending_geoms);
    this.reset();
  }

  /** Puts the robot where episodes start, upright and at rest. */
  reset() {
    this.mujoco.mj_resetData(this.model, this.data);
    const { qpos } = this.data;
    qpos.set(this.page.description.initial_state.trunk_position);
    qpos.set([1, 0, 0, 0], 3);
    this.qposadr.forEach((address, i) => (qpos[address] = this.signs[i] * this.page.nominal_pose[i]));
    this.mujoco.mj_forward(this.model, this.data);
  }

  /** Advances by one physics step with torques [N m]. */
  step(torques) {
    const { ctrl } = this.data;
    this.motors.forEach((motor, i) => (ctrl[motor] = torques[i] / this.torquePerControl[i]));
    this.mujoco.mj_step(this.model, this.data);
  }

  /** Returns joint positions [rad]. */
  positions() {
    const { qpos } = this.data;
    return this.qposadr.map((address, i) => this.signs[i] * qpos[address]);
  }

  /** Returns joint velocities [rad/s]. */
  velocities() {
    const { qvel } = this.data;
    return this.dofadr.map((address, i) => this.signs[i] * qvel[address]);
  }

  /** Returns the measurements of perfect sensors. */
  state() {
    const { qpos, qvel } = this.data;
    return {
      gravity: inTrunk(qpos, [0, 0, -1]),
      angularVelocity: qvel.slice(3, 6),
      qpos: this.positions(),
      qvel: this.velocities(),
    };
  }

  /** Returns v_x, v_y [m/s] and yaw rate [rad/s] in the trunk's frame, as commands are. */
  planarVelocity() {
    const { qpos, qvel } = this.data;
    return [...inTrunk(qpos, qvel).slice(0, 2), qvel[5]];
  }

  /** Adds a velocity to the trunk's, in the world [m/s]. */
  push(velocity) {
    const { qvel } = this.data;
    velocity.forEach((value, i) => (qvel[i] += value));
  }

  /** Returns whether a geom that ends episodes touched something in the last step, or the state has diverged. */
  hasFallen() {
    if (!this.data.qpos.every(Number.isFinite)) return true;
    const { ncon } = this.data;
    if (!ncon) return false;
    const contacts = this.data.contact; // copies, as is each of them, which stay until they are deleted
    let touches = false;
    for (let i = 0; i < ncon && !touches; i++) {
      const contact = contacts.get(i);
      touches = this.ending.has(contact.geom1) || this.ending.has(contact.geom2);
      contact.delete();
    }
    contacts.delete();
    return touches;
  }
}

/** Returns a vector of the world in the frame of the trunk, whose pose qpos begins with. */
function inTrunk(qpos, [x, y, z]) {
  const [w, a, b, c] = [qpos[3], -qpos[4], -qpos[5], -qpos[6]];
  const [tx, ty, tz] = [2 * (b * z - c * y), 2 * (c * x - a * z), 2 * (a * y - b * x)];
  return [x + w * tx + b * tz - c * ty, y + w * ty + c * tx - a * tz, z + w * tz + a * ty - b * tx];
}
