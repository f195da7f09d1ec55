// What the page says of a command, from its reply and the message of its end. No DOM: also run by a test in node.

const LAST_ENDS = 500;

// Keeps the ends of the newest commands, of all senders, by the command's id.
export class Ends {
  #byId = new Map();

  add(message) {
    if (message.state !== "ended") return;
    this.#byId.set(message.id, message);
    if (this.#byId.size > LAST_ENDS) this.#byId.delete(this.#byId.keys().next().value);
  }

  of(id) {
    return this.#byId.get(id);
  }
}

// Returns [text, kind] of a reply: "good", "bad", "ended" or "waiting". `service`: that of the newest status, if one
// is known; a command of another one has ended with it. `isStale`: the service does not answer.
export function outcome({ command_id: id, state, success, reason }, ends, service, isStale = false) {
  if (state !== "in_progress") return [`${success ? "done" : "failed"}: ${reason}`, success ? "good" : "bad"];
  const end = ends.of(id);
  if (end) return [`ended: ${end.reason}`, "ended"];
  if (service && id && !id.startsWith(`${service}-`)) return ["ended: the service has been started again", "ended"];
  if (isStale) return [`${reason} when the service last answered`, "waiting"];
  return [`accepted, ${reason}`, "good"];
}
