// What is drawn on all canvases but the video.

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
