// What several modules draw with, and the boxes in the video.

import { placeLabel } from "./labels.js";

const CHOSEN = "#ffd23f";
const CONFIRMED = "#39e07f";
const TENTATIVE = "#c9d1dc";

// Returns the cleared drawing context of a canvas, and its width and height in CSS pixels.
export function sized(canvas) {
  const scale = devicePixelRatio || 1;
  const width = Math.round(canvas.clientWidth * scale);
  const height = Math.round(canvas.clientHeight * scale);
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  const g = canvas.getContext("2d");
  g.setTransform(scale, 0, 0, scale, 0, 0);
  g.clearRect(0, 0, width, height);
  g.font = "12px system-ui, sans-serif";
  return [g, canvas.clientWidth, canvas.clientHeight];
}

// Begins a path through points, in pixels.
export function trace(g, points) {
  g.beginPath();
  points.forEach((point, index) => g[index ? "lineTo" : "moveTo"](...point));
}

export function drawLine(g, ...points) {
  trace(g, points);
  g.stroke();
}

// Draws boxes, in fractions of the video's width and height, with their labels: the chosen and the confirmed ones
// choose the place of theirs first.
export function drawBoxes(g, boxes, chosen, scale) {
  const rank = (box) => box[6] != null && box[6] === chosen ? 0 : isUnsure(box) ? 2 : 1;
  const inOrder = [...boxes].sort((one, other) => rank(one) - rank(other));
  for (const box of [...inOrder].reverse()) drawBox(g, box, rank(box) === 0, scale);
  const occupied = [];
  for (const box of inOrder) drawLabel(g, box, rank(box) === 0, scale, occupied);
}

const isUnsure = (box) => box[7] === "tentative" || box[7] === "none";
const colourOf = (box, isChosen) => isChosen ? CHOSEN : isUnsure(box) ? TENTATIVE : CONFIRMED;

function drawBox(g, box, isChosen, scale) {
  const { width, height } = g.canvas;
  const [l, t, r, b] = box;
  const colour = colourOf(box, isChosen);
  for (const [style, thickness] of [["#000a", 2], [colour, 0]]) {
    g.strokeStyle = style;
    g.lineWidth = ((isChosen ? 4 : 2) + thickness) * scale;
    g.strokeRect(l * width, t * height, (r - l) * width, (b - t) * height);
  }
}

function drawLabel(g, box, isChosen, scale, occupied) {
  const { width, height, clientWidth } = g.canvas;
  const [l, t, r, b, name, confidence, id] = box;
  const words = [name];
  if (id != null) words.push(`#${id}`);
  if (clientWidth >= 420) words.push(Number(confidence).toFixed(2));
  const text = words.join(" ");
  const line = 18 * scale;
  const size = g.measureText(text).width + 8 * scale;
  const place = placeLabel([l * width, t * height, r * width, b * height], [size, line], [width, height], occupied);
  if (!place) return;
  occupied.push(place);
  const [left, top] = place;
  g.fillStyle = colourOf(box, isChosen);
  g.fillRect(left, top, size, line);
  g.fillStyle = "#0b0e12";
  g.fillText(text, left + 4 * scale, top + 2 * scale);
}
