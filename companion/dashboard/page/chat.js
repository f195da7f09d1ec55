// The chat: sentences and confirmations go out by POST; what the dashboard answers comes by the stream.

import { HEADERS } from "./commands.js";
import { $, setText, state, windowId } from "./state.js";

let plan = null; // number of the plan that waits for its confirmation

export function showChat(chat) {
  setText($("reader"), chat.model ? `read by ${chat.model}` : "read by patterns: no language model is set");
  const list = $("chat");
  const wasAtEnd = list.scrollHeight - list.scrollTop - list.clientHeight < 40;
  while (list.children.length > chat.exchanges.length) list.lastChild.remove();
  chat.exchanges.forEach(({ asked, answer }, index) => {
    const item = list.children[index] || newExchange(list);
    setText(item.firstChild, asked); // text only: labels and a model's words are no markup
    setText(item.lastChild, answer || (chat.busy ? "…" : ""));
  });
  if (wasAtEnd) list.scrollTop = list.scrollHeight;
  plan = chat.plan;
  $("plan").hidden = plan === null;
}

// Of another vehicle until the stream sends it.
export function clearChat() {
  plan = null;
  $("plan").hidden = true;
  $("chat").replaceChildren();
  setText($("asked"), "");
}

function newExchange(list) {
  const item = document.createElement("li");
  item.append(document.createElement("p"), document.createElement("p"));
  list.append(item);
  return item;
}

async function post(sent) {
  const body = JSON.stringify({ ...sent, window: windowId(), vehicle: state.vehicle });
  try {
    const response = await fetch("/ask", { method: "POST", headers: HEADERS, body });
    setText($("asked"), response.ok ? "" : (await response.text()).trim());
  } catch (error) {
    setText($("asked"), `no answer of the dashboard (${error.message})`);
  }
}

function answerPlan(fly) {
  if (plan !== null) post({ plan, fly });
  $("plan").hidden = true;
}

$("confirm").addEventListener("click", () => answerPlan(true));
$("decline").addEventListener("click", () => answerPlan(false));
$("asking").addEventListener("submit", (event) => {
  event.preventDefault();
  const text = $("sentence").value.trim();
  if (!text) return;
  post({ text });
  $("sentence").value = "";
  $("sentence").blur(); // the space bar stops again
});
