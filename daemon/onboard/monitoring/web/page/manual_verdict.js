// Manual verdict of the selected exposure, next to the computed one, and its retake.

import { t } from "./i18n.js";
import { element } from "./dom.js";
import { retakeExposures } from "./retakes.js";
import { verdictOf } from "./strip.js";

export function start(root, feed) {
  const state = element("p", { id: "manual-state", className: "note" });
  const reason = element("input", { id: "manual-reason", maxLength: 200, autocomplete: "off" });
  const label = element("label", { htmlFor: "manual-reason" });
  const action = (name, run) => {
    const one = element("button", { type: "button", id: `manual-${name}` });
    one.addEventListener("click", run);
    return one;
  };
  const decide = async (kind) => {
    const given = reason.value.trim();
    if (kind === "accept" && !given) {
      reason.setAttribute("aria-invalid", "true");
      state.textContent = t("image.needs_reason");
      reason.focus();
      return;
    }
    reason.removeAttribute("aria-invalid");
    const body = { number: feed.selected, ...(given ? { reason: given } : {}) };
    if (await feed.command(kind, kind === "withdraw" ? { number: feed.selected } : body)) reason.value = "";
  };
  const retake = async () => {
    await retakeExposures([feed.selected], feed.command);
  };
  const buttons = {
    reject: action("reject", () => decide("reject")),
    accept: action("accept", () => decide("accept")),
    withdraw: action("withdraw", () => decide("withdraw")),
    retake: action("retake", retake),
  };
  const panel = element("div", { id: "manual", role: "group" }, state,
    element("div", { className: "tools" }, buttons.reject, buttons.retake, buttons.accept, buttons.withdraw),
    element("div", { className: "manual-reason" }, label, reason));
  root.querySelector(".tools").after(panel);
  let shownKey = "";
  const draw = () => {
    const one = feed.flight.exposures.get(feed.selected);
    panel.hidden = !one;
    if (!one) return;
    panel.setAttribute("aria-label", t("image.manual"));
    const key = JSON.stringify([one.number, one.verdict, one.step, one.manual, document.documentElement.lang]);
    if (key === shownKey) return;
    shownKey = key;
    for (const [name, button] of Object.entries(buttons)) button.textContent = t(`image.${name}`);
    label.textContent = t("image.reason");
    const verdict = verdictOf(one);
    const computed = t("image.computed", { number: one.number, verdict: verdict ? t(`verdict.${verdict}`) : t("strip.waiting") });
    const manual = one.manual ? ` ${t(`image.${one.manual.kind}ed_at`, { by: one.manual.by, role: one.manual.role,
      time: one.manual.utc, reason: one.manual.reason || "–" })}` : "";
    state.textContent = computed + manual;
    buttons.withdraw.hidden = !one.manual;
  };
  feed.subscribe(draw);
  feed.onSelect(draw);
  feed.key("r", "image.retake", () => { if (feed.selected != null) retake(); });
}
