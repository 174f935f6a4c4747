// Commands: sent with an access token; the answer is shown as one sentence.

import { flight } from "./telemetry.js";
import { serverText, serverTexts, t } from "./i18n.js";

const answer = document.getElementById("answer");
const ANSWER_MS = 15000;
const CONFIRMED = new Set(["land", "new-mission", "release-disk", "accept-disk", "shutdown"]);
let clearing = null;

// The value with which a dialog is closed: the text of its field, "use" without one, empty if it is cancelled.
export function openDialog(dialogId, fieldId) {
  const dialog = document.getElementById(dialogId);
  const field = fieldId && document.getElementById(fieldId);
  return new Promise((resolve) => {
    if (field) field.value = "";
    dialog.returnValue = "";
    dialog.addEventListener("close", () => resolve(dialog.returnValue !== "use" ? "" : field ? field.value.trim() : "use"),
      { once: true });
    dialog.showModal();
  });
}

// An access token. Characters that a header cannot hold are removed.
export async function requestToken() {
  return (await openDialog("ask-token", "token")).replace(/[^A-Za-z0-9_-]/g, "");
}

// The reason for an override. The dialog lists each missing item with its corrective action.
function requestReason(refusal) {
  const missing = serverTexts(flight.brief?.status || {}, "missing");
  document.getElementById("missing-items").replaceChildren(...(missing.length ? missing : [refusal]).map((one) =>
    Object.assign(document.createElement("li"), { textContent: one })));
  return openDialog("ask-override", "reason");
}

export function showAnswer(sentence, isRefused) {
  answer.textContent = sentence;
  answer.classList.toggle("refused", isRefused);
  clearTimeout(clearing);
  // A refusal stays until the next command.
  if (!isRefused) clearing = setTimeout(() => { answer.textContent = ""; }, ANSWER_MS);
}

// Send a request that requires a token; ask for the token if there is none. Null if there is no answer.
export async function post(address, body = {}) {
  let token = sessionStorage.getItem("token");
  if (!token) {
    token = await requestToken();
    if (!token) return null;
  }
  try {
    const response = await fetch(address, {
      method: "POST",
      headers: { "Authorization": `Bearer ${token}`, "Content-Type": "application/json" },
      body: JSON.stringify(body),
    });
    const result = await response.json();
    if (response.status === 401) sessionStorage.removeItem("token");
    else sessionStorage.setItem("token", token);
    return { response, result };
  } catch {
    showAnswer(t("command.no_connection"), true);
    return null;
  }
}

export async function command(name, body = {}) {
  const sent = await post(`/api/v1/commands/${name}`, body);
  if (!sent) return false;
  const { response, result } = sent;
  if (response.ok) {
    showAnswer(t("command.done", { sentence: serverText(result) }), false);
    return true;
  }
  const detail = serverText(result, result.detail);
  showAnswer(`${serverText({ message: result.title_message }, result.title)}: ${detail}`, true);
  if (response.status !== 409 || !result.detail.includes("override")) return false;
  const reason = await requestReason(detail);
  return reason ? command(name, { ...body, override: true, reason }) : false;
}

export async function confirmed(name) {
  const set = (id, code) => { document.getElementById(id).textContent = t(code); };
  set("confirm-title", `command.${name}`);
  set("confirm-text", `confirm.${name}`);
  set("confirm-do", `command.${name}`);
  return Boolean(await openDialog("ask-confirm"));
}

// Send a command, after confirmation if it is destructive.
export async function confirmCommand(name, body = {}) {
  if (CONFIRMED.has(name) && !await confirmed(name)) return false;
  return command(name, body);
}
