// The attitude, and the charts of the last minute.

import { drawLine, sized } from "./canvas.js";
import { $, css, degrees, heading, HISTORY_S } from "./state.js";

const HALF_HEIGHT_RAD = Math.PI / 4; // pitch from the middle to the edge
const PITCH_MARKS_DEG = [-20, -10, 10, 20];
const NUMBERS_PX = 38; // of a chart's width
const TOPS = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 1e4, 1e5];

export function drawAttitude(vehicle) {
  const [g, width, height] = sized($("attitude"));
  const r = Math.min(width, height) / 2 - 3;
  g.translate(width / 2, height / 2);
  g.beginPath();
  g.arc(0, 0, r, 0, 7);
  g.strokeStyle = css("--line");
  g.lineWidth = 2;
  if (!vehicle.attitude_wxyz) {
    g.stroke();
    $("attitude").setAttribute("aria-label", "Attitude unknown");
    return;
  }
  const [w, x, y, z] = vehicle.attitude_wxyz;
  const roll = Math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y));
  const pitch = Math.asin(Math.max(-1, Math.min(1, 2 * (w * y - z * x))));
  g.save();
  g.clip();
  g.rotate(-roll);
  const level = pitch * r / HALF_HEIGHT_RAD;
  g.fillStyle = "#4a90d9";
  g.fillRect(-2 * r, -4 * r, 4 * r, 4 * r + level);
  g.fillStyle = "#8a6239";
  g.fillRect(-2 * r, level, 4 * r, 4 * r);
  g.strokeStyle = "#fff";
  drawLine(g, [-2 * r, level], [2 * r, level]);
  g.globalAlpha = .6;
  for (const mark of PITCH_MARKS_DEG) {
    const at = level - mark * Math.PI / 180 * r / HALF_HEIGHT_RAD;
    drawLine(g, [-r / 5, at], [r / 5, at]);
  }
  g.restore();
  g.beginPath();
  g.arc(0, 0, r, 0, 7);
  g.stroke();
  g.strokeStyle = "#ffd23f";
  g.lineWidth = 3;
  drawLine(g, [-r / 2, 0], [-r / 6, 0]);
  drawLine(g, [r / 6, 0], [r / 2, 0]);
  g.fillStyle = "#fff";
  g.textAlign = "center";
  g.font = "600 12px system-ui, sans-serif";
  g.fillText(heading(vehicle.yaw_rad), 0, r - 8);
  g.textAlign = "left";
  const [rollText, pitchText] = [roll, pitch].map((angle) => `${degrees(angle).toFixed(0)}°`);
  const label = `Roll ${rollText}, pitch ${pitchText}, heading ${heading(vehicle.yaw_rad)}`;
  $("attitude").setAttribute("aria-label", label);
}

// Draws the values of the last minute.
//   label: gets the newest values. series: of `record`. names: key of a value → its name, two at most.
export function drawChart(canvas, title, label, series, names, unit) {
  const [g, width, height] = sized(canvas);
  const colours = [css("--accent"), css("--second")];
  const keys = Object.keys(names);
  const values = series.flatMap((one) => keys.map((key) => one[key])).filter((value) => value != null);
  const top = TOPS.find((step) => step >= Math.max(0, ...values)) || 1e6;
  const foot = height - 4;
  const toY = (value) => foot - value / top * (foot - 6);
  g.strokeStyle = css("--line");
  g.fillStyle = css("--soft");
  for (const value of [0, top / 2, top]) {
    drawLine(g, [NUMBERS_PX, toY(value)], [width, toY(value)]);
    g.fillText(String(value), 2, Math.max(11, toY(value) + (value ? 4 : 0)));
  }
  const now = performance.now();
  const toX = (at) => NUMBERS_PX + (width - NUMBERS_PX) * (1 - (now - at) / (HISTORY_S * 1000));
  keys.forEach((key, index) => {
    g.strokeStyle = colours[index];
    g.lineWidth = 1.6;
    g.beginPath();
    let isDown = false;
    for (const one of series) {
      if (one[key] != null) g[isDown ? "lineTo" : "moveTo"](toX(one.at), toY(one[key]));
      isDown = one[key] != null;
    }
    g.stroke();
  });

  const newest = series.at(-1) || {};
  const digits = unit === "ms" ? 0 : 1;
  const shown = keys.filter((key) => newest[key] != null);
  const words = shown.map((key) => `${names[key]} ${newest[key].toFixed(digits)} ${unit}`);
  const text = words.join(", ");
  canvas.setAttribute("aria-label", `${title} of the last minute: ${text || "no values yet"}`);
  const drawn = text + colours; // they change with the colour scheme
  if (label.dataset.drawn === drawn) return;
  label.dataset.drawn = drawn;
  label.replaceChildren(...shown.flatMap((key, index) => {
    const mark = document.createElement("b");
    mark.textContent = " — ";
    mark.style.color = colours[keys.indexOf(key)];
    return [mark, words[index]];
  }));
}
