// The map, north up, in the shown vehicle's local NED.

import { drawLine, sized, trace } from "./canvas.js";
import { $, age, css, isFleet, STALE_S, state } from "./state.js";

const GRIDS_M = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000];
const MIN_SPAN_M = 20;
const MIN_GRID_PX = 45;
const MAX_NAMED = 20; // for a screen reader
const ARROW_PX = 11; // from the middle of a vehicle's arrow to its edge
const DOT_PX = 6;
const LINE_PX = 14; // height of a label

export function drawMap(vehicle, limits) {
  if (!state.at) return; // the map of the vehicle before is left until the new one's state has come
  const home = vehicle.home_ned_m || [0, 0, 0];
  const own = vehicle.position_ned_m;
  const around = (corners) => (corners || []).map(([n, e]) => [n + home[0], e + home[1]]);
  const include = around(limits.fence_include);
  const exclude = (limits.fence_exclude || []).map(around);
  const others = state.vehicles.filter((one) => one.name !== state.vehicle && one.at_ned_m);
  const tracks = mapTracks();
  const ownTrail = state.trails.get(state.vehicle) || [];
  const otherTrails = others.map(trailOf);
  const view = fit([
    home, ...ownTrail, ...tracks.map((track) => track.at), ...others.map((one) => one.at_ned_m),
    ...otherTrails.flat(), ...include, ...exclude.flat(), ...(own ? [own] : []),
  ]);

  drawGrid(view);
  drawFence(view, include, exclude);
  for (const trail of otherTrails) drawTrail(view, trail, css("--soft"));
  drawTrail(view, ownTrail, css("--accent"));
  for (const track of tracks) {
    drawTrail(view, track.trail, css("--second"));
    drawDot(view, track.at, track.chosen ? 7 : 5);
  }
  drawHome(view, home);
  for (const one of others) {
    view.g.globalAlpha = one.state_age_s > STALE_S ? .4 : 1;
    drawArrow(view, one.at_ned_m, one.yaw_rad, css("--soft"));
    view.g.globalAlpha = 1;
  }
  if (own) {
    drawSetpoint(view, own);
    drawArrow(view, own, vehicle.yaw_rad, css("--accent"));
  }
  drawScale(view);
  for (const one of others) reserve(view, one.at_ned_m, ARROW_PX);
  if (own) reserve(view, own, ARROW_PX);
  for (const track of tracks) reserve(view, track.at, DOT_PX);
  // A label is drawn where nothing else is: vehicles first, then the newest tracks.
  if (own && isFleet()) drawLabel(view, own, ARROW_PX, state.vehicle);
  for (const one of others) drawLabel(view, one.at_ned_m, ARROW_PX, one.name);
  for (const track of [...tracks].reverse()) drawLabel(view, track.at, DOT_PX, track.text, track.short);

  const north = own && (own[0] - home[0]).toFixed(0);
  const east = own && (own[1] - home[1]).toFixed(0);
  const where = own ? `vehicle ${north} m north and ${east} m east of home` : "position unknown";
  const names = [...others.map((one) => one.name), ...tracks.map((track) => track.text)];
  const listed = isFleet() ? `, ${names.slice(0, MAX_NAMED).join("; ")}` : "";
  $("map").setAttribute("aria-label", `Map, north up: ${where}, ${tracks.length} tracks${listed}`);
}

// The trail of another vehicle, in the shown one's local NED.
function trailOf({ name, at_ned_m: at, own_ned_m: own }) {
  const trail = own ? state.trails.get(name) || [] : [];
  return trail.map(([n, e]) => [n + at[0] - own[0], e + at[1] - own[1]]);
}

// The shown vehicle's tracks with their trails, and what only others see. An object that several see is drawn once.
function mapTracks() {
  const drawn = [];
  const merged = new Map();
  for (const { class_name: name, at_ned_m: at, tracks } of state.objects) {
    const own = tracks.find(([vehicle, id]) => vehicle === state.vehicle && state.tracks.has(id));
    const text = `${name} ${tracks.map(([vehicle, id]) => `${vehicle} #${id}`).join(", ")}`;
    const short = own ? `${name} #${own[1]}` : name;
    if (own) merged.set(own[1], { text, short });
    else if (at) drawn.push({ at, trail: [], text, short });
  }
  for (const [id, { at, trail, name }] of state.tracks) {
    const short = `${name} #${id}`;
    const text = isFleet() ? `${name} ${state.vehicle} #${id}` : short;
    drawn.push({ at, trail, text, short, ...merged.get(id), chosen: id === state.chosen });
  }
  return drawn;
}

// Returns what the functions below draw with: all points are inside, with a margin.
function fit(points) {
  const [g, width, height] = sized($("map"));
  const norths = points.map((point) => point[0]);
  const easts = points.map((point) => point[1]);
  const [south, north] = [Math.min(...norths), Math.max(...norths)];
  const [west, east] = [Math.min(...easts), Math.max(...easts)];
  const span = Math.max(MIN_SPAN_M, 1.2 * (north - south), 1.2 * (east - west) * height / width);
  const scale = height / span;
  const middle = [(north + south) / 2, (east + west) / 2];
  const xy = ([n, e]) => [width / 2 + (e - middle[1]) * scale, height / 2 - (n - middle[0]) * scale];
  const grid = GRIDS_M.find((m) => m * scale >= MIN_GRID_PX) || 2000;
  return { g, width, height, scale, middle, xy, grid, taken: [] };
}

function drawGrid({ g, width, height, scale, middle, xy, grid }) {
  g.strokeStyle = css("--line");
  g.lineWidth = 1;
  const marks = (centre, span) => {
    const first = Math.ceil((centre - span / 2) / grid);
    const last = Math.floor((centre + span / 2) / grid);
    return Array.from({ length: last - first + 1 }, (_, index) => (first + index) * grid);
  };
  for (const n of marks(middle[0], height / scale)) {
    const y = xy([n, 0])[1];
    drawLine(g, [0, y], [width, y]);
  }
  for (const e of marks(middle[1], width / scale)) {
    const x = xy([0, e])[0];
    drawLine(g, [x, 0], [x, height]);
  }
}

function drawFence({ g, xy }, include, exclude) {
  g.lineWidth = 2;
  for (const corners of [include, ...exclude]) {
    const colour = corners === include ? css("--good") : css("--bad");
    trace(g, corners.map(xy));
    g.closePath();
    g.strokeStyle = colour;
    g.fillStyle = `${colour}33`;
    if (corners !== include) g.fill();
    g.stroke();
  }
}

function drawTrail({ g, xy }, trail, colour) {
  if (trail.length < 2) return;
  g.strokeStyle = colour;
  g.globalAlpha = .5;
  drawLine(g, ...trail.map(xy));
  g.globalAlpha = 1;
}

// Notes that no label may be drawn at a symbol.
function reserve({ xy, taken }, at, radius) {
  const [x, y] = xy(at);
  taken.push({ left: x - radius, right: x + radius, top: y - radius, bottom: y + radius });
}

// Draws the first of some texts that has room around a symbol, beside it first; none without room.
function drawLabel({ g, width, height, xy, taken }, at, radius, ...texts) {
  const [x, y] = xy(at);
  for (const text of texts) {
    const size = g.measureText(text).width;
    const gap = radius + 3;
    const places = [
      [x + gap, y - LINE_PX / 2], [x - gap - size, y - LINE_PX / 2],
      [x - size / 2, y - radius - LINE_PX], [x - size / 2, y + radius],
      ...[y - radius - LINE_PX, y + radius].flatMap((top) => [[x + radius, top], [x - radius - size, top]]),
    ];
    const boxes = places.map(([left, top]) => ({ left, right: left + size, top, bottom: top + LINE_PX }));
    const isFree = (box) => box.left >= 0 && box.right <= width && box.top >= 0 && box.bottom <= height
      && !taken.some((one) => box.left < one.right && one.left < box.right
        && box.top < one.bottom && one.top < box.bottom);
    const box = boxes.find(isFree);
    if (!box) continue;
    taken.push(box);
    g.strokeStyle = css("--water");
    g.lineWidth = 3;
    g.strokeText(text, box.left, box.bottom - 3);
    g.fillStyle = css("--ink");
    g.fillText(text, box.left, box.bottom - 3);
    return;
  }
}

function drawArrow({ g, xy }, at, yaw, colour) {
  g.save();
  g.translate(...xy(at));
  g.rotate(yaw || 0);
  g.fillStyle = colour;
  g.strokeStyle = css("--panel");
  trace(g, [[0, -12], [8, 9], [0, 5], [-8, 9]]);
  g.closePath();
  g.fill();
  g.stroke();
  g.restore();
}

function drawDot({ g, xy }, at, radius) {
  g.fillStyle = css("--second");
  g.beginPath();
  g.arc(...xy(at), radius, 0, 7);
  g.fill();
}

function drawHome({ g, xy }, home) {
  g.save();
  g.translate(...xy(home));
  g.strokeStyle = css("--ink");
  drawLine(g, [-7, 0], [0, -7], [7, 0]);
  drawLine(g, [-5, -1], [-5, 6], [5, 6], [5, -1]);
  g.restore();
}

function drawSetpoint({ g, xy }, own) {
  const { sent, path_ned_m: path } = age("setpoint") < 1 && state.topics.setpoint || {};
  g.strokeStyle = css("--second");
  if (path && path.length > 1) drawLine(g, ...path.map(xy)); // around obstacles
  if (!sent || !sent.velocity_ned_mps) return;
  const [north, east] = sent.velocity_ned_mps;
  const [x, y] = xy(own);
  drawLine(g, [x, y], [x + 12 * east, y - 12 * north]);
}

function drawScale({ g, width, height, scale, grid, taken }) {
  taken.push({ left: 0, right: 14 + grid * scale, top: height - 28, bottom: height });
  taken.push({ left: width - 24, right: width, top: 0, bottom: 28 });
  g.fillStyle = g.strokeStyle = css("--soft");
  g.fillText(`${grid} m`, 10, height - 14);
  drawLine(g, [10, height - 8], [10 + grid * scale, height - 8]);
  g.textAlign = "center";
  g.fillText("N", width - 14, 24);
  g.textAlign = "left";
  trace(g, [[width - 14, 6], [width - 18, 13], [width - 10, 13]]);
  g.fill();
}
