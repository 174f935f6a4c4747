// The phase, and the one large button that leads to the next phase.

import { by, element } from "./dom.js";
import { serverTexts, t } from "./i18n.js";
import { isPlanFlown } from "./plan.js";

const PHASE_CLASS = { flying: "good", armed: "good", fault: "warning", idle: "caution" };
const ALARMS = "alarms";
const NEXT = { ready: "arm", armed: "start", flying: "stop" };

// What the large button does in a phase: a command, "alarms" to open their page, or nothing.
function commandsOf(brief) {
  if (brief.phase === "fault") return { next: ALARMS, second: null };
  // A plan is flown line after line without a stop between them.
  if (brief.phase === "flying" && isPlanFlown(brief.status?.lines)) return { next: "land", second: "stop" };
  const hasFlown = (brief.status?.ledger?.triggers?.triggers ?? 0) > 0;
  if (brief.phase !== "armed" || !hasFlown) return { next: NEXT[brief.phase] ?? null, second: null };
  // After the last planned line the next step is the landing.
  return isPlanFlown(brief.status.lines) ? { next: "land", second: "start" } : { next: "start", second: "land" };
}

function setButton(button, name) {
  button.hidden = !name && button.id === "phase-second";
  button.disabled = !name;
  button.classList.toggle("stop", name === "stop" || name === ALARMS);
  button.classList.toggle("destructive", name === "land" && button.id === "phase-second");
  if (button.dataset.next === (name ?? "")) return;
  button.dataset.next = name ?? "";
  if (name) button.textContent = name === ALARMS ? t("phase.see_alarms") : t(`command.${name}`);
}

export function start(_root, feed) {
  const [next, second] = [by("phase-button"), by("phase-second")];
  for (const one of [next, second]) {
    one.addEventListener("click", () => {
      if (one.dataset.next === ALARMS) feed.showTab("alarms");
      else if (one.dataset.next) feed.command(one.dataset.next);
    });
  }
  for (const one of document.querySelectorAll("[data-command]")) {
    one.addEventListener("click", () => {
      by("commands").close();
      feed.command(one.dataset.command);
    });
  }
  by("open-commands").addEventListener("click", () => by("commands").showModal());
  feed.key("k", "command.more", () => by("commands").showModal());
  next.textContent = t("phase.waiting");
  feed.subscribe(() => {
    const { brief } = feed.flight;
    const chip = by("phase");
    const missing = serverTexts(brief.status || {}, "missing");
    const isBlocked = brief.phase === "ready" && missing.length > 0;
    chip.textContent = t(`phase.${isBlocked ? "not_ready" : brief.phase}`);
    chip.className = `chip ${isBlocked ? "caution" : PHASE_CLASS[brief.phase] || ""}`;
    const commands = commandsOf(brief);
    setButton(next, commands.next);
    setButton(second, commands.second);
    if (!commands.next) next.textContent = t(brief.phase === "landed" ? "phase.landed" : "phase.waiting");
    by("simulated").hidden = !brief.simulated;
    by("aircraft").textContent = by("aircraft").title = brief.mission.rig || "";
    const mark = /^[✖▲] /.exec(document.title)?.[0] ?? "";
    const lost = feed.isLinked ? "" : `${t(brief.phase === "landed" ? "link.landed_title" : "link.lost_title")} · `;
    document.title = `${mark}${lost}${brief.simulated ? `${t("page.simulated")} · ` : ""}${brief.mission.rig || ""} · Syntopic`;
    by("recovery").replaceChildren(...serverTexts(brief.mission, "recovery").map((one) =>
      element("li", { textContent: t("page.recovered", { what: one }) })));
    const shown = brief.phase === "ready" || brief.phase === "armed" ? missing : [];
    by("missing").replaceChildren(...shown.map((one) => element("li", { textContent: `▲ ${one}` })));
    document.querySelector(".missing-title").hidden = !shown.length;
  });
}
