"""Steering with held keys and a gamepad: viser has no events for them, so a script on the page sends them."""

from __future__ import annotations

from collections.abc import Callable

import viser
from viser._messages import RunJavascriptMessage

SCRIPT = """
const isRunning = Boolean(window.steering);
window.steering = {field: "FIELD", sent: isRunning ? "" : "0,0,0"};  // after a lost connection, send again
if (isRunning) return;
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
"""
"""Sets a field to shares of the largest v_x, v_y and yaw rate, -1 to 1, whenever held keys (W S, A D, arrows) or the
sticks of a gamepad change them."""


def add_steering(gui: viser.GuiApi, steer: Callable[[tuple[float, float, float]], None]) -> None:
    """Call a function with shares of the largest v_x, v_y and yaw rate, -1 to 1, whenever a user changes them."""
    field = gui.add_vector3("steering", (0.0, 0.0, 0.0), visible=False)

    async def changed(event: viser.GuiEvent) -> None:  # viser calls coroutines in the order of the changes
        if all(abs(share) <= 1.0 for share in field.value):
            steer(field.value)

    field.on_update(changed)
    script = SCRIPT.replace("FIELD", field._impl.uuid)
    gui._websock_interface.queue_message(RunJavascriptMessage(script))  # as viser itself does for Plotly
