// Steering by keys, a gamepad, or sticks on a touch screen: while the command `velocity` flies, a velocity goes to the service ten times a
// second, also a zero one. Without them the vehicle brakes: nothing here needs to be sent when the page is lost.

import { endOf, HEADERS, send } from "./commands.js";
import { $, setText, state } from "./state.js";

const PERIOD_MS = 100;
const LIFETIME_S = 0.4;
const DEAD_ZONE = 0.12;
// By their position on the keyboard, whatever its layout.
const KEYS = {
  KeyW: ["forward", 1], KeyS: ["forward", -1], KeyD: ["right", 1], KeyA: ["right", -1],
  ArrowUp: ["up", 1], ArrowDown: ["up", -1], ArrowRight: ["turn", 1], ArrowLeft: ["turn", -1],
};
// Axes of the Gamepad API's standard layout, as a remote control's in mode 2.
const STICKS = { turn: [0, 1], up: [1, -1], right: [2, 1], forward: [3, -1] };

const isTouch = matchMedia("(pointer: coarse)").matches;
const HINT = isTouch
  ? "Steer shows two sticks: the left one climbs and turns, the right one flies."
  : "Keys: W A S D fly, arrows climb and turn. Gamepad: left stick climbs and turns, right stick flies.";

// One of this page, also when it steers again: its last message is still valid then.
const source = `page-${Math.random().toString(36).slice(2, 10)}`;
const pressed = new Set();
const touched = { forward: 0, right: 0, up: 0, turn: 0 }; // by the sticks on the screen
let steering = null; // { vehicle, id, timer, sending }

function begin({ command_id: id }) {
  if (steering) clearInterval(steering.timer);
  pressed.clear();
  document.activeElement.blur();
  const timer = setInterval(tick, PERIOD_MS);
  steering = { vehicle: state.vehicle, id, timer, sending: false };
  show(isTouch ? "Steering: the sticks are at the bottom." : "Steering: W A S D fly, arrows climb and turn.");
}

function end(reason) {
  if (!steering) return;
  clearInterval(steering.timer);
  post(steering, { forward: 0, right: 0, up: 0, turn: 0 });
  steering = null;
  pressed.clear();
  for (const axis of Object.keys(touched)) touched[axis] = 0;
  show(reason);
}

function show(text) {
  $("steer").setAttribute("aria-pressed", steering !== null);
  $("sticks").hidden = !isTouch || steering === null;
  setText($("steered"), text);
}

function tick() {
  const { vehicle, id, sending } = steering;
  const ended = endOf(id);
  if (vehicle !== state.vehicle) {
    end("Another vehicle is shown.");
  } else if (ended) {
    end(`Ended: ${ended.reason}.`);
  } else if (state.outage) {
    end("Ended: the service does not answer.");
  } else if (!sending) {
    post(steering, wanted());
  }
}

// What keys and sticks ask for, each axis from -1 to 1.
function wanted() {
  const axes = { ...touched };
  for (const code of pressed) axes[KEYS[code][0]] += KEYS[code][1];
  const pad = document.hasFocus() && navigator.getGamepads().find((one) => one && one.mapping === "standard");
  for (const [axis, [index, sign]] of Object.entries(pad ? STICKS : {})) axes[axis] += sign * stick(pad.axes[index]);
  for (const axis of Object.keys(axes)) axes[axis] = Math.max(-1, Math.min(1, axes[axis]));
  return axes;
}

const stick = (value) => Math.sign(value) * Math.max(0, Math.abs(value) - DEAD_ZONE) / (1 - DEAD_ZONE);

async function post(to, { forward, right, up, turn }) {
  const speed = Number($("steer-speed").value) || 0;
  const body = JSON.stringify({
    vehicle: to.vehicle, source, stamp_ns: Math.round(performance.now() * 1e6), lifetime_s: LIFETIME_S,
    forward_mps: forward * speed, right_mps: right * speed, up_mps: up * speed,
    turn_radps: turn * (Number($("steer-turn").value) || 0) * Math.PI / 180,
  });
  to.sending = true;
  try {
    // One at a time: late ones would only queue up.
    const signal = AbortSignal.timeout(1000);
    const response = await fetch("/velocity", { method: "POST", headers: HEADERS, body, signal, priority: "high" });
    if (!response.ok && steering === to) show(`Not sent: ${(await response.text()).trim()}`);
  } catch (error) {
    if (steering === to) show(`Not sent: ${error.message}`);
  } finally {
    to.sending = false;
  }
}

// A stick follows the finger that has pressed it, and springs back.
for (const pad of document.querySelectorAll(".stick")) {
  const { x, y } = pad.dataset;
  const move = (event) => {
    if (!pad.hasPointerCapture(event.pointerId)) return;
    const box = pad.getBoundingClientRect();
    const clamp = (value) => Math.max(-1, Math.min(1, value));
    set(clamp(2 * (event.clientX - box.left) / box.width - 1), clamp(1 - 2 * (event.clientY - box.top) / box.height));
  };
  const set = (across, up) => {
    touched[x] = stick(across);
    touched[y] = stick(up);
    pad.lastElementChild.style.transform = `translate(${across * 2.2}rem, ${-up * 2.2}rem)`;
  };
  pad.addEventListener("pointerdown", (event) => {
    event.preventDefault();
    pad.setPointerCapture(event.pointerId);
    move(event);
  });
  pad.addEventListener("pointermove", move);
  for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) pad.addEventListener(name, () => set(0, 0));
}
show(HINT);

$("steer").addEventListener("click", () => {
  if (steering) {
    end("Ended: the vehicle holds.");
  } else {
    send(`velocity source=${source}`, begin);
  }
});
document.addEventListener("keydown", (event) => {
  const typed = event.target instanceof HTMLInputElement || event.target instanceof HTMLSelectElement;
  if (!steering || typed || !(event.code in KEYS) || event.ctrlKey || event.altKey || event.metaKey) return;
  event.preventDefault();
  pressed.add(event.code);
});
document.addEventListener("keyup", (event) => pressed.delete(event.code));
addEventListener("blur", () => pressed.clear()); // a key that is released elsewhere is not seen here
document.addEventListener("visibilitychange", () => {
  if (document.hidden) end("Ended: the page was hidden.");
});
