// Runs on the page, again after a lost connection: the looks of its panels, and steering with held keys and a gamepad,
// for which viser has no events. Steering sets FIELD, an input of viser, to shares of the largest v_x, v_y and yaw rate,
// -1 to 1, whenever held keys (W S, A D, arrows) or the sticks of a gamepad change them.
const isRunning = Boolean(window.steering);
window.steering = {field: "FIELD", sent: isRunning ? "" : "0,0,0"};  // after a lost connection, send again
if (isRunning) return;

document.head.insertAdjacentHTML("beforeend", `<style>
  .lt-status { font-size: 13px; line-height: 1.5; padding: 4px 12px }
  .lt-error { color: #e03131 }
  .lt-keys { font-size: 12px; padding: 0 12px }
  .lt-plot { font-size: 12px; padding: 4px 10px }
  .lt-legend > span { margin-right: 12px; white-space: nowrap; font-weight: normal }
  .lt-row { display: flex; align-items: center; gap: 6px; height: 17px }
  .lt-row > :first-child { width: 52px; white-space: nowrap }
  .lt-wide > :first-child { width: 116px }
  .lt-row > svg { flex: 1; min-width: 0; height: 13px; background: #8882; border-radius: 2px }
  .lt-row > :last-child { width: 58px; text-align: right; font-variant-numeric: tabular-nums }
</style>`);

const keys = {KeyW: [0, 1], ArrowUp: [0, 1], KeyS: [0, -1], ArrowDown: [0, -1], KeyA: [1, 1], KeyD: [1, -1],
              ArrowLeft: [2, 1], ArrowRight: [2, -1]};
const held = new Set();
const press = event => {
  const uses = event.code.startsWith("Arrow") ? "input, textarea, [role]:not([role=dialog])" : "input, textarea";
  if (!(event.code in keys) || event.ctrlKey || event.metaKey || event.altKey || event.target.closest?.(uses)) return;
  held.add(event.code);
  event.preventDefault();
  event.stopImmediatePropagation();  // these keys would move viser's camera
};
addEventListener("keydown", press, true);
addEventListener("keyup", event => held.delete(event.code), true);
addEventListener("blur", () => held.clear());
setInterval(() => {
  const shares = [0, 0, 0];
  for (const code of held) shares[keys[code][0]] += keys[code][1];
  const pad = navigator.getGamepads?.().find(each => each?.mapping === "standard");
  if (pad) [1, 0, 2].forEach((axis, i) => { if (Math.abs(pad.axes[axis]) > 0.12) shares[i] -= pad.axes[axis]; });
  const value = shares.map(share => Math.max(-1, Math.min(1, share)));
  if (value.join() === window.steering.sent) return;
  window.steering.sent = value.join();
  window.__viserMutable.sendMessage({type: "GuiUpdateMessage", uuid: window.steering.field, updates: {value}});
}, 50);
