// After landing: the summary of the flight, what to fly again, and what comes next. Its data are kept when the service ends.

import { by, button, element, redraw } from "./dom.js";
import { serverLanguage, serverText, t } from "./i18n.js";
import { bytes, clock, distance, number, percent, temperature } from "./format.js";
import { fetchAdvice } from "./advice.js";
import { fetchOk } from "./http.js";

const FILES = { "fly-again.geojson": "GeoJSON", "fly-again.kml": "KML", "fly-again.waypoints": "MAVLink", "fly-again.csv": "CSV" };
const ACTIONS = ["verify", "copy", "report", "shutdown"];
const REFRESH_MS = 5000;
const REFRESH_IN_FLIGHT_MS = 60000;
const GPS_EPOCH_UNIX_S = 315964800;

// The last advice and its files, since the service may have ended when they are wanted.
const kept = { mission: null, advice: null, files: new Map(), atMs: -Infinity };
let temperatureRange = null;

// Forget what was kept of another mission. A reconnection to the same mission keeps it.
function followMission(id) {
  if (id === kept.mission) return;
  Object.assign(kept, { mission: id, advice: null, files: new Map(), atMs: -Infinity });
  temperatureRange = null;
}

async function keep(hasLanded) {
  if (performance.now() - kept.atMs < (hasLanded ? REFRESH_MS : REFRESH_IN_FLIGHT_MS)) return;
  kept.atMs = performance.now();
  const { mission } = kept;
  const advice = await fetchAdvice();
  // The files of an unchanged advice are those that were kept.
  if (mission !== kept.mission || !advice || (advice === kept.advice && kept.files.size === Object.keys(FILES).length)) return;
  kept.advice = advice;
  for (const name of Object.keys(FILES)) {
    const blob = await (await fetchOk(`/api/v1/advice/${name}`))?.blob();
    if (mission !== kept.mission) return;
    if (blob) kept.files.set(name, blob);
  }
}

function noteTemperatures(record) {
  for (const value of Object.values(record.temperatures_c || {})) {
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
    ["lost", number(triggers.lost), triggers.lost == null ? "" : triggers.lost ? "warning" : "good"],
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

// The command of each next step, for a person at the computer. The buttons are there while the service runs.
const commandOf = (name, path) => ({ verify: `syntopic verify ${path}`, copy: `syntopic transfer ${path} DISK`,
  report: `syntopic report ${path}`, shutdown: "systemctl poweroff" })[name];
const STATE_MARKS = { running: "▲", done: "●", failed: "■" };

function stateOf(action) {
  const { state, done_bytes: done, total_bytes: total, sentence } = action;
  const share = state === "running" && total ? percent(done / total) : "";
  return [element("strong", { className: state === "failed" ? "warning" : "", textContent: `${STATE_MARKS[state]} ${t(`landing.state.${state}`, { share })}` }),
    sentence && element("span", { lang: serverLanguage(action), textContent: serverText(action) })];
}

async function saveReport() {
  const blob = await (await fetchOk("/api/v1/report"))?.blob();
  if (!blob) return;
  kept.files.set("report.html", blob);
  download("report.html");
}

// Buttons of an action: one for each folder that a mission may be copied into, none where it is not possible.
function buttonsOf(name, { folders, poweroff, poweroff_message: message }, isBusy, feed) {
  const one = (label, body) => button(label, (event) => {
    event.target.disabled = true;
    feed.command(name, body).finally(() => { event.target.disabled = isBusy; });
  }, { disabled: isBusy, dataset: { action: name } });
  if (name === "copy") return folders.length ? folders.map((folder) => one(t("landing.copy_to", { folder }), { folder }))
    : [element("span", { className: "note", textContent: t("landing.no_folder") })];
  if (name === "shutdown" && poweroff) {
    return [element("span", { className: "note", lang: serverLanguage({ message }), textContent: serverText({ message }, poweroff) })];
  }
  return [one(t(`landing.${name}`), {})];
}

function nextSteps(feed) {
  const { mission, landing } = feed.flight.brief;
  const byHand = element("ul", { className: "next-steps" }, ...ACTIONS.map((name) => element("li", {},
    element("strong", { textContent: t(`landing.${name}`) }), element("code", { textContent: commandOf(name, mission.path || "MISSION") }))));
  if (!landing || !feed.isLinked) return [byHand];
  const isBusy = Object.values(landing.actions).some((one) => one.state === "running");
  const steps = ACTIONS.map((name) => {
    const action = landing.actions[name];
    const save = name === "report" && action && action.state !== "running" && button(t("landing.save_report"), saveReport, { dataset: { action: "save" } });
    return element("li", { dataset: { step: name } }, ...buttonsOf(name, landing, isBusy, feed), ...(action ? stateOf(action) : []).filter(Boolean), save || null);
  });
  const next = button(t("landing.next_mission"), () => feed.command("new-mission"), { disabled: isBusy, dataset: { action: "new-mission" } });
  return [element("ul", { className: "next-steps" }, ...steps, element("li", {}, next)),
    element("details", {}, element("summary", { textContent: t("landing.by_hand") }), byHand)];
}

export function start(root, feed) {
  let phase = null;
  // Each is drawn for itself: the time of the summary changes every second, and a button that is replaced loses its touch.
  const [figures, files, steps] = [1, 2, 3].map(() => element("div"));
  root.replaceChildren(figures, files, steps);
  const draw = () => {
    const { brief } = feed.flight;
    if (!brief) return;
    root.hidden = brief.phase !== "landed";
    // The summary comes by itself, also on a phone, whose map covers it.
    if (!root.hidden && phase !== "landed") feed.showTab("flight");
    phase = brief.phase;
    if (root.hidden) return;
    const rows = summary(feed.flight);
    redraw(figures, JSON.stringify([rows, brief.mission.id]), () => [
      element("h2", { textContent: t("landing.title", { mission: brief.mission.id || "" }) }),
      element("dl", { className: "figures wide summary" }, ...rows.map(([name, value, state]) => element("div", { className: state, dataset: { summary: name } },
        element("dt", { textContent: t(`landing.${name}`) }), element("dd", { textContent: value })))),
    ]);
    redraw(files, JSON.stringify([...kept.files.keys()]), () => [
      element("h2", { textContent: t("landing.fly_again") }),
      kept.files.size ? element("div", { className: "tools" }, ...Object.keys(FILES).filter((name) => kept.files.has(name)).map((name) => button(FILES[name], () => download(name),
        { dataset: { file: name } }))) : element("p", { className: "note", textContent: t("lines.no_plan") }),
    ]);
    redraw(steps, JSON.stringify([brief.landing, brief.mission.path, feed.isLinked]), () => [element("h2", { textContent: t("landing.next") }), ...nextSteps(feed)]);
  };
  feed.subscribe(async (record) => {
    followMission(feed.flight.brief.mission?.id || null);
    noteTemperatures(feed.flight.brief.status || {});
    // The first record has the temperatures of all exposures, also of those before this page was opened.
    for (const one of record?.history || []) noteTemperatures(one);
    const hasLanded = feed.flight.brief.phase === "landed";
    if (hasLanded && root.hidden) {
      kept.atMs = -Infinity;
      feed.showTab("flight");
    }
    if (record && feed.isLinked && (hasLanded || record.exposures)) await keep(hasLanded);
    draw();
  });
  by("landing").hidden = true;
}

// The text of a file that was kept; null if there is none.
export const textOf = async (name) => await kept.files.get(name)?.text() ?? null;
