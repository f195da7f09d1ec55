"use strict";
// The page of one vehicle of those on the bus, and the map of all. State arrives in one stream of server-sent events (`/events`); each picture is requested when
// the one before is drawn, so a slow connection gets fewer pictures, never older ones; commands are POSTs.

const $ = (id) => document.getElementById(id);
const HISTORY_S = 60, TRAIL_M = 0.3, TRAIL_POINTS = 800, LOG_LINES = 200, STALE_S = 3, STATUS_STALE_S = 4;
const HEADERS = { "Content-Type": "application/json", "X-Companion-Dashboard": "1" };
const DRAG_PX = 8, PICTURE_PERIOD_MS = 60;
const ALL = "*"; // as the vehicle of a stop
const number = (value, digits) => value.toFixed(digits).replace(/^-(?=0(\.0*)?$)/, ""); // no -0.0
const three = (values, digits) => (values || [null, null, null]).map((v) => v == null ? "–" : number(v, digits));
const degrees = (radians) => radians * 180 / Math.PI;
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

const address = new URLSearchParams(location.search);
const addressOf = (vehicle) => vehicle ? `/?vehicle=${encodeURIComponent(vehicle)}` : "/";
if (address.has("token")) history.replaceState(null, "", addressOf(address.get("vehicle"))); // the cookie is set now

function browserId() {
  try {
    const id = localStorage.getItem("browser") || Math.random().toString(36).slice(2);
    localStorage.setItem("browser", id);
    return id;
  } catch { return ""; } // storage is off
}

const state = {
  at: 0, problem: "connecting to the dashboard", alive: null, replaced: false, refused: "",
  offsetNs: null, sent: new Map(), number: 0,
  vehicle: address.get("vehicle") || "", vehicles: [], objects: [], ...ofOneVehicle(),
};

function ofOneVehicle() {
  return { topics: {}, ages: {}, trail: [], tracks: new Map(), latency: [], drops: [], lost: null, chosen: null, mission: null, videoMs: null };
}
const cameras = new Map();

// --- the stream

let stream = null;

function connect() {
  if (stream || document.hidden || state.replaced) return;
  stream = new EventSource(`/events?browser=${encodeURIComponent(browserId())}&vehicle=${encodeURIComponent(state.vehicle)}`);
  stream.onopen = () => $("log").replaceChildren(); // a new stream begins with all kept events
  stream.onmessage = (event) => onNews(JSON.parse(event.data));
  stream.addEventListener("replaced", () => {
    disconnect();
    state.replaced = true; // the browser has too many windows of this page for one server
  });
  stream.onerror = () => { if (stream && stream.readyState === EventSource.CLOSED) { disconnect(); explain(); setTimeout(connect, 2000); } };
}

function disconnect() {
  if (stream) stream.close();
  stream = null;
}

function select(vehicle) {
  if (vehicle === state.vehicle) return;
  closeMenu();
  disconnect();
  Object.assign(state, ofOneVehicle(), { vehicle, at: 0, alive: null, objects: [] });
  for (const view of cameras.values()) view.end();
  cameras.clear();
  $("log").replaceChildren();
  $("class").replaceChildren();
  $("vehicle").textContent = document.title = vehicle;
  history.replaceState(null, "", addressOf(vehicle));
  renderFleet();
  connect();
}

async function explain() {
  // An EventSource does not report the status of a refusal.
  try {
    const response = await fetch("/clock");
    state.refused = response.ok ? "" : (await response.text()).trim();
  } catch { state.refused = ""; }
}

function onNews(news) {
  state.at = performance.now();
  state.problem = news.problem; state.alive = news.alive; state.ages = news.ages_s; state.refused = "";
  state.vehicle = $("vehicle").textContent = document.title = news.vehicle_name;
  state.vehicles = news.vehicles; state.objects = news.objects;
  Object.assign(state.topics, news.topics);
  for (const [path, value] of Object.entries(news.topics)) {
    if (path.endsWith("detections")) onDetections(path, value);
  }
  if (news.topics.vehicle) onVehicle(news.topics.vehicle);
  if (news.topics.status) onStatus(news.topics.status);
  for (const event of news.events) log(event.level, event.text, (news.now_ns - event.stamp_ns) / 1e9);
  news.replies.forEach(onReply);
}

function onVehicle(vehicle) {
  const at = vehicle.position_ned_m, last = state.trail.at(-1);
  if (at && (!last || Math.hypot(at[0] - last[0], at[1] - last[1]) > TRAIL_M)) state.trail.push(at);
  if (state.trail.length > TRAIL_POINTS) state.trail.shift();
}

function onDetections(path, message) {
  const name = path === "detections" ? "" : path.split("/")[1];
  camera(name);
  for (const found of message.detections || []) {
    const at = found.position_ned_m || placed(found);
    if (found.track_id == null || found.track_state === "tentative" || !at) continue;
    const track = state.tracks.get(found.track_id) || { trail: [] };
    const last = track.trail.at(-1);
    if (!last || Math.hypot(at[0] - last[0], at[1] - last[1]) > TRAIL_M) track.trail.push(at);
    if (track.trail.length > 100) track.trail.shift();
    state.tracks.set(found.track_id, { ...track, at, name: found.class_name, seen: performance.now() });
  }
  for (const [id, track] of state.tracks) if (performance.now() - track.seen > 10000) state.tracks.delete(id);
  if (name === "" && message.published_ns) {
    record(state.latency, { result: (message.published_ns - message.captured_ns) / 1e6, video: state.videoMs });
  }
}

function placed(found) {
  // From the direction and the range over ground, where the message has them but no position.
  const own = state.topics.vehicle && state.topics.vehicle.position_ned_m, range = found.ground_range_m;
  if (!own || range == null || found.bearing_rad == null) return null;
  return [own[0] + range * Math.cos(found.bearing_rad), own[1] + range * Math.sin(found.bearing_rad)];
}

function onStatus(status) {
  const all = { "": status.perception, ...status.cameras };
  let skipped = 0, dropped = 0;
  for (const [name, view] of Object.entries(all)) {
    if (!view || view.state === "stopped") continue;
    camera(name).status = view;
    dropped += view.dropped || 0;
    for (const reason of ["every", "rate"]) skipped += (view.frames_skipped || {})[reason] || 0;
  }
  const now = performance.now(), before = state.lost;
  state.lost = { at: now, dropped, skipped, service: status.service };
  if (before && before.service === status.service && now > before.at) {
    const s = (now - before.at) / 1000;
    record(state.drops, { dropped: Math.max(0, dropped - before.dropped) / s, skipped: Math.max(0, skipped - before.skipped) / s });
  }
  const names = (status.perception && status.perception.class_names) || [], list = $("class");
  if (names.join() !== [...list.options].map((o) => o.value).join()) {
    list.replaceChildren(...names.map((name) => new Option(name)));
    if (names.includes("car")) list.value = "car";
  }
  if (status.pilot && status.pilot.mission) state.mission = status.pilot.mission;
}

function record(series, values) {
  series.push({ at: performance.now(), ...values });
  while (series.length && series[0].at < performance.now() - HISTORY_S * 1000) series.shift();
}

// --- commands

const isFleet = () => state.vehicles.length > 1;
const named = (vehicle, text) => isFleet() && vehicle !== ALL ? `${vehicle}: ${text}` : text;

async function send(text, then, vehicle = state.vehicle) {
  const title = vehicle === ALL ? `${text} all` : named(vehicle, text);
  const id = `${browserId()}-${++state.number}-${Date.now()}`;
  state.sent.set(id, then);
  reply(`${title}: sent`, "waiting");
  try {
    const response = await fetch("/command", { method: "POST", headers: HEADERS, body: JSON.stringify({ text, id, vehicle }), priority: "high" });
    if (response.status === 200) onReply(await response.json());
    else if (response.status === 202) { if (state.sent.has(id)) reply(`${title}: in progress`, "waiting"); }
    else { state.sent.delete(id); reply(`${title}: not sent: ${(await response.text()).trim()}`, "bad"); }
  } catch (error) {
    // Its outcome may still come by the stream.
    reply(`${title}: no answer of the dashboard, it may have been sent (${error.message})`, "bad");
  }
}

function onReply(answer) {
  if (!state.sent.has(answer.id)) return; // of another window, or here a second time
  const then = state.sent.get(answer.id);
  state.sent.delete(answer.id);
  reply(`${named(answer.vehicle, answer.command)}: ${answer.success ? "done" : "failed"}: ${answer.reason}`, answer.success ? "good" : "bad");
  if (then && answer.success && answer.vehicle === state.vehicle) then(answer);
}

function reply(text, kind) {
  $("reply").textContent = text;
  $("reply").className = kind;
}

const quoted = (name) => /^[\w-]+$/.test(name) ? name : `"${name}"`;

$("commands").addEventListener("click", (event) => {
  const template = event.target.dataset && event.target.dataset.command;
  if (!template) return;
  const name = $("class").value;
  if (template.includes("{class}") && !name) return reply("No class is known: the detector is off or not ready.", "bad");
  send(template.replace("{altitude}", $("altitude").value || "5").replace("{class}", quoted(name)));
});
$("sending").addEventListener("submit", (event) => {
  event.preventDefault();
  const text = $("text").value.trim();
  if (text) { send(text); $("text").value = ""; $("text").blur(); } // the space bar stops again
});
const sendStop = (all) => send("stop", null, all && isFleet() ? ALL : state.vehicle);
$("stop").addEventListener("click", (event) => sendStop(event.shiftKey));
$("stop-all").addEventListener("click", () => sendStop(true));

// Space stops, wherever the focus is, except where a text is typed. Buttons are pressed by Enter.
const typing = (target) => target instanceof HTMLInputElement && target.type !== "number";
document.addEventListener("keydown", (event) => {
  if (event.key === "Escape") closeMenu();
  if (event.key !== " " || typing(event.target)) return;
  event.preventDefault();
  if (!event.repeat) sendStop(event.shiftKey);
}, true);
document.addEventListener("keyup", (event) => { if (event.key === " " && !typing(event.target)) event.preventDefault(); }, true);

// --- the menu of a track

let openedBy = null;

function openMenu(track, x, y, opener) {
  const menu = $("menu");
  state.chosen = track.id;
  openedBy = opener || null;
  const title = document.createElement("p");
  title.textContent = `track ${track.id}, ${track.name}`;
  menu.replaceChildren(title, ...["follow", "approach", "orbit", "gimbal"].map((word) => {
    const item = document.createElement("button");
    item.type = "button"; item.setAttribute("role", "menuitem");
    item.textContent = { follow: "Follow", approach: "Approach", orbit: "Orbit", gimbal: "Point gimbal" }[word];
    item.onclick = () => { closeMenu(); send(`${word} track=${track.id}`); };
    return item;
  }));
  menu.hidden = false;
  const box = menu.getBoundingClientRect();
  menu.style.left = `${Math.max(4, Math.min(x, innerWidth - box.width - 4))}px`;
  menu.style.top = `${Math.max(4, Math.min(y, innerHeight - box.height - 4))}px`;
  menu.querySelector("button").focus();
}

function closeMenu() {
  if ($("menu").hidden) return;
  $("menu").hidden = true;
  if (openedBy && openedBy.isConnected) openedBy.focus();
}

$("menu").addEventListener("keydown", (event) => {
  const items = [...$("menu").querySelectorAll("button")], step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
  if (!step) return;
  event.preventDefault();
  items[(items.indexOf(document.activeElement) + step + items.length) % items.length].focus();
});
document.addEventListener("pointerdown", (event) => { if (!$("menu").contains(event.target)) closeMenu(); });

// --- cameras

function camera(name) {
  if (!cameras.has(name)) {
    const view = new Camera(name);
    cameras.set(name, view);
    $("cameras").append(view.figure);
    view.run();
  }
  return cameras.get(name);
}

class Camera {
  constructor(name) {
    this.name = name; this.vehicle = state.vehicle; this.ended = false; this.about = null; this.bitmap = null; this.drag = null; this.times = []; this.at = 0;
    this.figure = document.createElement("figure");
    this.canvas = document.createElement("canvas");
    this.canvas.setAttribute("role", "img");
    this.caption = document.createElement("span");
    const caption = document.createElement("figcaption"), area = document.createElement("button");
    area.type = "button"; area.textContent = "Select area"; area.setAttribute("aria-pressed", "false");
    area.onclick = () => area.setAttribute("aria-pressed", this.figure.classList.toggle("selecting"));
    caption.append(this.caption, area);
    this.figure.append(this.canvas, caption);
    this.label = name || "first camera";
    this.canvas.addEventListener("pointerdown", (event) => this.press(event));
    this.canvas.addEventListener("pointermove", (event) => this.move(event));
    this.canvas.addEventListener("pointerup", (event) => this.release(event));
    this.canvas.addEventListener("pointercancel", () => { this.drag = null; this.draw(); });
    this.writeCaption();
  }

  async run() {
    for (let after = -1; !this.ended;) {
      const begun = performance.now();
      if (document.hidden || state.replaced || !stream) { await pause(300); continue; }
      try {
        const response = await fetch(`/picture?camera=${encodeURIComponent(this.name)}&after=${after}&vehicle=${encodeURIComponent(this.vehicle)}`, { priority: "low" });
        if (response.status === 200) {
          const about = JSON.parse(response.headers.get("X-Frame"));
          const bitmap = await createImageBitmap(await response.blob());
          if (this.ended) break;
          if (this.bitmap) this.bitmap.close();
          this.bitmap = bitmap; this.about = about; after = about.sequence;
          this.at = performance.now();
          this.times.push(this.at);
          while (this.times[0] < this.at - 2000) this.times.shift();
          this.draw();
          this.measure();
        } else if (response.status !== 204) await pause(1000);
      } catch { await pause(1000); }
      await pause(Math.max(0, PICTURE_PERIOD_MS - (performance.now() - begun)));
    }
  }

  end() {
    this.ended = true;
    this.figure.remove();
  }

  measure() {
    // From the capture to the drawn picture, on the service's clock; unknown where that is another computer's.
    if (state.offsetNs == null || !this.about.captured_ns) return;
    const ms = (performance.now() * 1e6 + state.offsetNs - this.about.captured_ns) / 1e6;
    this.latencyMs = ms > -5 && ms < 60000 ? Math.max(0, ms) : null;
    if (this.name === "") state.videoMs = this.latencyMs;
  }

  draw() {
    const { canvas, bitmap, about } = this;
    if (!bitmap) return;
    const scale = devicePixelRatio || 1, width = Math.round(canvas.clientWidth * scale);
    const height = Math.round(width * bitmap.height / bitmap.width);
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width; canvas.height = height;
      canvas.style.aspectRatio = `${bitmap.width} / ${bitmap.height}`;
    }
    const g = canvas.getContext("2d");
    g.drawImage(bitmap, 0, 0, width, height);
    g.font = `600 ${13 * scale}px system-ui, sans-serif`;
    g.textBaseline = "top";
    g.setLineDash(about.boxes_sequence === about.sequence ? [] : [6 * scale, 4 * scale]);
    for (const [l, t, r, b, name, confidence, id, kind] of about.boxes) {
      const chosen = id != null && id === state.chosen;
      if (about.annotated && !chosen) continue; // already in the picture
      const colour = chosen ? "#ffd23f" : kind === "tentative" || kind === "none" ? "#c9d1dc" : "#39e07f";
      const x = l * width, y = t * height, w = (r - l) * width, h = (b - t) * height;
      g.strokeStyle = "#000a"; g.lineWidth = (chosen ? 6 : 4) * scale; g.strokeRect(x, y, w, h);
      g.strokeStyle = colour; g.lineWidth = (chosen ? 4 : 2) * scale; g.strokeRect(x, y, w, h);
      const text = `${name}${id == null ? "" : ` #${id}`}${canvas.clientWidth < 420 ? "" : ` ${Number(confidence).toFixed(2)}`}`;
      const size = g.measureText(text).width + 8 * scale, line = 18 * scale;
      const left = Math.max(0, Math.min(x, width - size)), top = y >= line ? y - line : Math.min(y + h, height - line);
      g.fillStyle = colour; g.fillRect(left, top, size, line);
      g.fillStyle = "#0b0e12"; g.fillText(text, left + 4 * scale, top + 2 * scale);
    }
    g.setLineDash([]);
    if (this.drag && this.drag.moved) {
      const [l, t, r, b] = this.drag.box;
      g.strokeStyle = "#fff"; g.lineWidth = 2 * scale; g.fillStyle = "#fff3";
      g.fillRect(l * width, t * height, (r - l) * width, (b - t) * height);
      g.strokeRect(l * width, t * height, (r - l) * width, (b - t) * height);
    }
  }

  writeCaption() {
    const age = this.at ? (performance.now() - this.at) / 1000 : null, view = this.status || {};
    const words = [this.label];
    if (age == null) words.push("no picture yet");
    else if (age > 1.5) words.push(`picture ${age.toFixed(0)} s old`);
    else {
      words.push(`${(this.times.length / 2).toFixed(0)} pictures/s`);
      if (this.latencyMs != null) words.push(`${this.latencyMs.toFixed(0)} ms from capture to screen`);
    }
    if (view.rate_hz != null) words.push(`${view.rate_hz.toFixed(1)} results/s`);
    if (view.problem) words.push(view.problem);
    setText(this.caption, words.join(" · "));
    this.canvas.setAttribute("aria-label", `Video of ${this.label}, ${this.about ? this.about.boxes.length : 0} boxes`);
  }

  pointOf(event) {
    const box = this.canvas.getBoundingClientRect(), clamp = (v) => Math.min(1, Math.max(0, v));
    return [clamp((event.clientX - box.left) / box.width), clamp((event.clientY - box.top) / box.height)];
  }

  press(event) {
    if (event.button !== 0 || !this.bitmap) return;
    const [x, y] = this.pointOf(event);
    this.drag = { x, y, px: event.clientX, py: event.clientY, moved: false, box: [x, y, x, y] };
    this.drag.selects = event.pointerType === "mouse" || this.figure.classList.contains("selecting");
    if (this.drag.selects) this.canvas.setPointerCapture(event.pointerId);
  }

  move(event) {
    const drag = this.drag;
    if (!drag) return;
    const [x, y] = this.pointOf(event);
    if (Math.hypot(event.clientX - drag.px, event.clientY - drag.py) > DRAG_PX) drag.moved = drag.selects;
    drag.box = [Math.min(x, drag.x), Math.min(y, drag.y), Math.max(x, drag.x), Math.max(y, drag.y)];
    if (drag.moved) this.draw();
  }

  release(event) {
    const drag = this.drag;
    this.drag = null;
    if (!drag) return;
    if (drag.moved) {
      const [l, t, r, b] = drag.box, share = (value) => value.toFixed(4);
      this.draw();
      send(`select${this.name ? ` camera=${this.name}` : ""} x=${share(l)} y=${share(t)} width=${share(r - l)} height=${share(b - t)}`,
        ({ track, class: name }) => { if (track != null) openMenu({ id: track, name }, event.clientX, event.clientY); });
      return;
    }
    const inside = this.about.boxes.filter(([l, t, r, b, , , id]) => id != null && drag.x >= l && drag.x <= r && drag.y >= t && drag.y <= b);
    inside.sort((one, other) => (one[2] - one[0]) * (one[3] - one[1]) - (other[2] - other[0]) * (other[3] - other[1]));
    if (inside.length) openMenu({ id: inside[0][6], name: inside[0][4] }, event.clientX, event.clientY);
  }
}

const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

async function measureClock() {
  // The offset of performance.now() to the dashboard's monotonic clock, from the fastest of five requests.
  let best = Infinity;
  for (let count = 0; count < 5 && !document.hidden; count++) {
    try {
      const begun = performance.now(), response = await fetch("/clock"), ended = performance.now();
      const { now_ns } = await response.json();
      if (ended - begun < best) { best = ended - begun; state.offsetNs = now_ns - (begun + ended) / 2 * 1e6; }
    } catch { return; }
  }
}

// --- drawing the rest

function setText(element, text) { if (element.textContent !== text) element.textContent = text; }

function age(path) {
  const known = state.ages[path];
  return known == null ? null : known + (performance.now() - state.at) / 1000;
}

function linkText() {
  const silent = (performance.now() - state.at) / 1000;
  if (state.replaced) return ["Paused: this page is open in too many windows. Reload to continue here.", true];
  if (state.refused) return [state.refused, true];
  if (!state.at) return ["connecting to the dashboard", false];
  if (silent > STALE_S) return [`The dashboard does not answer; everything here is ${silent.toFixed(0)} s old.`, true];
  const old = age("status") ?? age("vehicle");
  const since = old == null ? "" : ` Shown is its state of ${old.toFixed(0)} s ago.`;
  if (state.problem) return [`${state.problem}${since}`, true];
  if (state.alive === false) return [old == null ? "No service answers." : `The service is gone.${since}`, true];
  if (old == null) return ["waiting for the service", false];
  if (old > STATUS_STALE_S) return [`Stale: the last state came ${old.toFixed(0)} s ago.`, true];
  const vehicle = state.topics.vehicle;
  if (vehicle && vehicle.connected === false) return ["Autopilot heartbeat lost.", true];
  const status = state.topics.status;
  return status ? [`${status.vehicle.autopilot || "autopilot"} · ${status.healthy ? "healthy" : "not healthy"}`, !status.healthy] : ["", false];
}

function render() {
  renderFleet();
  const [text, bad] = linkText();
  setText($("link"), text);
  $("link").className = bad ? "bad" : "";
  const vehicle = state.topics.vehicle || {}, status = state.topics.status || {}, pilot = status.pilot || {};
  const v = vehicle.velocity_ned_mps;
  setText($("mode"), vehicle.mode || "–");
  setText($("armed"), vehicle.armed == null ? "–" : vehicle.armed ? "yes" : "no");
  setText($("height"), vehicle.altitude_m == null ? "–" : `${number(vehicle.altitude_m, 1)} m`);
  setText($("speed"), v ? `${Math.hypot(v[0], v[1]).toFixed(1)} m/s` : "–");
  setText($("battery"), vehicle.battery_fraction == null ? "–" : `${Math.round(vehicle.battery_fraction * 100)} %`);
  setText($("behaviour"), pilot.behaviour ? `Service: ${pilot.behaviour}` : "");
  renderMission(pilot);
  renderDetections();
  renderSetpoint(vehicle);
  for (const view of cameras.values()) view.writeCaption();
  drawMap(vehicle, status.limits || {});
  drawAttitude(vehicle);
  drawChart($("latency"), $("latency-now"), state.latency, { result: "capture to result", video: "capture to screen" }, "ms");
  drawChart($("drops"), $("drops-now"), state.drops, { dropped: "dropped", skipped: "skipped by setting" }, "/s");
}

function renderFleet() {
  const fleet = $("fleet"), vehicles = state.vehicles;
  fleet.hidden = $("stop-all").hidden = !isFleet();
  document.body.classList.toggle("of-fleet", isFleet());
  if (vehicles.map((one) => one.name).join() !== [...fleet.children].map((item) => item.value).join()) {
    fleet.replaceChildren(...vehicles.map(({ name }) => {
      const item = document.createElement("button");
      item.type = "button"; item.value = name;
      item.onclick = () => select(name);
      return item;
    }));
  }
  vehicles.forEach((one, index) => {
    const item = fleet.children[index], shown = one.alive === false ? "gone" : one.mode || "–";
    setText(item, `${one.name} · ${shown}${one.alive && one.altitude_m != null ? ` · ${number(one.altitude_m, 1)} m` : ""}`);
    item.setAttribute("aria-pressed", one.name === state.vehicle);
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
    const item = document.createElement("li"), record = mission.ended.filter((step) => step.title === title).at(-1);
    item.textContent = title;
    if (record) { item.className = record.success ? "good" : "bad"; item.title = record.reason; }
    if (pilot.mission && index === mission.current) { item.className = "now"; item.setAttribute("aria-current", "step"); }
    return item;
  }));
}

function renderDetections() {
  const rows = [];
  for (const [path, message] of Object.entries(state.topics)) {
    if (!path.endsWith("detections") || age(path) > 2) continue;
    for (const found of message.detections || []) rows.push({ found, view: path === "detections" ? "" : path.split("/")[1] });
  }
  setText($("count"), rows.length ? `(${rows.length})` : "");
  const body = $("detections").tBodies[0];
  while (body.rows.length > rows.length) body.deleteRow(-1);
  rows.forEach(({ found, view }, index) => {
    let row = body.rows[index];
    if (!row) {
      row = body.insertRow();
      for (let cell = 0; cell < 5; cell++) row.insertCell();
    }
    const id = found.track_id, range = found.range_m ?? found.ground_range_m ?? found.depth_m;
    let button = row.cells[0].firstElementChild;
    if (id == null) row.cells[0].textContent = "–";
    else {
      if (!button) {
        row.cells[0].textContent = "";
        button = document.createElement("button");
        button.type = "button"; button.setAttribute("aria-haspopup", "menu");
        button.onclick = () => { const box = button.getBoundingClientRect(); openMenu({ id: Number(button.dataset.id), name: button.dataset.name }, box.left, box.bottom, button); };
        row.cells[0].append(button);
      }
      button.dataset.id = id; button.dataset.name = found.class_name;
      setText(button, `#${id}`);
      button.setAttribute("aria-label", `Commands of track ${id}, ${found.class_name}`);
    }
    row.className = id != null && id === state.chosen ? "chosen" : "";
    setText(row.cells[1], found.class_name + (found.track_state === "tentative" ? " (tentative)" : ""));
    setText(row.cells[2], Number(found.confidence).toFixed(2));
    setText(row.cells[3], range == null ? "–" : `${range.toFixed(1)} m`);
    setText(row.cells[4], view || "first");
  });
}

function renderSetpoint(vehicle) {
  const fresh = age("setpoint") < 1 && state.topics.setpoint, asked = fresh && fresh.asked || {}, sent = fresh && fresh.sent || {};
  const yaw = (radians) => radians == null ? "–" : `${((degrees(radians) + 360) % 360).toFixed(0)}°`;
  const columns = [vehicle, asked, sent].map((one) => [
    ...three(one.velocity_ned_mps, 2), ...three(one.position_ned_m, 1), yaw(one.yaw_rad),
  ]);
  const names = ["north m/s", "east m/s", "down m/s", "north m", "east m", "down m", "yaw"], body = $("setpoint").tBodies[0];
  names.forEach((name, index) => {
    const row = body.rows[index] || body.insertRow();
    if (!row.cells.length) { const head = document.createElement("th"); head.scope = "row"; head.textContent = name; row.append(head); for (let n = 0; n < 3; n++) row.insertCell(); }
    columns.forEach((column, n) => setText(row.cells[n + 1], column[index]));
  });
  const limits = fresh ? fresh.limited_by || [] : [];
  setText($("limited"), limits.length ? `Limited by: ${limits.join(", ")}` : fresh ? "" : "Not in command: no setpoints.");
}

function sized(canvas) {
  const scale = devicePixelRatio || 1, width = Math.round(canvas.clientWidth * scale), height = Math.round(canvas.clientHeight * scale);
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  const g = canvas.getContext("2d");
  g.setTransform(scale, 0, 0, scale, 0, 0);
  g.clearRect(0, 0, width, height);
  g.font = "12px system-ui, sans-serif";
  return [g, canvas.clientWidth, canvas.clientHeight];
}

function drawMap(vehicle, limits) {
  const [g, width, height] = sized($("map")), home = vehicle.home_ned_m || [0, 0, 0], own = vehicle.position_ned_m;
  const about = (corners) => (corners || []).map(([n, e]) => [n + home[0], e + home[1]]);
  const include = about(limits.fence_include), exclude = (limits.fence_exclude || []).map(about);
  const tracks = mapTracks(), others = state.vehicles.filter((one) => one.name !== state.vehicle && one.at_ned_m);
  const points = [home, ...state.trail, ...tracks.map((track) => track.at), ...others.map((one) => one.at_ned_m), ...include, ...exclude.flat()];
  if (own) points.push(own);
  const norths = points.map((p) => p[0]), easts = points.map((p) => p[1]);
  const span = Math.max(20, 1.2 * (Math.max(...norths) - Math.min(...norths)), 1.2 * (Math.max(...easts) - Math.min(...easts)) * height / width);
  const scale = height / span, middle = [(Math.max(...norths) + Math.min(...norths)) / 2, (Math.max(...easts) + Math.min(...easts)) / 2];
  const xy = (p) => [width / 2 + (p[1] - middle[1]) * scale, height / 2 - (p[0] - middle[0]) * scale];
  const path = (list, close) => { g.beginPath(); list.forEach((p, n) => g[n ? "lineTo" : "moveTo"](...xy(p))); if (close) g.closePath(); };
  const ink = css("--ink"), soft = css("--soft"), accent = css("--accent"), second = css("--second"), bad = css("--bad");

  const grid = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].find((m) => m * scale >= 45) || 2000;
  g.strokeStyle = css("--line"); g.lineWidth = 1;
  for (let n = Math.ceil((middle[0] - span / 2) / grid) * grid; n <= middle[0] + span / 2; n += grid) { const y = xy([n, 0])[1]; g.beginPath(); g.moveTo(0, y); g.lineTo(width, y); g.stroke(); }
  const across = width / scale;
  for (let e = Math.ceil((middle[1] - across / 2) / grid) * grid; e <= middle[1] + across / 2; e += grid) { const x = xy([0, e])[0]; g.beginPath(); g.moveTo(x, 0); g.lineTo(x, height); g.stroke(); }
  g.lineWidth = 2;
  if (include.length) { path(include, true); g.strokeStyle = css("--good"); g.stroke(); }
  for (const area of exclude) { path(area, true); g.strokeStyle = bad; g.fillStyle = `${bad}33`; g.fill(); g.stroke(); }
  if (state.trail.length > 1) { path(state.trail); g.strokeStyle = accent; g.globalAlpha = .55; g.stroke(); g.globalAlpha = 1; }
  const labels = [];
  const note = (text, x, y) => {
    const size = g.measureText(text).width, left = Math.max(2, Math.min(x + 8, width - size - 2));
    if (labels.some((one) => Math.abs(one.y - y) < 13 && left < one.right && one.left < left + size)) return;
    labels.push({ y, left, right: left + size });
    g.fillStyle = ink; g.fillText(text, left, y + 4);
  };
  const arrow = ([x, y], yaw, colour) => {
    g.save(); g.translate(x, y); g.rotate(yaw || 0);
    g.fillStyle = colour; g.strokeStyle = css("--panel"); g.beginPath(); g.moveTo(0, -12); g.lineTo(8, 9); g.lineTo(0, 5); g.lineTo(-8, 9); g.closePath(); g.fill(); g.stroke();
    g.restore();
  };
  for (const one of others) {
    g.globalAlpha = one.state_age_s > STALE_S ? .4 : 1;
    arrow(xy(one.at_ned_m), one.yaw_rad, soft);
    note(one.name, ...xy(one.at_ned_m));
    g.globalAlpha = 1;
  }
  for (const track of tracks.reverse()) { // the newest first: a label is drawn where no other is
    if (track.trail.length > 1) { path(track.trail); g.strokeStyle = second; g.globalAlpha = .5; g.stroke(); g.globalAlpha = 1; }
    const [x, y] = xy(track.at);
    g.fillStyle = second; g.beginPath(); g.arc(x, y, track.chosen ? 7 : 5, 0, 7); g.fill();
    note(track.text, x, y);
  }
  const [hx, hy] = xy(home);
  g.strokeStyle = ink; g.fillStyle = ink;
  g.beginPath(); g.moveTo(hx - 7, hy); g.lineTo(hx, hy - 7); g.lineTo(hx + 7, hy); g.moveTo(hx - 5, hy - 1); g.lineTo(hx - 5, hy + 6); g.lineTo(hx + 5, hy + 6); g.lineTo(hx + 5, hy - 1); g.stroke();
  const setpoint = age("setpoint") < 1 && state.topics.setpoint && state.topics.setpoint.sent;
  if (own) {
    const [x, y] = xy(own);
    if (setpoint && setpoint.velocity_ned_mps) {
      const [n, e] = setpoint.velocity_ned_mps;
      g.strokeStyle = second; g.beginPath(); g.moveTo(x, y); g.lineTo(x + 12 * e, y - 12 * n); g.stroke();
    }
    arrow([x, y], vehicle.yaw_rad, accent);
    if (isFleet()) note(state.vehicle, x, y);
  }
  g.fillStyle = soft; g.strokeStyle = soft;
  g.fillText(`${grid} m`, 10, height - 14);
  g.beginPath(); g.moveTo(10, height - 8); g.lineTo(10 + grid * scale, height - 8); g.stroke();
  g.textAlign = "center"; g.fillText("N", width - 14, 24); g.textAlign = "left";
  g.beginPath(); g.moveTo(width - 14, 6); g.lineTo(width - 18, 13); g.lineTo(width - 10, 13); g.fill();
  const where = own ? `vehicle ${(own[0] - home[0]).toFixed(0)} m north and ${(own[1] - home[1]).toFixed(0)} m east of home` : "position unknown";
  const listed = isFleet() ? `, ${[...others, ...tracks].slice(0, 20).map((one) => one.text || one.name).join("; ")}` : "";
  $("map").setAttribute("aria-label", `Map, north up: ${where}, ${tracks.length} tracks${listed}`);
}

function mapTracks() {
  // The shown vehicle's tracks with their trails, and what only others see; an object that several see is drawn once.
  const drawn = [], merged = new Map();
  for (const { class_name: name, at_ned_m: at, tracks } of state.objects) {
    const own = tracks.find(([vehicle, id]) => vehicle === state.vehicle && state.tracks.has(id));
    const text = `${name} ${tracks.map(([vehicle, id]) => `${vehicle} #${id}`).join(", ")}`;
    if (own) merged.set(own[1], text);
    else if (at) drawn.push({ at, trail: [], text });
  }
  for (const [id, { at, trail, name }] of state.tracks) {
    if (at) drawn.push({ at, trail, text: merged.get(id) || `${name} ${isFleet() ? `${state.vehicle} ` : ""}#${id}`, chosen: id === state.chosen });
  }
  return drawn;
}

function drawAttitude(vehicle) {
  const [g, width, height] = sized($("attitude")), q = vehicle.attitude_wxyz, r = Math.min(width, height) / 2 - 3;
  g.translate(width / 2, height / 2);
  g.beginPath(); g.arc(0, 0, r, 0, 7); g.strokeStyle = css("--line"); g.lineWidth = 2;
  if (!q) { g.stroke(); $("attitude").setAttribute("aria-label", "Attitude unknown"); return; }
  const [w, x, y, z] = q, roll = Math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y));
  const pitch = Math.asin(Math.max(-1, Math.min(1, 2 * (w * y - z * x))));
  g.save(); g.clip();
  g.rotate(-roll);
  const level = pitch * r / (Math.PI / 4);
  g.fillStyle = "#4a90d9"; g.fillRect(-2 * r, -4 * r, 4 * r, 4 * r + level);
  g.fillStyle = "#8a6239"; g.fillRect(-2 * r, level, 4 * r, 4 * r);
  g.strokeStyle = "#fff"; g.beginPath(); g.moveTo(-2 * r, level); g.lineTo(2 * r, level); g.stroke();
  for (const mark of [-20, -10, 10, 20]) { const at = level - mark * Math.PI / 180 * r / (Math.PI / 4); g.globalAlpha = .6; g.beginPath(); g.moveTo(-r / 5, at); g.lineTo(r / 5, at); g.stroke(); g.globalAlpha = 1; }
  g.restore();
  g.stroke();
  g.strokeStyle = "#ffd23f"; g.lineWidth = 3; g.beginPath(); g.moveTo(-r / 2, 0); g.lineTo(-r / 6, 0); g.moveTo(r / 6, 0); g.lineTo(r / 2, 0); g.stroke();
  const heading = vehicle.yaw_rad == null ? "–" : ((degrees(vehicle.yaw_rad) + 360) % 360).toFixed(0);
  g.fillStyle = "#fff"; g.textAlign = "center"; g.font = "600 12px system-ui, sans-serif"; g.fillText(`${heading}°`, 0, r - 8); g.textAlign = "left";
  $("attitude").setAttribute("aria-label", `Roll ${degrees(roll).toFixed(0)}°, pitch ${degrees(pitch).toFixed(0)}°, heading ${heading}°`);
}

function drawChart(canvas, label, series, names, unit) {
  const [g, width, height] = sized(canvas), now = performance.now(), colours = [css("--accent"), css("--second")];
  const keys = Object.keys(names), values = series.flatMap((one) => keys.map((key) => one[key])).filter((value) => value != null);
  const steps = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 1e4, 1e5], top = steps.find((step) => step >= Math.max(0, ...values)) || 1e6;
  const foot = height - 4, y = (value) => foot - value / top * (foot - 6);
  g.strokeStyle = css("--line"); g.fillStyle = css("--soft");
  for (const value of [0, top / 2, top]) { g.beginPath(); g.moveTo(38, y(value)); g.lineTo(width, y(value)); g.stroke(); g.fillText(String(value), 2, Math.max(11, y(value) + (value ? 4 : 0))); }
  keys.forEach((key, n) => {
    g.strokeStyle = colours[n]; g.lineWidth = 1.6; g.beginPath();
    let pen = false;
    for (const one of series) {
      if (one[key] == null) { pen = false; continue; }
      const x = 38 + (width - 38) * (1 - (now - one.at) / (HISTORY_S * 1000));
      g[pen ? "lineTo" : "moveTo"](x, y(one[key])); pen = true;
    }
    g.stroke();
  });
  const last = series.at(-1) || {}, digits = unit === "ms" ? 0 : 1;
  const shown = keys.filter((key) => last[key] != null).map((key) => [key, `${names[key]} ${last[key].toFixed(digits)} ${unit}`]);
  const text = shown.map(([, words]) => words).join(", ");
  if (label.dataset.text !== text) {
    label.dataset.text = text;
    label.replaceChildren(...shown.flatMap(([key, words], n) => {
      const mark = document.createElement("b");
      mark.textContent = " — "; mark.style.color = colours[keys.indexOf(key)];
      return [mark, words];
    }));
  }
  canvas.setAttribute("aria-label", `${canvas.id === "latency" ? "Latency" : "Frames lost"} of the last minute: ${text || "no values yet"}`);
}

function log(level, text, agoS) {
  const item = document.createElement("li"), time = document.createElement("time");
  time.textContent = new Date(Date.now() - Math.max(0, agoS < 1e5 ? agoS : 0) * 1000).toLocaleTimeString();
  item.className = level;
  item.append(time, " ", level === "info" ? text : `${level}: ${text}`);
  $("log").prepend(item);
  while ($("log").children.length > LOG_LINES) $("log").lastChild.remove();
}

document.addEventListener("visibilitychange", () => { if (document.hidden) disconnect(); else { connect(); measureClock(); } });
addEventListener("pagehide", disconnect);
addEventListener("pageshow", connect);
connect();
measureClock();
setInterval(measureClock, 30000);
setInterval(() => { if (!document.hidden) requestAnimationFrame(render); }, 100);
