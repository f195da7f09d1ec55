// The page of one vehicle of those on the bus. This module draws the state, ten times a second.

import { drawAttitude, drawChart } from "./charts.js";
import { openMenu, showAnswer } from "./commands.js";
import { drawMap } from "./map.js";
import { outage } from "./outage.js";
import "./steer.js";
import {
  $, age, button, cameras, heading, isFleet, measureClock, number, setText, STALE_S, state,
} from "./state.js";
import { cameraOf, connect, disconnect, select } from "./stream.js";

const RENDER_PERIOD_MS = 100;
const CLOCK_PERIOD_MS = 30000;
const DETECTIONS_SHOWN_S = 2;

function render() {
  const vehicle = state.topics.vehicle || {};
  const status = state.topics.status || {};
  const pilot = status.pilot || {};
  renderFleet();
  renderOutage(vehicle, status);
  renderSummary(vehicle);
  setText($("behaviour"), pilot.behaviour ? `Service: ${pilot.behaviour}` : "");
  renderMission(pilot);
  renderDetections();
  renderSetpoint(vehicle);
  for (const view of cameras.values()) view.writeCaption();
  drawMap(vehicle, status.limits || {});
  drawAttitude(vehicle);
  const latencies = { result: "capture to result", video: "capture to screen" };
  drawChart($("latency"), "Latency", $("latency-now"), state.latency, latencies, "ms");
  const losses = { dropped: "dropped", skipped: "skipped by setting" };
  drawChart($("drops"), "Frames lost", $("drops-now"), state.drops, losses, "/s");
}

// Without a service nothing here is true any more, and no command but STOP is sent.
const COMMANDING = "#commands button, #talking button, #menu button, #detections button";

function renderOutage(status) {
  const { problem, alive } = state;
  const silentS = (performance.now() - state.at) / 1000;
  const oldS = state.at ? age("status") ?? age("vehicle") : null;
  state.outage = outage({ silentS, problem, alive, oldS, status });
  const { what = "", vehicle: now = "", todo = "" } = state.outage || {};
  $("outage").hidden = $("off").hidden = !state.outage;
  // Read aloud once, not with each second.
  for (const [name, text] of Object.entries({ what: what.split(/[;.] /)[0], vehicle: now, todo })) {
    setText($("outage").querySelector(`.${name}`), text);
  }
  setText($("off"), state.outage ? "No commands: the service does not answer. STOP is sent all the same." : "");
  document.body.classList.toggle("stale", !!state.outage);
  for (const item of document.querySelectorAll(COMMANDING)) {
    if (item.disabled === !!state.outage) continue;
    item.disabled = !!state.outage;
    item.title = state.outage ? $("off").textContent : "";
  }
  showAnswer();
}

function renderSummary({ mode, armed, altitude_m: altitude, velocity_ned_mps: v, battery_fraction: battery }) {
  const [text, isBad] = linkText();
  setText($("link"), text);
  $("link").className = isBad ? "bad" : "";
  setText($("mode"), mode || "–");
  setText($("armed"), armed == null ? "–" : armed ? "yes" : "no");
  setText($("height"), altitude == null ? "–" : `${number(altitude, 1)} m`);
  setText($("speed"), v ? `${Math.hypot(v[0], v[1]).toFixed(1)} m/s` : "–");
  setText($("battery"), battery == null ? "–" : `${Math.round(battery * 100)} %`);
}

// What the line at the top says, and whether it is a fault.
function linkText() {
  const silentS = (performance.now() - state.at) / 1000;
  if (state.replaced) return ["Paused: this page is open in too many windows. Reload to continue here.", true];
  if (state.refused) return [state.refused, true];
  if (!state.at) return ["connecting to the dashboard", false];
  if (state.outage) return [state.outage.what, true];
  if (silentS > STALE_S) return [`The dashboard has not answered for ${silentS.toFixed(0)} s.`, true];
  if (state.problem) return [state.problem, true];
  if (state.alive === false) return ["No service answers.", true];
  if ((age("status") ?? age("vehicle")) == null) return ["waiting for the service", false];
  const { vehicle, status } = state.topics;
  if (!status) return vehicle && vehicle.connected === false ? ["No autopilot heartbeat.", true] : ["", false];
  const parts = status.parts || []; // an older service has none
  const waiting = parts.filter((part) => !["ready", "finished"].includes(part.state));
  if (waiting.length) return [`Waiting for ${waiting.map((part) => partText(part, status.stamp_ns)).join(" · ")}`, true];
  const reasons = status.unhealthy || []; // an older service has none
  const health = status.healthy ? "healthy" : `not healthy${reasons.length ? `: ${reasons.join(" · ")}` : ""}`;
  const hasVehicle = !status.parts || parts.some((part) => part.name === "autopilot");
  return [`${hasVehicle ? status.vehicle.autopilot || "autopilot" : "no vehicle"} · ${health}`, !status.healthy];
}

function partText({ name, state: word, reason, next_try_ns: nextNs }, nowNs) {
  const next = nextNs == null ? "" : `, next try in ${Math.max(0, (nextNs - nowNs) / 1e9).toFixed(0)} s`;
  return `${name}: ${reason || word}${next}`;
}

function renderFleet() {
  const fleet = $("fleet");
  fleet.hidden = $("stop-all").hidden = !isFleet();
  document.body.classList.toggle("of-fleet", isFleet());
  const names = state.vehicles.map((one) => one.name);
  if (names.join() !== [...fleet.children].map((item) => item.value).join()) {
    fleet.replaceChildren(...names.map((name) => {
      const item = button("", () => {
        select(name);
        renderFleet();
      });
      item.value = name;
      return item;
    }));
  }
  state.vehicles.forEach(({ name, alive, mode, altitude_m: altitude }, index) => {
    const words = [name, alive === false ? "gone" : mode || "–"];
    if (alive && altitude != null) words.push(`${number(altitude, 1)} m`);
    const item = fleet.children[index];
    setText(item, words.join(" · "));
    const isShown = name === state.vehicle;
    if (item.ariaPressed === String(isShown)) return;
    item.ariaPressed = isShown;
    if (isShown) item.scrollIntoView({ block: "nearest", inline: "nearest" }); // the list scrolls on a phone
  });
}

function renderMission(pilot) {
  const mission = state.mission;
  $("mission").hidden = !mission;
  if (!mission) return;
  setText($("mission-name"), `Mission ${mission.name}${pilot.mission ? "" : ", ended"}`);
  const key = JSON.stringify([mission, !!pilot.mission]);
  if ($("steps").dataset.key === key) return;
  $("steps").dataset.key = key;
  $("steps").replaceChildren(...mission.steps.map((title, index) => {
    const item = document.createElement("li");
    item.textContent = title;
    const ended = mission.ended.filter((step) => step.title === title).at(-1);
    if (ended) {
      item.className = ended.success ? "good" : "bad";
      item.title = ended.reason;
    }
    if (pilot.mission && index === mission.current) {
      item.className = "now";
      item.setAttribute("aria-current", "step");
    }
    return item;
  }));
}

function renderDetections() {
  const shown = [];
  for (const [path, message] of Object.entries(state.topics)) {
    if (!path.endsWith("detections") || age(path) > DETECTIONS_SHOWN_S) continue;
    for (const found of message.detections || []) shown.push([found, cameraOf(path)]);
  }
  setText($("count"), shown.length ? `(${shown.length})` : "");
  const body = $("detections").tBodies[0];
  while (body.rows.length > shown.length) body.deleteRow(-1);
  shown.forEach(([found, name], index) => {
    const row = body.rows[index] || newRow(body, 5);
    const range = found.ground_range_m;
    renderTrack(row.cells[0], found);
    row.className = found.track_id != null && found.track_id === state.chosen ? "chosen" : "";
    setText(row.cells[1], found.class_name + (found.track_state === "tentative" ? " (tentative)" : ""));
    setText(row.cells[2], Number(found.confidence).toFixed(2));
    setText(row.cells[3], range == null ? "–" : `${range.toFixed(1)} m`);
    setText(row.cells[4], name || "first");
  });
}

// The first cell of a detection: a button that opens the menu of its track.
function renderTrack(cell, { track_id: id, class_name: name }) {
  if (id == null) {
    cell.textContent = "–";
    return;
  }
  if (!cell.firstElementChild) {
    const item = button("", () => {
      const box = item.getBoundingClientRect();
      openMenu({ id: Number(item.dataset.id), name: item.dataset.name }, box.left, box.bottom, item);
    });
    item.setAttribute("aria-haspopup", "menu");
    cell.replaceChildren(item);
  }
  const item = cell.firstElementChild;
  item.dataset.id = id;
  item.dataset.name = name;
  setText(item, `#${id}`);
  item.setAttribute("aria-label", `Commands of track ${id}, ${name}`);
}

const SETPOINT_ROWS = ["north m/s", "east m/s", "down m/s", "north m", "east m", "down m", "yaw"];

function renderSetpoint(vehicle) {
  const setpoint = age("setpoint") < 1 ? state.topics.setpoint : null;
  const { asked, sent, limited_by: limits } = setpoint || {};
  const three = (values, digits) => (values || [null, null, null]).map((v) => v == null ? "–" : number(v, digits));
  const columns = [vehicle, asked || {}, sent || {}].map((one) => [
    ...three(one.velocity_ned_mps, 2), ...three(one.position_ned_m, 1), heading(one.yaw_rad),
  ]);
  const body = $("setpoint").tBodies[0];
  SETPOINT_ROWS.forEach((name, index) => {
    const row = body.rows[index] || newRow(body, columns.length, name);
    columns.forEach((column, n) => setText(row.cells[n + 1], column[index]));
  });
  const hint = limits && limits.length ? `Limited by: ${limits.join(", ")}` : "";
  setText($("limited"), setpoint ? hint : "Not in command: no setpoints.");
}

function newRow(body, cells, title = null) {
  const row = body.insertRow();
  if (title != null) {
    const head = document.createElement("th");
    head.scope = "row";
    head.textContent = title;
    row.append(head);
  }
  for (let cell = 0; cell < cells; cell++) row.insertCell();
  return row;
}

document.addEventListener("visibilitychange", () => {
  if (document.hidden) {
    disconnect();
  } else {
    connect();
    measureClock();
  }
});
addEventListener("pagehide", disconnect);
addEventListener("pageshow", connect);
connect();
measureClock();
setInterval(measureClock, CLOCK_PERIOD_MS);
setInterval(() => {
  if (!document.hidden) requestAnimationFrame(render);
}, RENDER_PERIOD_MS);
