// After landing: the summary of the flight, what to fly again, and what comes next. Its data are kept when the service ends.

import { by, button, element, redraw } from "./dom.js";
import { t } from "./i18n.js";
import { bytes, clock, distance, number, percent, temperature } from "./format.js";
import { fetchJson, fetchOk } from "./http.js";

const FILES = { "fly-again.geojson": "GeoJSON", "fly-again.kml": "KML", "fly-again.waypoints": "MAVLink", "fly-again.csv": "CSV" };
const ACTIONS = ["verify", "copy", "report", "shutdown"];
const REFRESH_MS = 5000;
const GPS_EPOCH_UNIX_S = 315964800;

// The last advice and its files, since the service may have ended when they are wanted.
const kept = { advice: null, files: new Map(), atMs: 0 };
let temperatureRange = null;

async function keep() {
  if (Date.now() - kept.atMs < REFRESH_MS) return;
  kept.atMs = Date.now();
  const advice = await fetchJson("/api/v1/advice");
  if (advice?.segments) {
    kept.advice = advice;
    for (const name of Object.keys(FILES)) {
      const blob = await (await fetchOk(`/api/v1/advice/${name}`))?.blob();
      if (blob) kept.files.set(name, blob);
    }
  }
}

function noteTemperatures(status) {
  for (const value of Object.values(status.temperatures_c || {})) {
    if (value == null) continue;
    temperatureRange = temperatureRange ? [Math.min(temperatureRange[0], value), Math.max(temperatureRange[1], value)] : [value, value];
  }
}

// GPS time and UTC of the last status. Their difference is the number of leap seconds since 1980.
function times(flight) {
  const gpsNs = flight.brief.status?.gps_ns;
  if (gpsNs == null) return null;
  const leap = [...flight.exposures.values()].map((one) => one.place?.leap_seconds).findLast((one) => one != null);
  const gpsS = Number(gpsNs) * 1e-9;
  return { gps: gpsS.toFixed(0), utc: leap == null ? null : clock(new Date(1000 * (GPS_EPOCH_UNIX_S + gpsS - leap))) };
}

function summary(flight) {
  const { brief } = flight;
  const { status = {}, ...rest } = brief;
  const triggers = status.ledger?.triggers || {};
  const { good, usable, refly } = rest.verdicts;
  const all = good + usable + refly;
  const gaps = (kept.advice?.segments || []).filter((one) => one.kind === "hole");
  const unflown = (kept.advice?.segments || []).filter((one) => one.kind !== "hole");
  const rows = [
    ["exposures", number(triggers.triggers ?? all), ""],
    ["lost", number(triggers.lost ?? 0), triggers.lost ? "warning" : "good"],
    ["quality", `● ${number(good)}  ▲ ${number(usable)}  ■ ${number(refly)}`, refly ? "caution" : "good"],
  ];
  if (kept.advice) {
    rows.push(["covered", `${percent(kept.advice.planned_m ? kept.advice.covered_m / kept.advice.planned_m : 0)} · ${distance(kept.advice.planned_m)}`, ""]);
    rows.push(["gaps", gaps.length ? t("landing.gaps_found", { n: gaps.length, ha: number(kept.advice.hole_m2 / 1e4, 2) }) : t("landing.no_gap"),
      gaps.length ? "warning" : "good"]);
    if (unflown.length) rows.push(["unflown", number(unflown.length), "caution"]);
  }
  if (temperatureRange) rows.push(["temperatures", temperatureRange.map((one) => temperature(one)).join(" … "), ""]);
  const standing = brief.faults.filter((one) => one.stands).length;
  rows.push(["faults", t("landing.faults_found", { all: brief.faults.length, standing }), standing ? "caution" : "good"]);
  rows.push(["disk", [status.disk_free_bytes == null ? null : bytes(status.disk_free_bytes),
    ...(status.disks || []).map((one) => `${one.disk}: ${one.state === "in use" ? t("disk.in_use") : one.state}`)].filter(Boolean).join(" · ") || "–", ""]);
  const time = times(flight);
  if (time) rows.push(["time", `${time.utc ? `${time.utc} UTC · ` : ""}GPS ${time.gps} s`, ""]);
  return rows;
}

function download(name) {
  const link = element("a", { href: URL.createObjectURL(kept.files.get(name)), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

// The command of each next step. Nobody but the owner of the computer may run it, so the page runs none.
const commandOf = (name, path) => ({ verify: `syntopic verify ${path}`, copy: `syntopic transfer ${path} DISK`,
  report: `syntopic report ${path}`, shutdown: "systemctl poweroff" })[name];

function nextSteps(flight) {
  const path = flight.brief.mission.path || "MISSION";
  return element("ul", { className: "next-steps" }, ...ACTIONS.map((name) => element("li", {},
    element("strong", { textContent: t(`landing.${name}`) }), element("code", { textContent: commandOf(name, path) }))));
}

export function start(root, feed) {
  const draw = () => {
    const { brief } = feed.flight;
    if (!brief) return;
    root.hidden = brief.phase !== "landed";
    if (root.hidden) return;
    const rows = summary(feed.flight);
    redraw(root, JSON.stringify([rows, [...kept.files.keys()]]), () => [
      element("h2", { textContent: t("landing.title", { mission: brief.mission.id || "" }) }),
      element("dl", { className: "figures wide summary" }, ...rows.map(([name, value, state]) => element("div", { className: state, dataset: { summary: name } },
        element("dt", { textContent: t(`landing.${name}`) }), element("dd", { textContent: value })))),
      element("h2", { textContent: t("landing.fly_again") }),
      kept.files.size ? element("div", { className: "tools" }, ...[...kept.files.keys()].map((name) => button(FILES[name], () => download(name),
        { dataset: { file: name } }))) : element("p", { className: "note", textContent: t("lines.no_plan") }),
      element("h2", { textContent: t("landing.next") }), nextSteps(feed.flight),
    ]);
  };
  feed.subscribe(async (record, isFirstRecord) => {
    if (isFirstRecord) temperatureRange = null;
    noteTemperatures(feed.flight.brief.status || {});
    const hasLanded = feed.flight.brief.phase === "landed";
    if (hasLanded && root.hidden) {
      kept.atMs = 0;
      feed.showTab("flight");
    }
    if (record && feed.isLinked && (hasLanded || record.exposures)) await keep();
    draw();
  });
  by("landing").hidden = true;
}

// The text of a file that was kept; null if there is none.
export const textOf = async (name) => await kept.files.get(name)?.text() ?? null;
