// The stream of server-sent events (`/events`): what is new of the shown vehicle, and the map of all vehicles.

import { camera, endCameras } from "./cameras.js";
import { clearChat, showChat } from "./chat.js";
import { closeMenu, onCommandState, onReply, showAnswer } from "./commands.js";
import { $, browserId, ofOneVehicle, record, showAddress, state, windowId } from "./state.js";

const TRAIL_M = 0.3; // between two points of a trail
const TRAIL_POINTS = 500;
const TRACK_TRAIL_POINTS = 100;
const TRACK_SHOWN_MS = 10000;
const LOG_LINES = 200;
const MAX_IMAGES = 2; // in flight; with the stream and those of a second window, a browser has connections left

export function connect() {
  if (state.stream || document.hidden || state.replaced) return;
  const query = new URLSearchParams({ browser: browserId(), window: windowId(), vehicle: state.vehicle });
  const stream = state.stream = new EventSource(`/events?${query}`);
  stream.onopen = () => $("log").replaceChildren(); // a new stream begins with all kept events
  stream.onmessage = (event) => onNews(JSON.parse(event.data));
  stream.addEventListener("replaced", () => {
    disconnect();
    state.replaced = true; // the browser has too many windows of this page for one server
  });
  stream.onerror = () => {
    if (stream !== state.stream || stream.readyState !== EventSource.CLOSED) return;
    disconnect();
    explain();
    setTimeout(connect, 2000);
  };
}

export function disconnect() {
  if (state.stream) state.stream.close();
  state.stream = null;
}

async function explain() {
  // An EventSource does not report an HTTP error's status.
  try {
    const response = await fetch("/clock");
    state.refused = response.ok ? "" : (await response.text()).trim();
  } catch {
    state.refused = "";
  }
}

// Shows another vehicle.
export function select(vehicle) {
  if (vehicle === state.vehicle) return;
  closeMenu();
  disconnect();
  Object.assign(state, ofOneVehicle(), { vehicle, at: 0, alive: null, objects: [] });
  endCameras();
  clearChat();
  $("log").replaceChildren();
  $("class").replaceChildren();
  $("vehicle").textContent = document.title = vehicle;
  showAddress(vehicle);
  connect();
}

function onNews(news) {
  state.at = performance.now();
  state.refused = "";
  state.maxImages = news.windows > 1 ? 1 : MAX_IMAGES;
  state.problem = news.problem;
  state.alive = news.alive;
  state.ages = news.ages_s;
  state.vehicle = $("vehicle").textContent = document.title = news.vehicle_name;
  state.vehicles = news.vehicles;
  state.objects = news.objects;
  Object.assign(state.topics, news.topics);
  extendTrails(news.vehicles);
  for (const [path, message] of Object.entries(news.topics)) {
    if (path.endsWith("detections")) onDetections(path, message);
  }
  if (news.topics.status) onStatus(news.topics.status);
  for (const event of news.events) log(event.level, event.text, (news.now_ns - event.stamp_ns) / 1e9);
  news.command_states.forEach(onCommandState);
  news.replies.forEach(onReply);
  showAnswer();
  if (news.chat) showChat(news.chat);
}

export function extendTrails(vehicles) {
  const trails = new Map();
  for (const { name, own_ned_m: own } of vehicles) {
    const shown = name === state.vehicle && state.topics.vehicle;
    trails.set(name, state.trails.get(name) || []);
    extend(trails.get(name), shown ? shown.position_ned_m : own, TRAIL_POINTS);
  }
  state.trails = trails; // those of vehicles that are gone are dropped
}

function extend(trail, at, limit) {
  const last = trail.at(-1);
  if (at && (!last || Math.hypot(at[0] - last[0], at[1] - last[1]) > TRAIL_M)) trail.push(at);
  if (trail.length > limit) trail.shift();
}

function onDetections(path, message) {
  const name = cameraOf(path);
  camera(name);
  const now = performance.now();
  for (const { confirmed, position_ned_m: at, track_ids: ids, class_name } of message.objects || []) {
    if (!confirmed || !at || !ids.length) continue;
    const { trail } = state.tracks.get(ids.find((id) => state.tracks.has(id))) || { trail: [] };
    extend(trail, at, TRACK_TRAIL_POINTS);
    for (const id of ids) state.tracks.delete(id); // the image tracker has changed it
    state.tracks.set(ids.at(-1), { at, trail, name: class_name, seen: now });
  }
  for (const [id, track] of state.tracks) {
    if (now - track.seen > TRACK_SHOWN_MS) state.tracks.delete(id);
  }
  if (name === "" && message.published_ns) {
    record(state.latency, { result: (message.published_ns - message.captured_ns) / 1e6, video: state.videoMs });
  }
}

// The name of the camera of a path such as `cameras/down/detections`.
export function cameraOf(path) {
  return path === "detections" ? "" : path.split("/")[1];
}

function onStatus(status) {
  const views = { "": status.perception, ...status.cameras };
  let skipped = 0;
  let dropped = 0;
  for (const [name, view] of Object.entries(views)) {
    if (!view || view.state === "stopped") continue;
    camera(name).status = view;
    dropped += view.dropped || 0;
    skipped += (view.frames_skipped || {}).rate || 0;
  }
  const before = state.lost;
  const now = performance.now();
  state.lost = { at: now, dropped, skipped, service: status.service };
  if (before && before.service === status.service && now > before.at) {
    const s = (now - before.at) / 1000;
    const rate = (count, earlier) => Math.max(0, count - earlier) / s;
    record(state.drops, { dropped: rate(dropped, before.dropped), skipped: rate(skipped, before.skipped) });
  }
  const names = (status.perception && status.perception.class_names) || [];
  const list = $("class");
  if (names.join() !== [...list.options].map((option) => option.value).join()) {
    list.replaceChildren(...names.map((name) => new Option(name)));
    if (names.includes("car")) list.value = "car";
  }
  if (status.pilot && status.pilot.mission) state.mission = status.pilot.mission;
}

function log(level, text, agoS) {
  const time = document.createElement("time");
  time.textContent = new Date(Date.now() - Math.max(0, agoS < 1e5 ? agoS : 0) * 1000).toLocaleTimeString();
  const item = document.createElement("li");
  item.className = level;
  item.append(time, " ", level === "info" ? text : `${level}: ${text}`);
  $("log").prepend(item);
  while ($("log").children.length > LOG_LINES) $("log").lastChild.remove();
}
