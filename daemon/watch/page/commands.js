// Commands: asked for with a token, answered in a sentence.

const dialog = document.getElementById("ask-token");
const field = document.getElementById("token");
const answer = document.getElementById("answer");

function askToken() {
  return new Promise((resolve) => {
    field.value = "";
    dialog.addEventListener("close", () => resolve(dialog.returnValue === "use" ? field.value.trim() : ""),
      { once: true });
    dialog.showModal();
  });
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
  try {
    response = await fetch(`/api/v1/commands/${name}`, {
      method: "POST",
      headers: { "Authorization": `Bearer ${token}`, "Content-Type": "application/json" },
      body: JSON.stringify(body),
    });
  } catch {
    say("No link to the camera; the command was not given.", true);
    return false;
  }
  const told = await response.json();
  if (response.status === 401) sessionStorage.removeItem("token");
  else sessionStorage.setItem("token", token);
  if (response.ok) {
    say(`Done: ${told.sentence}`, false);
    return true;
  }
  say(`${told.title}: ${told.detail}`, true);
  if (response.status === 409 && told.detail.includes("override") &&
      confirm(`${told.detail}\n\nFly all the same? It is noted in the flight log.`)) {
    return command(name, { ...body, override: true });
  }
  return false;
}

const GRAVE = {
  land: "Land: no more exposures, the service ends. Go on?",
  "new-mission": "New mission: this one is closed, the next begins with its configuration. Go on?",
};

for (const button of document.querySelectorAll("[data-command]")) {
  button.addEventListener("click", () => {
    const name = button.dataset.command;
    if (!GRAVE[name] || confirm(GRAVE[name])) command(name);
  });
}
