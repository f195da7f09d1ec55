// Commands: the buttons, the text field, the keys, STOP, and the menu of a track. Each is a POST.

import { Ends, outcome } from "./outcome.js";
import { $, ALL, browserId, button, isFleet, setText, state } from "./state.js";

export const HEADERS = { "Content-Type": "application/json", "X-Companion-Dashboard": "1" };

const waiting = new Map(); // id of a command of this page → what to call after its success
const ends = new Ends();
let count = 0;
let answered = null; // the reply that is shown; null: something else is

const named = (vehicle, text) => isFleet() && vehicle !== ALL ? `${vehicle}: ${text}` : text;
const quoted = (name) => /^[\w-]+$/.test(name) ? name : `"${name}"`;

export async function send(text, then, vehicle = state.vehicle) {
  const title = vehicle === ALL ? `${text} all` : named(vehicle, text);
  const id = `${browserId()}-${++count}-${Date.now()}`;
  waiting.set(id, then);
  reply(`${title}: sent`, "waiting");
  const body = JSON.stringify({ text, id, vehicle });
  try {
    const response = await fetch("/command", { method: "POST", headers: HEADERS, body, priority: "high" });
    if (response.status === 200) {
      onReply(await response.json());
    } else if (response.status === 202) {
      if (waiting.has(id)) reply(`${title}: in progress`, "waiting");
    } else {
      waiting.delete(id);
      reply(`${title}: not sent: ${(await response.text()).trim()}`, "bad");
    }
  } catch (error) {
    // Its outcome may still come by the stream.
    reply(`${title}: no answer of the dashboard, it may have been sent (${error.message})`, "bad");
  }
}

export function onReply(answer) {
  if (!waiting.has(answer.id)) return; // of another window, or here a second time
  const then = waiting.get(answer.id);
  waiting.delete(answer.id);
  answered = answer;
  showAnswer();
  if (then && answer.success && answer.vehicle === state.vehicle) then(answer);
}

// A command has ended, of this page or of another sender.
export function onCommandState(message) {
  ends.add(message);
}

// The message of a command's end; undefined: it has not ended, as far as known here.
export const endOf = (id) => ends.of(id);

// Shows the reply to the last command, and once that has ended, why.
export function showAnswer() {
  if (!answered) return;
  const { service } = (answered.vehicle === state.vehicle && state.topics.status) || {};
  const [text, kind] = outcome(answered, ends, service, !!state.outage);
  setText($("reply"), `${named(answered.vehicle, answered.command)}: ${text}`);
  $("reply").className = kind;
}

function reply(text, kind) {
  answered = null;
  setText($("reply"), text);
  $("reply").className = kind;
}

const sendStop = (all) => send("stop", null, all && isFleet() ? ALL : state.vehicle);
$("stop").addEventListener("click", (event) => sendStop(event.shiftKey));
$("stop-all").addEventListener("click", () => sendStop(true));

$("commands").addEventListener("click", (event) => {
  const template = event.target.dataset && event.target.dataset.command;
  if (!template) return;
  const name = $("class").value;
  if (template.includes("{class}") && !name) {
    reply("No class is known: the detector is off or not ready.", "bad");
    return;
  }
  send(template.replace("{altitude}", $("altitude").value || "5").replace("{class}", quoted(name)));
});

$("sending").addEventListener("submit", (event) => {
  event.preventDefault();
  const text = $("text").value.trim();
  if (!text) return;
  send(text);
  $("text").value = "";
  $("text").blur(); // the space bar stops again
});

// Space stops, wherever the focus is, except where a text is typed. Buttons are pressed by Enter.
const isTyping = (target) => target instanceof HTMLInputElement && target.type !== "number";
document.addEventListener("keydown", (event) => {
  if (event.key === "Escape") closeMenu();
  if (event.key !== " " || isTyping(event.target)) return;
  event.preventDefault();
  if (!event.repeat) sendStop(event.shiftKey);
}, true);
document.addEventListener("keyup", (event) => {
  if (event.key === " " && !isTyping(event.target)) event.preventDefault();
}, true);

// --- the menu of a track

const TRACK_COMMANDS = { follow: "Follow", approach: "Approach", orbit: "Orbit", gimbal: "Point gimbal" };
let openedBy = null;

// Opens the menu of a track at a point of the window; `opener` gets the focus back.
export function openMenu(track, x, y, opener = null) {
  const menu = $("menu");
  state.chosen = track.id;
  openedBy = opener;
  const title = document.createElement("p");
  title.textContent = `track ${track.id}, ${track.name}`;
  const hasGimbal = state.topics.status && state.topics.status.gimbal;
  const offered = Object.entries(TRACK_COMMANDS).filter(([word]) => word !== "gimbal" || hasGimbal);
  menu.replaceChildren(title, ...offered.map(([word, text]) => {
    const item = button(text, () => {
      closeMenu();
      send(`${word} track=${track.id}`);
    });
    item.setAttribute("role", "menuitem");
    return item;
  }));
  menu.hidden = false;
  const box = menu.getBoundingClientRect();
  menu.style.left = `${Math.max(4, Math.min(x, innerWidth - box.width - 4))}px`;
  // Between the header and what is at the bottom of a phone: STOP is above everything.
  const top = document.querySelector("header").getBoundingClientRect().bottom;
  const bottom = Math.min(innerHeight, document.querySelector("main").getBoundingClientRect().bottom);
  menu.style.top = `${Math.max(top + 4, Math.min(y, bottom - box.height - 4))}px`;
  menu.querySelector("button").focus();
}

export function closeMenu() {
  if ($("menu").hidden) return;
  $("menu").hidden = true;
  if (openedBy && openedBy.isConnected) openedBy.focus();
}

$("menu").addEventListener("keydown", (event) => {
  const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
  if (!step) return;
  event.preventDefault();
  const items = [...$("menu").querySelectorAll("button")];
  items[(items.indexOf(document.activeElement) + step + items.length) % items.length].focus();
});
document.addEventListener("pointerdown", (event) => {
  if (!$("menu").contains(event.target)) closeMenu();
});
