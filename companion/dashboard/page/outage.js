// What the page says when the service, or the way to it, is gone. No DOM: also run by a test in node.

export const STALE_S = 3; // of the dashboard's news
export const STATUS_STALE_S = 4;

// Returns null, or what has happened, what the vehicle does now, and what to do: { what, vehicle, todo }.
//   silentS: since the dashboard's newest news. problem: of its connection to zenoh. alive: of the service.
//   oldS: age of the service's newest state; null: it has none yet. status: the newest message.
export function outage({ silentS, problem, alive, oldS, status }) {
  if (oldS == null) return null; // nothing is shown that could be stale
  const old = `${oldS.toFixed(0)} s`;
  const cutOff = silentS > STALE_S || Boolean(problem);
  let what;
  if (silentS > STALE_S) what = `The dashboard does not answer; everything here is ${old} old.`;
  else if (problem) what = `${problem}. Shown is its state of ${old} ago.`;
  else if (alive === false) what = `The service is gone. Shown is its state of ${old} ago.`;
  else if (oldS > STATUS_STALE_S) what = `The service is silent. Shown is its state of ${old} ago.`;
  else return null;
  const todo = cutOff
    ? "Take over with the remote control or a ground station if you must: STOP may not arrive. The page goes on by itself."
    : "Be ready to take over with the remote control or a ground station. The service's log says more: journalctl -u companion.";
  return { what, vehicle: vehicleText(status || {}, cutOff), todo };
}

// The sentence is the service's own: vehicle.without_service of its newest status.
function vehicleText({ vehicle: link, pilot }, cutOff) {
  const unknown = "what the vehicle does without its service is not known";
  const text = `${(link && link.without_service) || unknown}.`;
  const flown = pilot && pilot.in_command;
  if (!cutOff || !flown) return `${flown ? "The vehicle flew the service's setpoints, which have stopped. " : ""}${text[0].toUpperCase()}${text.slice(1)}`;
  const behaviour = pilot.behaviour ? ` (${pilot.behaviour})` : "";
  return `The vehicle flies on as commanded${behaviour} if its service still runs. If not: ${text}`;
}
