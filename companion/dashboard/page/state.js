// What the page knows, and small functions that all its modules use.

export const ALL = "*"; // as the vehicle of a stop
export { STALE_S } from "./outage.js";
export const HISTORY_S = 60; // of the charts

const address = new URLSearchParams(location.search);

export const state = {
  at: 0, // of the newest news, in milliseconds of performance.now()
  problem: "connecting to the dashboard",
  refused: "",
  alive: null,
  outage: null, // why nothing here is true any more (outage.js)
  replaced: false, // the browser has too many windows of this page
  stream: null,
  maxImages: 0, // in flight
  offsetNs: null, // of the dashboard's clock to performance.now()
  vehicle: address.get("vehicle") || "",
  vehicles: [],
  objects: [],
  trails: new Map(), // of all vehicles, by name; each in its own local NED
  ...ofOneVehicle(),
};

// What is dropped when another vehicle is shown.
export function ofOneVehicle() {
  return {
    topics: {},
    ages: {},
    tracks: new Map(), // by id
    latency: [],
    drops: [],
    lost: null,
    chosen: null,
    mission: null,
    videoMs: null,
  };
}

export const cameras = new Map(); // by name

export const isFleet = () => state.vehicles.length > 1;

// Seconds since the newest message of a topic.
export function age(path) {
  const known = state.ages[path];
  return known == null ? null : known + (performance.now() - state.at) / 1000;
}

// Adds a point of a chart, and drops those that are too old.
export function record(series, values) {
  series.push({ at: performance.now(), ...values });
  while (series.length && series[0].at < performance.now() - HISTORY_S * 1000) series.shift();
}

export function showAddress(vehicle) {
  history.replaceState(null, "", vehicle ? `/?vehicle=${encodeURIComponent(vehicle)}` : "/");
}
if (address.has("token")) showAddress(state.vehicle); // the cookie is set now

const newId = () => Math.random().toString(36).slice(2);

function keptId(storage, name, without) {
  try {
    const id = window[storage].getItem(name) || newId();
    window[storage].setItem(name, id);
    return id;
  } catch {
    return without; // storage is off
  }
}

const ownId = newId();
export const browserId = () => keptId("localStorage", "browser", "");
export const windowId = () => keptId("sessionStorage", "window", ownId); // the same after a reload

export async function measureClock() {
  // The fastest of five requests has the smallest error.
  let best = Infinity;
  for (let count = 0; count < 5 && !document.hidden; count++) {
    try {
      const begun = performance.now();
      const response = await fetch("/clock");
      const ended = performance.now();
      const { now_ns } = await response.json();
      if (ended - begun >= best) continue;
      best = ended - begun;
      state.offsetNs = now_ns - (begun + ended) / 2 * 1e6;
    } catch {
      return;
    }
  }
}

export const $ = (id) => document.getElementById(id);
export const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
export const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
export const number = (value, digits) => value.toFixed(digits).replace(/^-(?=0(\.0*)?$)/, ""); // no -0.0
export const degrees = (radians) => radians * 180 / Math.PI;
export const heading = (yawRad) => yawRad == null ? "–" : `${((degrees(yawRad) + 360) % 360).toFixed(0)}°`;

export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function button(text, onclick) {
  const item = document.createElement("button");
  item.type = "button";
  item.textContent = text;
  item.onclick = onclick;
  return item;
}
