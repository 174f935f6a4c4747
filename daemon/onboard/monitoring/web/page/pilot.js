// The view for a pilot's tablet: guidance alone, large, with its age.

import { fill, t } from "./i18n.js";
import { height, length } from "./format.js";
import { followGuidance } from "./guidance_link.js";
import { drawAge, drawBar, drawCells } from "./guidance_view.js";

const by = (id) => document.getElementById(id);
const AGE_MS = 200;
let last = null;
let due = null;

function correctionOf(frame) {
  const parts = [];
  if (frame.exceeded.includes("across")) {
    const worst = Math.abs(frame.across_ahead_m) > Math.abs(frame.across_m) ? frame.across_ahead_m : frame.across_m;
    parts.push(t(worst > 0 ? "pilot.steer_left" : "pilot.steer_right", { by: length(Math.abs(worst)) }));
  }
  if (frame.exceeded.includes("height")) {
    parts.push(t(frame.height_deviation_m > 0 ? "pilot.descend" : "pilot.climb", { by: height(Math.abs(frame.height_deviation_m)) }));
  }
  return parts.join(" · ");
}

function draw() {
  due = null;
  by("pilot-none").hidden = true;
  drawCells(by("pilot-cells"), last);
  drawBar(by("pilot-bar"), last);
  const correction = last.is_captured ? correctionOf(last) : "";
  const alarm = by("pilot-alarm");
  if (alarm.textContent !== correction) alarm.textContent = correction;
  alarm.hidden = !correction;
  drawAge(by("pilot"), by("pilot-age"), last);
}

function setTheme(isDark) {
  document.documentElement.dataset.theme = isDark ? "dark" : "";
  by("pilot-theme").setAttribute("aria-pressed", String(isDark));
  localStorage.setItem("cabin", isDark ? "dark" : "");
}

fill();
document.title = `${t("pilot.title")} · Syntopic`;
setTheme(localStorage.getItem("cabin") === "dark");
by("pilot-theme").addEventListener("click", () => setTheme(document.documentElement.dataset.theme !== "dark"));
setInterval(() => { if (last) drawAge(by("pilot"), by("pilot-age"), last); }, AGE_MS);
followGuidance((frame) => {
  last = frame;
  due ??= requestAnimationFrame(draw);
}, (isLinked) => {
  by("pilot-link").textContent = t(isLinked ? "pilot.linked" : "pilot.not_linked");
  by("pilot-link").className = `chip ${isLinked ? "good" : "warning"}`;
});
