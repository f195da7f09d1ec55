// What several modules draw with, and the boxes in the video.

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

// Draws a box, in fractions of the video's width and height, with its label.
export function drawBox(g, [l, t, r, b, name, confidence, id, kind], isChosen, scale) {
  const { width, height, clientWidth } = g.canvas;
  const isTentative = kind === "tentative" || kind === "none";
  const colour = isChosen ? CHOSEN : isTentative ? TENTATIVE : CONFIRMED;
  const x = l * width;
  const y = t * height;
  const h = (b - t) * height;
  for (const [style, thickness] of [["#000a", 2], [colour, 0]]) {
    g.strokeStyle = style;
    g.lineWidth = ((isChosen ? 4 : 2) + thickness) * scale;
    g.strokeRect(x, y, (r - l) * width, h);
  }
  const words = [name];
  if (id != null) words.push(`#${id}`);
  if (clientWidth >= 420) words.push(Number(confidence).toFixed(2));
  const text = words.join(" ");
  const line = 18 * scale;
  const size = g.measureText(text).width + 8 * scale;
  const left = Math.max(0, Math.min(x, width - size));
  const top = y >= line ? y - line : Math.min(y + h, height - line);
  g.fillStyle = colour;
  g.fillRect(left, top, size, line);
  g.fillStyle = "#0b0e12";
  g.fillText(text, left + 4 * scale, top + 2 * scale);
}
