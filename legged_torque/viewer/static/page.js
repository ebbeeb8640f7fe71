/** The page: it loads the robot and its policy, runs them in real time, and lets one steer and push. */

import loadMujoco from "mujoco";
import * as ort from "onnxruntime-web";

import { Policy } from "./policy.js";
import { Robot } from "./robot.js";
import { Scene } from "./scene.js";

const KEYS = { w: [0, 1], s: [0, -1], a: [1, 1], d: [1, -1], q: [2, 1], e: [2, -1] }; // command and direction
const COMMANDS = ["lin_vel_x", "lin_vel_y", "ang_vel_yaw"];
const MOST_BEHIND = 0.25; // simulated time that a slow machine may catch up on in a frame [s]; what is more is lost
const PUSH = 1.0; // [m/s]

const element = (id) => document.getElementById(id);
const fetched = async (name) => {
  const response = await fetch(name);
  if (!response.ok) throw new Error(`${name}: ${response.status} ${response.statusText}`);
  return response;
};
const bytes = async (name) => new Uint8Array(await (await fetched(name)).arrayBuffer());

/** One robot that a policy drives, in steps of the policy. */
export class Simulation {
  constructor(robot, policy) {
    Object.assign(this, { robot, policy, command: [0, 0, 0], torques: policy.joints.map(() => 0), time: 0, falls: 0 });
  }

  /** Starts an episode. */
  reset() {
    this.robot.reset();
    this.policy.reset();
  }

  /** Advances by one control step; a robot that has fallen starts anew. */
  async step() {
    const { robot, policy } = this;
    const actions = await policy.act(policy.observation(robot.state(), this.command));
    let wanted;
    for (let i = 0; i < policy.timing.decimation; i++) {
      const [qpos, qvel] = [robot.positions(), robot.velocities()];
      if (i === 0 || policy.timing.refresh_torques) wanted = policy.wantedTorques(actions, qpos, qvel);
      this.torques = policy.applyMotors(wanted, qpos, qvel);
      robot.step(this.torques);
    }
    this.time += 1 / policy.timing.control_frequency;
    if (robot.hasFallen()) {
      this.falls += 1;
      this.reset();
    }
  }
}

/** Loads everything and returns the simulation. */
async function load(page) {
  ort.env.wasm.numThreads = 1; // more need headers that a plain file server does not send
  const files = await Promise.all(page.robot.files.map(async (name) => [name, await bytes(`robot/${name}`)]));
  const session = await ort.InferenceSession.create(await bytes("policy.onnx"));
  return new Simulation(new Robot(await loadMujoco(), files, page), new Policy(page, session, ort.Tensor));
}

/** Connects sliders, keys and buttons with the simulation, and returns a function that shows its state. */
function controls(page, simulation) {
  const { robot, policy } = simulation;
  const ranges = COMMANDS.map((name) => page.description.commands[name]);
  const sliders = COMMANDS.map(element);
  sliders.forEach((slider, i) => {
    [slider.min, slider.max] = ranges[i];
    slider.value = 0;
    if (slider.valueAsNumber !== 0) slider.step = "any"; // no step leads there, and the robot could not stand
    slider.value = i ? 0 : 0.5 * ranges[i][1];
  });
  const steer = () => (simulation.command = sliders.map((slider) => Number(slider.value)));
  sliders.forEach((slider) => slider.addEventListener("input", steer));
  steer();
  document.addEventListener("keydown", ({ key, repeat, ctrlKey, metaKey, altKey }) => {
    const [i, direction] = KEYS[key?.toLowerCase()] ?? []; // of what a browser fills in there is none
    if (i === undefined || repeat || ctrlKey || metaKey || altKey) return;
    sliders[i].value = Number(sliders[i].value) + 0.25 * direction * ranges[i][1];
    steer();
  });
  const push = () => {
    const angle = 2 * Math.PI * Math.random();
    robot.push([PUSH * Math.cos(angle), PUSH * Math.sin(angle)]);
  };
  element("push").addEventListener("click", push);
  element("stop").addEventListener("click", () => {
    sliders.forEach((slider) => (slider.value = 0));
    steer();
  });
  element("reset").addEventListener("click", () => simulation.reset());
  const bars = policy.joints.map((name, i) => {
    const bar = document.createElement("meter");
    [bar.min, bar.max] = [0, policy.torqueLimits[i][1]];
    bar.title = name;
    const row = document.createElement("label");
    row.append(name.replace("_joint", ""), bar);
    element("torques").append(row);
    return bar;
  });
  return (factor, rate) => {
    bars.forEach((bar, i) => (bar.value = Math.abs(simulation.torques[i])));
    const velocity = robot.planarVelocity();
    ranges.forEach((_, i) => {
      element(`${COMMANDS[i]}_text`).textContent = `${simulation.command[i].toFixed(2)} / ${velocity[i].toFixed(2)}`;
    });
    const falls = `${simulation.falls} ${simulation.falls === 1 ? "fall" : "falls"}`;
    element("status").textContent = `${simulation.time.toFixed(0)} s, ${falls}, ${factor.toFixed(2)} x real time, ${rate.toFixed(0)} frames/s`;
  };
}

/** Runs the simulation in real time, for as long as the page is open. */
async function main() {
  const page = await (await fetched("page.json")).json();
  document.title = element("title").textContent = page.title;
  element("notes").replaceChildren(...page.notes.map((note) => Object.assign(document.createElement("li"), { textContent: note })));
  const simulation = await load(page);
  const scene = new Scene(element("view"), simulation.robot.model);
  const show = controls(page, simulation);
  const step = 1 / page.description.timing.control_frequency;
  let [last, behind, since, simulated, frames] = [performance.now(), 0, performance.now(), 0, 0];
  Object.assign(window, { simulation, scene });
  const frame = async (now) => {
    behind = Math.min(behind + (now - last) / 1000, MOST_BEHIND + step);
    last = now;
    for (; behind >= step && !element("pause").checked; behind -= step) await simulation.step();
    scene.update(simulation.robot.data, page.robot.trunk);
    scene.render();
    frames += 1;
    if (now - since > 500) {
      const passed = (now - since) / 1000;
      if (passed < 1) scene.adapt(passed / frames); // else the page was hidden
      show((simulation.time - simulated) / passed, frames / passed);
      [since, simulated, frames] = [now, simulation.time, 0];
    }
    requestAnimationFrame((next) => frame(next).catch(report));
  };
  requestAnimationFrame((now) => frame(now).catch(report));
}

/** Says on the page why it cannot go on. */
function report(error) {
  element("status").textContent = `This page has stopped: ${error.message ?? error}`;
  element("status").className = "error";
  console.error(error);
}

main().catch(report);
