// Reads CDR with Foxglove's code: answers each line of JSON with one. JSON has no NaN: such a number is a text.
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");
const readers = new Map();

function plain(_key, value) {
  if (ArrayBuffer.isView(value)) return Array.from(value);
  return typeof value === "number" && !Number.isFinite(value) ? String(value) : value;
}

require("readline").createInterface({ input: process.stdin }).on("line", (line) => {
  const { type, definition, cdr } = JSON.parse(line);
  if (!readers.has(type)) readers.set(type, new MessageReader(parse(definition, { ros2: true })));
  const value = readers.get(type).readMessage(Buffer.from(cdr, "base64"));
  console.log(JSON.stringify({ value }, plain));
});
