// The status lamps: shape, colour and one value each. A touch opens the page that explains the lamp.

import { element } from "./dom.js";
import { t } from "./i18n.js";
import { ageText, bytes, number, span } from "./format.js";

export const POSITION_HOLDS_S = 5;
const CLOCK_CAUTION_NS = 1e6;
const QUEUE_CAUTION = 5;
const MARKS = { good: "●", caution: "▲", warning: "✖", off: "○" };

const devicesOf = (flight, ...kinds) => [...flight.devices.values()].filter((one) => kinds.includes(one.kind));
const isUnavailable = (device) => device.state === "lost" || device.state === "absent";

function stateOfDevices(devices) {
  if (!devices.length) return "off";
  if (devices.some(isUnavailable)) return "warning";
  return devices.every((one) => one.state === "ready") ? "good" : "caution";
}

function heads(flight) {
  const devices = devicesOf(flight, "head");
  const ready = devices.filter((one) => one.state === "ready").length;
  return { state: stateOfDevices(devices), value: devices.length ? `${ready}/${devices.length}` : "–" };
}

function trigger(flight) {
  const state = stateOfDevices(devicesOf(flight, "trigger"));
  const given = flight.brief.status?.ledger?.triggers?.triggers;
  return { state, value: given == null ? "–" : number(given) };
}

function time(flight) {
  const { clock_sigma_ns: sigmaNs, in_holdover: inHoldover, clock_coasting_s: coastingS } = flight.brief.status || {};
  const hasFault = flight.brief.faults.some((one) => one.stands && one.device === "clock");
  if (sigmaNs == null) return { state: "off", value: "–" };
  const isCoarse = sigmaNs > CLOCK_CAUTION_NS;
  const holdover = () => coastingS == null ? t("lamp.holdover") : t("lamp.holdover_for", { age: ageText(coastingS) });
  return { state: hasFault || inHoldover || isCoarse ? "caution" : "good", value: inHoldover ? holdover() : t(isCoarse ? "lamp.coarse" : "lamp.gps") };
}

// The position; null if it is older than POSITION_HOLDS_S.
export function presentPosition(flight) {
  const position = flight.brief.status?.position;
  return position && (position.age_s ?? 0) <= POSITION_HOLDS_S ? position : null;
}

function position(flight) {
  const known = flight.brief.status?.position;
  const present = presentPosition(flight);
  if (!known) {
    const isNeeded = flight.brief.phase === "flying" || flight.brief.phase === "armed";
    return { state: isNeeded || isUnavailable(devicesOf(flight, "navigator")[0] || {}) ? "warning" : "off", value: "–" };
  }
  if (!present) return { state: "warning", value: t("lamp.old", { age: ageText(known.age_s) }) };
  if (present.fix === "none") return { state: "caution", value: t("lamp.no_fix") };
  // A receiver that is lost is no longer good, although its last position is not old yet.
  const isLosing = devicesOf(flight, "navigator").some(isUnavailable);
  const satellites = present.satellites == null ? "3D" : t("lamp.satellites", { n: number(present.satellites) });
  return { state: isLosing ? "caution" : "good", value: present.fix === "2d" ? "2D" : satellites };
}

function disk(flight) {
  const { exposures_left: left, exposures_planned: planned, is_disk_low: isLow, disk_free_bytes: free, disk_seconds: seconds, disks = [] } = flight.brief.status || {};
  if (left == null) return { state: "off", value: "–" };
  const hasProblem = disks.some((one) => one.state !== "in use" || one.healthy === false);
  const isShort = planned != null && left < planned;
  // As severe as what is reported of the disks.
  const isSevere = flight.brief.faults.some((one) => one.stands && one.severity === "warning" && /^disk\b/.test(one.device));
  // Minutes where they count, else the free space.
  const value = isLow && seconds != null ? span(seconds) : free == null ? t("lamp.exposures", { n: number(left) }) : bytes(free);
  return { state: left === 0 || isSevere ? "warning" : isLow || isShort || hasProblem ? "caution" : "good", value };
}

function processing(flight) {
  const waiting = flight.brief.status?.queue;
  if (waiting == null) return { state: "off", value: "–" };
  return { state: waiting > QUEUE_CAUTION ? "caution" : "good", value: t("lamp.waiting", { n: number(waiting) }) };
}

function link(flight, feed) {
  // The end of the service after landing is no fault.
  if (!feed.isLinked && flight.brief.phase === "landed") return { state: "off", value: t("link.ended") };
  return { state: feed.isLinked ? "good" : "warning", value: t(feed.isLinked ? "lamp.live" : "lamp.lost") };
}

const LAMPS = { heads: [heads, "devices"], trigger: [trigger, "devices"], time: [time, "expert"], position: [position, "flight"],
  disk: [disk, "devices"], processing: [processing, "exposures"], link: [link, "alarms"] };

// The state and value of each lamp.
export const lampStates = (feed) =>
  Object.fromEntries(Object.entries(LAMPS).map(([name, [compute]]) => [name, compute(feed.flight, feed)]));

export function start(root, feed) {
  const lamps = Object.entries(LAMPS).map(([name, [compute, tab]]) => {
    const mark = element("span", { className: "mark", ariaHidden: "true", textContent: MARKS.off });
    const value = element("span", { className: "value", textContent: "–" });
    const state = element("span", { className: "unseen" });
    const button = element("button", { type: "button", id: `lamp-${name}`, className: "lamp off" },
      mark, element("span", { className: "name", textContent: t(`lamp.${name}`) }), value, state);
    button.addEventListener("click", () => feed.showTab(tab));
    root.append(button);
    return { compute, button, mark, value, state };
  });
  const draw = () => {
    for (const { compute, button, mark, value, state } of lamps) {
      const now = compute(feed.flight, feed);
      button.className = `lamp ${now.state}`;
      mark.textContent = MARKS[now.state];
      value.textContent = now.value;
      state.textContent = t(`lamp.state.${now.state}`);
    }
  };
  feed.subscribe(draw);
  feed.drawLamps = () => feed.flight.brief && draw();
}
