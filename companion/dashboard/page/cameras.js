// A canvas for each camera. Each image is requested when the one before is drawn, so a slow connection gets
// fewer images, never older ones. The cameras take turns: a browser has six connections to one host, and one
// has to be free for a stop command.

import { drawBoxes } from "./canvas.js";
import { openMenu, send } from "./commands.js";
import { $, button, cameras, pause, setText, state } from "./state.js";

const IMAGE_PERIOD_MS = 60;
const IDLE_PERIOD_MS = 500;
const FAULT_PERIOD_MS = 1000;
const DRAG_PX = 8;

// Returns the view of a camera, and begins it; an empty name is the first camera.
export function camera(name) {
  if (!cameras.has(name)) {
    const view = new Camera(name);
    cameras.set(name, view);
    $("cameras").append(view.figure);
    view.run();
  }
  return cameras.get(name);
}

// Cameras that wait for their turn, the longest first: what to call when it has come.
const queue = [];
let inFlight = 0;

function takeTurn() {
  return new Promise((begin) => {
    queue.push(begin);
    nextTurn();
  });
}

function endTurn() {
  inFlight--;
  nextTurn();
}

function nextTurn() {
  while (queue.length && inFlight < state.maxImages) {
    inFlight++;
    queue.shift()();
  }
}

const isCrowded = () => cameras.size > state.maxImages;

export function endCameras() {
  for (const view of cameras.values()) view.end();
  cameras.clear();
}

export class Camera {
  constructor(name) {
    this.name = name;
    this.label = name || "first camera";
    this.vehicle = state.vehicle;
    this.ended = false;
    this.bitmap = null;
    this.about = null; // the frame and the boxes of `bitmap`
    this.at = 0; // of the newest image, in milliseconds of performance.now()
    this.times = []; // of the images of the last two seconds
    this.latencyMs = null;
    this.isIdle = false; // the newest request got no image
    this.status = {};
    this.drag = null;

    this.canvas = document.createElement("canvas");
    this.canvas.setAttribute("role", "img");
    this.canvas.addEventListener("pointerdown", (event) => this.press(event));
    this.canvas.addEventListener("pointermove", (event) => this.move(event));
    this.canvas.addEventListener("pointerup", (event) => this.release(event));
    this.canvas.addEventListener("pointercancel", () => {
      this.drag = null;
      this.draw();
    });
    const area = button("Select area", () => {
      area.setAttribute("aria-pressed", this.figure.classList.toggle("selecting"));
    });
    area.setAttribute("aria-pressed", "false");
    this.caption = document.createElement("span");
    const caption = document.createElement("figcaption");
    caption.append(this.caption, area);
    this.figure = document.createElement("figure");
    this.figure.append(this.canvas, caption);
    this.writeCaption();
  }

  async run() {
    while (!this.ended) {
      const begun = performance.now();
      if (document.hidden || state.replaced || !state.stream) {
        await pause(300);
        continue;
      }
      let period = IMAGE_PERIOD_MS;
      try {
        const { status, frame, jpeg } = await this.request();
        this.isIdle = status === 204;
        if (status === 200) this.show(JSON.parse(frame), await createImageBitmap(jpeg));
        else if (!this.isIdle) period = FAULT_PERIOD_MS;
        else if (isCrowded()) period = IDLE_PERIOD_MS;
      } catch {
        period = FAULT_PERIOD_MS;
      }
      await pause(Math.max(0, period - (performance.now() - begun)));
    }
  }

  async request() {
    await takeTurn();
    try {
      const after = this.about ? this.about.sequence : -1;
      const query = new URLSearchParams({ camera: this.name, after, vehicle: this.vehicle });
      if (this.isIdle && isCrowded()) query.set("wait", 0); // a camera without images must not delay the others
      const response = await fetch(`/image?${query}`, { priority: "low" });
      return { status: response.status, frame: response.headers.get("X-Frame"), jpeg: await response.blob() };
    } finally {
      endTurn();
    }
  }

  show(about, bitmap) {
    if (this.ended) return;
    if (this.bitmap) this.bitmap.close();
    this.bitmap = bitmap;
    this.about = about;
    this.at = performance.now();
    this.times.push(this.at);
    while (this.times[0] < this.at - 2000) this.times.shift();
    this.draw();
    this.measure();
  }

  end() {
    this.ended = true;
    this.figure.remove();
  }

  measure() {
    // From the capture to the drawn image, on the service's clock; unknown where that is another computer's.
    if (state.offsetNs == null || !this.about.captured_ns) return;
    const ms = (performance.now() * 1e6 + state.offsetNs - this.about.captured_ns) / 1e6;
    this.latencyMs = ms > -5 && ms < 60000 ? Math.max(0, ms) : null;
    if (this.name === "") state.videoMs = this.latencyMs;
  }

  draw() {
    const { canvas, bitmap, about } = this;
    if (!bitmap) return;
    const scale = devicePixelRatio || 1;
    const width = Math.round(canvas.clientWidth * scale);
    const height = Math.round(width * bitmap.height / bitmap.width);
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
      canvas.style.aspectRatio = `${bitmap.width} / ${bitmap.height}`;
    }
    const g = canvas.getContext("2d");
    g.drawImage(bitmap, 0, 0, width, height);
    g.font = `600 ${13 * scale}px system-ui, sans-serif`;
    g.textBaseline = "top";
    g.setLineDash(about.boxes_sequence === about.sequence ? [] : [6 * scale, 4 * scale]);
    const isChosen = (box) => box[6] != null && box[6] === state.chosen;
    drawBoxes(g, about.annotated ? about.boxes.filter(isChosen) : about.boxes, state.chosen, scale);
    g.setLineDash([]);
    if (this.drag && this.drag.moved) {
      const [l, t, r, b] = this.drag.box;
      const rectangle = [l * width, t * height, (r - l) * width, (b - t) * height];
      g.strokeStyle = "#fff";
      g.lineWidth = 2 * scale;
      g.fillStyle = "#fff3";
      g.fillRect(...rectangle);
      g.strokeRect(...rectangle);
    }
  }

  writeCaption() {
    const ageS = this.at ? (performance.now() - this.at) / 1000 : null;
    const words = [this.label];
    if (ageS == null) words.push("no image yet");
    else if (ageS > 1.5) words.push(`image ${ageS.toFixed(0)} s old`);
    else {
      words.push(`${(this.times.length / 2).toFixed(0)} images/s`);
      if (this.latencyMs != null) words.push(`${this.latencyMs.toFixed(0)} ms to screen`);
    }
    if (this.status.rate_hz != null) words.push(`${this.status.rate_hz.toFixed(1)} results/s`);
    if (this.status.problem) words.push(this.status.problem);
    setText(this.caption, words.join(" · "));
    const boxes = this.about ? this.about.boxes.length : 0;
    this.canvas.setAttribute("aria-label", `Video of ${this.label}, ${boxes} boxes`);
  }

  // --- the pointer: a click opens the menu of a box, a drag selects a rectangle

  pointOf(event) {
    const box = this.canvas.getBoundingClientRect();
    const clamp = (value) => Math.min(1, Math.max(0, value));
    return [clamp((event.clientX - box.left) / box.width), clamp((event.clientY - box.top) / box.height)];
  }

  press(event) {
    if (event.button !== 0 || !this.bitmap) return;
    const [x, y] = this.pointOf(event);
    const selects = event.pointerType === "mouse" || this.figure.classList.contains("selecting");
    const { boxes } = this.about; // a click means a box of this image, although a newer one may come meanwhile
    this.drag = { x, y, px: event.clientX, py: event.clientY, moved: false, box: [x, y, x, y], boxes, selects };
    if (selects) this.canvas.setPointerCapture(event.pointerId);
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
    const { clientX, clientY } = event;
    if (drag.moved) {
      this.draw();
      this.select(drag.box, ({ track, class: name }) => {
        if (track != null) openMenu({ id: track, name }, clientX, clientY);
      });
      return;
    }
    const isInside = ([l, t, r, b]) => drag.x >= l && drag.x <= r && drag.y >= t && drag.y <= b;
    const size = ([l, t, r, b]) => (r - l) * (b - t);
    const inside = drag.boxes.filter((box) => box[6] != null && isInside(box));
    const unsure = (box) => box[7] !== "confirmed"; // may be another class's track of the same object
    const [best] = inside.sort((one, other) => unsure(one) - unsure(other) || size(one) - size(other));
    if (best) openMenu({ id: best[6], name: best[4] }, clientX, clientY);
  }

  select([l, t, r, b], then) {
    const words = this.name ? [`camera=${this.name}`] : [];
    for (const [name, share] of Object.entries({ x: l, y: t, width: r - l, height: b - t })) {
      words.push(`${name}=${share.toFixed(4)}`);
    }
    send(`select ${words.join(" ")}`, then);
  }
}
