// The view for a pilot's tablet: guidance alone, large, with its age. It keeps the screen on and sounds deviations.

import { fill, t } from "./i18n.js";
import { by } from "./dom.js";
import { height, length, number } from "./format.js";
import { requestToken } from "./commands.js";
import { isSoundOn, setSound, soundFor, unlockSound } from "./alarm_sound.js";
import { ageOf, followGuidance } from "./guidance_link.js";
import { drawAge, drawBar, drawCells } from "./guidance_view.js";
import { keepAwake } from "./wake_lock.js";

const AGE_MS = 200;
let last = null;
let state = "lost";
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

// The correction, or that there is no guidance: an instruction from an old position is not shown.
function drawAlarm() {
  const isLost = state === "lost";
  const correction = isLost ? "" : last.is_captured ? correctionOf(last) : "";
  const shown = isLost ? t("pilot.guidance_lost", { age: number(ageOf(last)) }) : correction;
  const alarm = by("pilot-alarm");
  if (alarm.textContent !== shown) alarm.textContent = shown;
  alarm.hidden = !shown;
  soundFor(isLost ? ["caution"] : correction ? ["warning"] : []);
}

function drawState() {
  if (!last) return;
  state = drawAge(by("pilot"), by("pilot-age"), last);
  drawAlarm();
  updateLock();
}

function draw() {
  due = null;
  by("pilot-none").hidden = true;
  drawCells(by("pilot-cells"), last);
  drawBar(by("pilot-bar"), last);
  drawState();
}

function setTheme(isDark) {
  document.documentElement.dataset.theme = isDark ? "dark" : "";
  by("pilot-theme").setAttribute("aria-pressed", String(isDark));
  localStorage.setItem("cabin", isDark ? "dark" : "");
}

function switchSound(wanted) {
  setSound(wanted);
  by("pilot-sound").setAttribute("aria-pressed", String(wanted));
}

fill();
document.title = `${t("pilot.title")} · Syntopic`;
const updateLock = keepAwake(() => state !== "lost");
setTheme(localStorage.getItem("cabin") === "dark");
switchSound(isSoundOn());
by("pilot-theme").addEventListener("click", () => setTheme(document.documentElement.dataset.theme !== "dark"));
by("pilot-sound").addEventListener("click", () => {
  switchSound(!isSoundOn());
  unlockSound();
});
setInterval(drawState, AGE_MS);
document.body.dataset.ready = "";
followGuidance((frame) => {
  last = frame;
  due ??= requestAnimationFrame(draw);
}, (isLinked) => {
  by("pilot-link").textContent = t(isLinked ? "pilot.linked" : "pilot.not_linked");
  by("pilot-link").className = `chip ${isLinked ? "good" : "warning"}`;
}, async () => {
  let token = "";
  while (!token) token = await requestToken();
  sessionStorage.setItem("token", token);
});
