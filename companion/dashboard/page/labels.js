// Places the labels of boxes in the video: no label covers another one. The same rule as vision/labels.py, with the
// same name; no DOM: also run by a test in node. Rectangles are [left, top, right, bottom].

const MOST_LABELS = 60; // the search for a free place grows with their number squared

const overlap = (one, other) => Math.max(0, Math.min(one[2], other[2]) - Math.max(one[0], other[0]))
  * Math.max(0, Math.min(one[3], other[3]) - Math.max(one[1], other[1]));

// Returns where to draw a label of a size, near its box and clear of what is occupied; null: there is no space.
export function placeLabel(box, [width, height], [imageWidth, imageHeight], occupied) {
  if (width > imageWidth || height > imageHeight || occupied.length >= MOST_LABELS) return null;
  const at = (x, y) => [x, y, x + width, y + height];
  const isFree = (place) => !occupied.some((other) => overlap(place, other) > 0);
  const clamp = (value, highest) => Math.min(Math.max(value, 0), highest);
  const [boxLeft, boxTop, boxRight, boxBottom] = box;
  const left = clamp(boxLeft, imageWidth - width);
  const end = clamp(boxRight - width, imageWidth - width);
  const tops = [boxTop - height, boxTop, boxBottom, boxBottom - height, boxTop - 2 * height, boxBottom + height];
  const isSmall = (boxRight - boxLeft) * (boxBottom - boxTop) < 3 * width * height;
  const near = tops.filter((y) => y >= 0 && y <= imageHeight - height).flatMap((y) => [at(left, y), at(end, y)]);
  const free = near.filter(isFree);
  const cost = (place) => isSmall ? overlap(place, box) : 0;
  if (free.length) return free.reduce((best, place) => cost(place) < cost(best) ? place : best);
  // A free place can be moved left and up until it touches something: if there is one, one is among these.
  const top = clamp(boxTop - height, imageHeight - height);
  const columns = [0, left, ...occupied.map((other) => other[2])].filter((x) => x <= imageWidth - width);
  const rows = [0, top, ...occupied.map((other) => other[3])].filter((y) => y <= imageHeight - height);
  let best = null;
  let nearest = Infinity;
  for (const y of rows) {
    for (const x of columns) {
      const away = Math.abs(x - left) + Math.abs(y - top);
      if (away < nearest && isFree(at(x, y))) [best, nearest] = [at(x, y), away];
    }
  }
  return best;
}
