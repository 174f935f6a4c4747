// Commands: asked for with a token, answered in a sentence.

import { flight } from "./state.js";

const answer = document.getElementById("answer");

// What is typed into a dialog; nothing where it is left.
export function ask(dialogId, fieldId) {
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

// A token; whatever else was copied along with it is left out, since headers take no other characters.
export async function askToken() {
  return (await ask("ask-token", "token")).replace(/[^A-Za-z0-9_-]/g, "");
}

// Why somebody flies although something is missing; each of that is listed with its cure.
function askReason(refusal) {
  const missing = flight.brief?.status?.missing;
  document.getElementById("lacking").replaceChildren(...(missing?.length ? missing : [refusal]).map((one) =>
    Object.assign(document.createElement("li"), { textContent: one })));
  return ask("ask-override", "reason");
}

function say(sentence, refused) {
  answer.textContent = sentence;
  answer.classList.toggle("refused", refused);
}

export async function command(name, body = {}) {
  let token = sessionStorage.getItem("token");
  if (!token) {
    token = await askToken();
    if (!token) return false;
  }
  let response;
  let told;
  try {
    response = await fetch(`/api/v1/commands/${name}`, {
      method: "POST",
      headers: { "Authorization": `Bearer ${token}`, "Content-Type": "application/json" },
      body: JSON.stringify(body),
    });
    told = await response.json();
  } catch {
    say("No link to the camera; whether the command was heard is not known.", true);
    return false;
  }
  if (response.status === 401) sessionStorage.removeItem("token");
  else sessionStorage.setItem("token", token);
  if (response.ok) {
    say(`Done: ${told.sentence}`, false);
    return true;
  }
  say(`${told.title}: ${told.detail}`, true);
  if (response.status !== 409 || !told.detail.includes("override")) return false;
  const why = await askReason(told.detail);
  return why ? command(name, { ...body, override: true, reason: why }) : false;
}

const GRAVE = {
  land: "Land: no more exposures, the service ends. Go on?",
  "new-mission": "New mission: this one is closed, the next begins with its configuration. Go on?",
  "release-disk": "Release disk: exposures are stored on the other disk alone from now on. Go on?",
  "accept-disk": "Accept disk: this mission is copied to the disk that is mounted there now. Go on?",
};

// A command that is confirmed first where it is grave.
export function askCommand(name, body = {}) {
  if (!GRAVE[name] || confirm(GRAVE[name])) command(name, body);
}

for (const button of document.querySelectorAll("[data-command]")) {
  button.addEventListener("click", () => {
    askCommand(button.dataset.command);
  });
}
