// The operator's page: starts its modules, and connects to the service.

import { by } from "./dom.js";
import { fill, t } from "./i18n.js";
import { clock } from "./format.js";
import { feed } from "./feed.js";
import { timeOfDay } from "./time_of_day.js";
import { connect } from "./telemetry.js";
import { requestToken } from "./commands.js";
import * as tabs from "./tabs.js";
import * as keys from "./keys.js";
import * as settings from "./settings.js";
import * as lamps from "./lamps.js";
import * as phase from "./phase.js";
import * as alarms from "./alarms.js";
import * as verdict from "./verdict.js";
import * as devices from "./devices.js";
import * as exposure from "./exposure.js";
import * as left from "./left.js";
import * as checklist from "./checklist.js";
import * as landing from "./landing.js";
import * as wakeLock from "./wake_lock.js";
import * as install from "./install.js";
import * as expert from "./expert.js";
import * as triangulation from "./triangulation.js";
import * as map from "./map.js";
import * as plan from "./plan.js";
import * as quicklook from "./quicklook.js";
import * as guidance from "./guidance.js";
import * as strip from "./strip.js";
import * as deepzoom from "./deepzoom.js";
import * as manual from "./manual_verdict.js";

// Each with the element that it fills. They start in this order.
const MODULES = [
  [tabs, "tabs"], [keys, "settings"], [settings, "settings"], [lamps, "lamps"], [phase, "phase-actions"],
  [alarms, "page-alarms"], [verdict, "verdict-panel"], [left, "left"], [checklist, "checklist"],
  [landing, "landing"], [wakeLock, "settings"], [install, "settings"], [devices, "page-devices"],
  [exposure, "exposure-panel"], [map, "map-panel"], [plan, "reflights"], [quicklook, "image-panel"],
  [guidance, "guidance"], [strip, "strip"], [deepzoom, "image-panel"], [manual, "image-panel"], [expert, "page-expert"],
  [triangulation, "triangulation"],
];

fill();
for (const [module, id] of MODULES) {
  // A panel that cannot start leaves the others alive.
  try {
    module.start(by(id), feed);
  } catch (error) {
    console.error(error);
  }
}
document.body.dataset.ready = "";

const CLOCK_MS = 1000;
setInterval(() => { by("clock").textContent = `${clock(timeOfDay())} UTC`; }, CLOCK_MS);

let isLive = false;
let receivedMs = Date.now();
feed.subscribe((record) => { if (record) receivedMs = Date.now(); });

// State of the connection. A service that ended after landing is no fault.
function linkState(isLinked) {
  if (isLinked) return { label: "link.connected", style: "good" };
  if (!feed.flight.brief) return { label: "link.connecting", style: "caution" };
  return feed.flight.brief.phase === "landed"
    ? { label: "link.ended", style: "", sentence: "link.landed", isEnded: true }
    : { label: "link.disconnected", style: "warning", sentence: "link.lost", isEnded: false };
}

function showLink(isLinked) {
  feed.isLinked = isLinked;
  const state = linkState(isLinked);
  // Of the last record: the loss is noticed later, after a sleep by hours.
  const time = clock(timeOfDay(receivedMs));
  if (isLinked || isLive || !feed.flight.brief) {
    by("link").textContent = t(state.label);
    by("link").className = `chip ${state.style}`;
  }
  document.body.classList.toggle("connection-lost", !isLinked && !state.isEnded);
  document.body.classList.toggle("flight-ended", !isLinked && Boolean(state.isEnded));
  if (isLinked) feed.clearAlarm("page.link");
  else if (isLive && !state.isEnded) {
    feed.raiseAlarm({ code: "page.link", severity: "warning", params: { time } });
  }
  if (!isLinked && isLive) {
    by("connection-lost").textContent = t(state.sentence, { time });
    by("connection-lost").classList.toggle("ended", state.isEnded);
  }
  by("connection-lost").hidden = isLinked || !(isLive || feed.flight.brief);
  isLive = isLinked;
  feed.drawLamps();
  feed.drawAlarms();
  // Commands that only the service can do are no longer offered.
  if (!isLinked) feed.refresh();
}

connect(showLink, async () => {
  by("link").textContent = t("link.token");
  let token = "";
  while (!token) token = await requestToken();
  sessionStorage.setItem("token", token);
});
