// What is left: disk, lines, light, and the time to the end at the present speed.

import { element, redraw } from "./dom.js";
import { t } from "./i18n.js";
import { bytes, clock, distance, number, span } from "./format.js";
import { fetchJson } from "./http.js";
import { noteTime } from "./time_of_day.js";
import { presentPosition } from "./lamps.js";

const REFRESH_MS = 10000;
const SOON_S = 1800;
const SLOW_MPS = 3;
const SHORT_DISK_S = 600;
const MARKS = { caution: "▲ ", warning: "✖ " };

let remaining = null;

function disk({ status = {}, faults = [] }) {
  const { exposures_left: left, exposures_planned: planned, disk_seconds: seconds, disk_free_bytes: free, is_disk_low: isLow } = status;
  if (left == null) return { value: "–" };
  const isShort = isLow || (planned != null && left < planned) || (seconds != null && seconds < SHORT_DISK_S);
  return { value: free == null ? t("left.exposures", { n: left, count: number(left) }) : bytes(free),
    detail: [seconds == null ? null : span(seconds), free == null ? null : t("left.exposures", { n: left, count: number(left) })].filter(Boolean).join(" · "),
    state: left === 0 || faults.some((one) => one.stands && one.code === "disk" && one.severity === "warning") ? "warning" : isShort ? "caution" : "" };
}

function lines() {
  const found = remaining?.lines;
  if (!found) return { value: "–" };
  return { value: t("left.of", { left: found.left, all: found.planned }), detail: distance(found.left_m) };
}

// Until the sun is too low, or how long until it is high enough.
function light() {
  const found = remaining?.light;
  if (!found) return { value: "–" };
  const nowS = found.now_unix_s;
  const at = found.is_light ? found.until_unix_s : found.from_unix_s;
  const time = at == null ? "" : `${clock(new Date(1000 * at), false)} UTC`;
  const state = !found.is_light ? "warning" : at != null && at - nowS < SOON_S ? "caution" : "";
  if (!found.is_light) return { value: t("left.dark"), detail: at == null ? "" : t("left.light_from", { time }), state };
  return { value: at == null ? t("left.light_all_day") : span(at - nowS), detail: at == null ? "" : t("left.light_until", { time }), state };
}

function end(flight) {
  const velocity = presentPosition(flight)?.velocity_ned_mps;
  const mps = velocity ? Math.hypot(velocity[0], velocity[1]) : null;
  const leftM = remaining?.lines?.left_m;
  if (mps == null || leftM == null) return { value: "–" };
  if (mps < SLOW_MPS) return { value: "–", detail: t("left.too_slow") };
  return { value: span(leftM / mps), detail: t("left.without_turns") };
}

export function start(root, feed) {
  const draw = () => {
    const cells = { disk: disk(feed.flight.brief || {}), lines: lines(), light: light(), end: end(feed.flight) };
    redraw(root, JSON.stringify(cells), () => Object.entries(cells).map(([name, { value, detail, state }]) =>
      element("div", { className: state || "", id: `left-${name}` }, element("dt", { textContent: t(`left.${name}`) }),
        element("dd", {}, `${MARKS[state] ?? ""}${value} `, element("small", { textContent: detail || "" })))));
  };
  const update = async () => {
    if (feed.flight.brief && feed.isLinked) {
      const found = await fetchJson("/api/v1/remaining");
      noteTime(found?.light?.now_unix_s ?? null);
      remaining = found ?? remaining;
    }
    if (feed.flight.brief) draw();
  };
  feed.subscribe((_record, isFirstRecord) => {
    draw();
    if (isFirstRecord) setTimeout(update, 300);
  });
  setInterval(update, REFRESH_MS);
}
