// Commands: sent with an access token; the answer is shown as one sentence.

import { flight } from "./telemetry.js";

const answer = document.getElementById("answer");

// The text entered in a dialog; empty if it is cancelled.
export function openDialog(dialogId, fieldId) {
  const dialog = document.getElementById(dialogId);
  const field = document.getElementById(fieldId);
  return new Promise((resolve) => {
    field.value = "";
    dialog.returnValue = "";
    dialog.addEventListener("close", () => resolve(dialog.returnValue === "use" ? field.value.trim() : ""),
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
  const missing = flight.brief?.status?.missing;
  document.getElementById("missing-items").replaceChildren(...(missing?.length ? missing : [refusal]).map((one) =>
    Object.assign(document.createElement("li"), { textContent: one })));
  return openDialog("ask-override", "reason");
}

function showAnswer(sentence, refused) {
  answer.textContent = sentence;
  answer.classList.toggle("refused", refused);
}

export async function command(name, body = {}) {
  let token = sessionStorage.getItem("token");
  if (!token) {
    token = await requestToken();
    if (!token) return false;
  }
  let response;
  let result;
  try {
    response = await fetch(`/api/v1/commands/${name}`, {
      method: "POST",
      headers: { "Authorization": `Bearer ${token}`, "Content-Type": "application/json" },
      body: JSON.stringify(body),
    });
    result = await response.json();
  } catch {
    showAnswer("No connection to the camera. The command may not have arrived; check the state.", true);
    return false;
  }
  if (response.status === 401) sessionStorage.removeItem("token");
  else sessionStorage.setItem("token", token);
  if (response.ok) {
    showAnswer(`Done: ${result.sentence}`, false);
    return true;
  }
  showAnswer(`${result.title}: ${result.detail}`, true);
  if (response.status !== 409 || !result.detail.includes("override")) return false;
  const why = await requestReason(result.detail);
  return why ? command(name, { ...body, override: true, reason: why }) : false;
}

const CONFIRMATIONS = {
  land: "Land: exposures stop and the service ends. Continue?",
  "new-mission": "New mission: the current mission is closed and a new one starts. Continue?",
  "release-disk": "Release disk: exposures are stored on the other disk only. Continue?",
  "accept-disk": "Accept disk: this mission is copied to the disk that is mounted now. Continue?",
};

// Send a command, after confirmation if it is destructive.
export function confirmCommand(name, body = {}) {
  if (!CONFIRMATIONS[name] || confirm(CONFIRMATIONS[name])) command(name, body);
}

for (const button of document.querySelectorAll("[data-command]")) {
  button.addEventListener("click", () => {
    confirmCommand(button.dataset.command);
  });
}
