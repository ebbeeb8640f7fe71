// Runs on the page, again after a lost connection: the looks of its panels, hints on labels, keys that press controls,
// and steering with held keys and a gamepad, for which viser has no events. Steering sets page.field, an input of viser,
// to shares of the largest v_x, v_y and yaw rate, -1 to 1, whenever held keys or the sticks of a gamepad change them.
const isRunning = Boolean(window.steering);
window.steering = {...page, sent: isRunning ? "" : "0,0,0"};  // after a lost connection, send again
if (isRunning) return;

document.head.insertAdjacentHTML("beforeend", `<style>
  .lt-status { font-size: 13px; line-height: 1.5; padding: 4px 12px }
  .lt-error { color: #e03131 }
  .lt-keys { font-size: 12px; padding: 0 12px }
  .lt-plot { font-size: 12px; padding: 4px 10px }
  .lt-plot td + td { width: 62px; text-align: right; font-variant-numeric: tabular-nums }
  table.lt-plot { width: 100%; padding: 6px 10px; line-height: 1.25 }
  .lt-legend > span { margin-right: 12px; white-space: nowrap; font-weight: normal }
  .lt-row { display: flex; align-items: center; gap: 6px; height: 17px }
  .lt-row > :first-child { width: 52px; white-space: nowrap }
  .lt-wide > :first-child { width: 116px }
  .lt-row > svg { flex: 1; min-width: 0; height: 13px; background: #8882; border-radius: 2px }
  .lt-row > :last-child { width: 58px; text-align: right; font-variant-numeric: tabular-nums }
  @media (max-width: 36em) {  /* viser's layout for phones: a sheet, here as wide as the page, plots first */
    [style*="max-height: 60%"], [style*="max-height: 60%"] [style="width: 20em;"] { width: 100% !important }
    div:has(> * > .mantine-Tabs-root) { display: flex; flex-direction: column }
    div:has(> .mantine-Tabs-root) { order: -1 }
  }
  .mantine-Notification-description { overflow-wrap: anywhere }
</style>`);

addEventListener("pointerover", event => {
  const label = event.target.closest?.("label");
  if (label) label.title = window.steering.hints[label.htmlFor] ?? "";
});

const keys = {KeyW: [0, 1], ArrowUp: [0, 1], KeyS: [0, -1], ArrowDown: [0, -1], KeyA: [1, 1], KeyD: [1, -1],
              ArrowLeft: [2, 1], ArrowRight: [2, -1], Comma: [1, 1], Period: [1, -1]};
const held = new Set();
const typing = "textarea, input:not([type=checkbox])";
const press = event => {
  const control = window.steering.controls[event.code];
  const uses = event.code === "Space" ? "textarea, input, button" :
      event.code.startsWith("Arrow") ? `${typing}, [role]:not([role=dialog])` : typing;
  if (!(event.code in keys || control) || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.target.closest?.(uses)) return;
  if (event.code in keys) held.add(event.code);
  else if (!event.repeat) document.getElementById(control)?.click();
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
