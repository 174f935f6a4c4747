// The operator's page: what came by telemetry, put where an operator looks for it.

import { flight, listen, onChange } from "./state.js";
import { askCommand, askToken, command } from "./commands.js";
import { drawMap } from "./map.js";
import { drawExposure } from "./exposure.js";
import { followPlan } from "./plan.js";
import { forgetImage, prepareImage, showImage } from "./image.js";
import { drawCharts, fitCharts } from "./charts.js";

const MARKS = { good: "●", usable: "▲", refly: "■", lost: "✖" };
const PHASE_CLASS = { flying: "good", armed: "good", fault: "warning", idle: "caution" };
const POSITION_HOLDS_S = 5;
const DEVICE_MARKS = { ready: "●", searching: "◌", found: "○", unknown: "○", lost: "✖", absent: "✖" };
const KINDS = { head: "heads", navigator: "receivers", thermometer: "thermometers", trigger: "trigger", pps: "pulse per second" };
const GRAVITY = { refly: 0, usable: 1, good: 2 };
const ROWS_SHOWN = 300;

const by = (id) => document.getElementById(id);
let chosen = null;
let follows = true;

function text(id, value) {
  by(id).textContent = value == null ? "–" : value;
}

function duration(ns) {
  if (ns == null) return null;
  if (ns < 1e3) return `${ns} ns`;
  if (ns < 1e6) return `${(ns / 1e3).toPrecision(3)} µs`;
  if (ns < 1e9) return `${(ns / 1e6).toPrecision(3)} ms`;
  return ns < 1e14 ? `${(ns / 1e9).toFixed(1)} s` : "unknown";
}

function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

// A position of some seconds ago is not where the camera is now.
function presentPosition() {
  const position = flight.brief.status?.position;
  return position && (position.age_s ?? 0) <= POSITION_HOLDS_S ? position : null;
}

function drawHead() {
  const brief = flight.brief;
  const status = brief.status || {};
  const phase = by("phase");
  const isBlocked = brief.phase === "ready" && status.missing?.length > 0;
  phase.textContent = isBlocked ? "not ready" : brief.phase;
  phase.className = `chip ${isBlocked ? "caution" : PHASE_CLASS[brief.phase] || ""}`;
  by("simulated").hidden = !brief.simulated;
  by("recovery").replaceChildren(...(brief.mission.recovery || []).map((one) =>
    element("li", { textContent: `At the restart: ${one}` })));
  document.title = `${brief.simulated ? "SIMULATED · " : ""}${brief.mission.rig || ""} · Syntopic`;
  text("left", status.exposures_left);
  text("sigma", duration(status.clock_sigma_ns));
  const position = presentPosition();
  text("satellites", position?.satellites);
  const velocity = position?.velocity_ned_mps;
  text("speed", velocity && `${Math.hypot(velocity[0], velocity[1]).toFixed(1)} m/s`);
  text("triggers", status.ledger?.triggers?.triggers);
  text("lost", status.ledger?.triggers?.lost);
  const missing = brief.phase === "ready" || brief.phase === "armed" ? status.missing || [] : [];
  by("missing").replaceChildren(...missing.map((one) => element("li", { textContent: `Missing: ${one}` })));
  drawDisks(status.disks || []);
  const temperatures = Object.entries(status.temperatures_c || {});
  by("temperatures").replaceChildren(...temperatures.map(([probe, value]) => element("div", {},
    element("dt", { textContent: probe }),
    element("dd", { textContent: value == null ? "no reading" : `${value.toFixed(2)} °C` }))));
}

// The disks of a mirrored mission, each with the command that changes it.
function drawDisks(disks) {
  by("disks-room").hidden = !disks.length;
  const shown = JSON.stringify(disks);
  if (by("disks").dataset.shown === shown) return;
  by("disks").dataset.shown = shown;
  by("disks").replaceChildren(...disks.map((disk) => {
    const isUsed = disk.state === "in use";
    const details = [disk.state];
    if (isUsed && disk.exposures_left != null) details.push(`room for ${disk.exposures_left} exposures`);
    if (disk.exposures_to_copy) details.push(`${disk.exposures_to_copy} exposures to copy`);
    if (disk.temperature_c != null) details.push(`${disk.temperature_c} °C`);
    if (disk.wear_percent != null) details.push(`${disk.wear_percent} % worn`);
    if (disk.problems) details.push(...disk.problems);
    if (disk.sentence) details.push(disk.sentence);
    const item = element("li", { className: isUsed && disk.healthy !== false ? "ready" : "lost" },
      element("span", { textContent: isUsed ? "●" : "✖", ariaHidden: "true" }),
      element("span", { textContent: `${disk.disk} ${disk.path}` }),
      element("span", { className: "said", textContent: details.join(", ") }));
    if (disks.length < 2) return item;
    const name = isUsed ? "release-disk" : "accept-disk";
    const button = element("button", { type: "button", textContent: isUsed ? "Release disk" : "Accept disk" });
    button.addEventListener("click", () => askCommand(name, { disk: disk.disk }));
    item.append(button);
    return item;
  }));
}

function last(isIt) {
  let found = null;
  for (const one of flight.exposures.values()) if (isIt(one) && (!found || one.number > found.number)) found = one;
  return found;
}

function drawVerdict() {
  const judged = last((one) => one.verdict || one.step === "lost");
  const word = judged ? judged.verdict || "lost" : "waiting";
  const room = by("verdict");
  const which = judged ? `exposure ${judged.number}` : "";
  if (room.dataset.told === `${which} ${word}`) return;
  room.dataset.told = `${which} ${word}`;
  room.className = `verdict ${word}`;
  room.querySelector(".mark").textContent = MARKS[word] || "·";
  room.querySelector(".word").textContent = word;
  room.querySelector(".which").textContent = which;
  const lost = { verdict: "lost", sentence: judged?.sentence || "Its frames are lost. If its ground is not seen often enough, the table of re-flights lists it." };
  const findings = (word === "lost" ? [lost] : [...(judged?.findings || [])]).sort((a, b) => GRAVITY[a.verdict] - GRAVITY[b.verdict]);
  by("findings").replaceChildren(...findings.map((finding) =>
    element("li", { textContent: `${MARKS[finding.verdict] || ""} ${finding.sentence}`, className: finding.verdict })));
}

function drawFaults() {
  const faults = flight.brief.faults;
  const told = JSON.stringify(faults);
  const list = by("faults");
  if (list.dataset.told === told) return;
  list.dataset.told = told;
  if (!faults.length) {
    list.replaceChildren(element("li", { className: "none", textContent: "none" }));
    return;
  }
  list.replaceChildren(...faults.map((fault) => {
    const word = fault.stands ? "✖ WARNING" : fault.previous ? "▲ BEFORE THE RESTART" : "▲ PASSED";
    const repeated = (fault.count > 1 ? ` (${fault.count} times)` : "") + (fault.acknowledged ? ", acknowledged" : "");
    const item = element("li", { className: fault.stands ? "stands" : "passed" },
      element("span", {}, element("strong", { textContent: word + repeated }), fault.sentence));
    item.dataset.fault = fault.id;
    if (!fault.acknowledged) {
      const button = element("button", { type: "button", textContent: "Acknowledge" });
      button.addEventListener("click", () => command("acknowledge", { fault: fault.id }));
      item.append(button);
    }
    return item;
  }));
}

function deviceItem(device) {
  return element("li", { className: device.state },
    element("span", { textContent: DEVICE_MARKS[device.state] || "○", ariaHidden: "true" }),
    element("span", { textContent: device.name }),
    element("span", { className: "said", textContent:
      device.state === "ready" ? "ready" : `${device.state}. ${device.sentence}` }));
}

const isWaiting = (device) => device.state === "searching";

// By kind; what is wrong is on top and open, what is well can be looked into.
function drawDevices() {
  const kinds = Map.groupBy([...flight.devices.values()].sort((a, b) => a.name.localeCompare(b.name)),
    (device) => KINDS[device.kind] || device.kind || "other");
  const ill = (devices) => devices.filter((device) => device.state !== "ready");
  const opened = new Set([...by("devices").querySelectorAll("details.well[open]")].map((one) => one.dataset.kind));
  const sorted = [...kinds].sort((a, b) => ill(b[1]).length - ill(a[1]).length || a[0].localeCompare(b[0]));
  by("devices").replaceChildren(...sorted.map(([kind, devices]) => {
    const wrong = ill(devices);
    const well = devices.length - wrong.length;
    const room = element("details", { open: wrong.length > 0 || opened.has(kind), className: !wrong.length ? "well" : wrong.every(isWaiting) ? "well waiting" : "ill" },
      element("summary", { textContent: `${!wrong.length ? "●" : wrong.every(isWaiting) ? "◌" : "✖"} ${kind}: ${well} of ${devices.length} ready` }),
      element("ul", {}, ...wrong.map(deviceItem), ...devices.filter((one) => !wrong.includes(one)).map(deviceItem)));
    room.dataset.kind = kind;
    return element("li", {}, room);
  }));
}

function row(one) {
  const figures = one.figures || {};
  const word = one.verdict || one.step;
  const choose = element("button", { type: "button", textContent: one.number });
  const cells = [
    [choose],
    [`${MARKS[word] || ""} ${word}`, one.verdict || (one.step === "lost" ? "lost" : "")],
    [one.line || ""],
    [one.frames == null ? "" : `${one.frames}`],
    [duration(one.mark_sigma_ns) || ""],
    [figures.sigma0_px == null ? "" : figures.sigma0_px.toFixed(3)],
    [figures.tie_points_pp === undefined ? "" : `${figures.tie_points_pp}+${figures.tie_points_pc ?? 0}`],
    [figures.dc_k == null ? "" : figures.dc_k.toFixed(1)],
    [figures.displaced_sensor || ""],
  ];
  const made = element("tr", {}, ...cells.map(([content, style]) =>
    element("td", { className: style || "" }, content)));
  made.addEventListener("click", () => select(one.number));
  made.setAttribute("aria-selected", String(one.number === chosen));
  return made;
}

function drawRows() {
  const newest = [...flight.exposures.values()].sort((a, b) => b.number - a.number).slice(0, ROWS_SHOWN);
  const focused = document.activeElement?.closest?.("#rows") ? document.activeElement.textContent : null;
  by("rows").replaceChildren(...newest.map(row));
  if (focused) [...by("rows").querySelectorAll("button")].find((b) => b.textContent === focused)?.focus();
}

function select(number) {
  chosen = number;
  follow(false);
  showImage(number);
  drawRows();
}

function follow(wanted) {
  follows = wanted;
  by("follow").setAttribute("aria-pressed", String(wanted));
}

onChange((record, isFresh) => {
  if (isFresh) {
    chosen = null;
    forgetImage();
  }
  drawHead();
  drawVerdict();
  drawFaults();
  drawExposure();
  // The image that is followed is the last there is, under its own number.
  if (follows) chosen = last((one) => one.step === "processed")?.number ?? chosen;
  if (isFresh || record.devices) drawDevices();
  if (isFresh || record.exposures || record.track) drawMap(select);
  followPlan(Boolean(record.exposures));
  if (isFresh || record.exposures) drawRows();
  if (isFresh || record.history) drawCharts();
  if (chosen != null) showImage(chosen);
});

by("follow").addEventListener("click", () => follow(!follows));
function cabin(isDark) {
  document.documentElement.dataset.theme = isDark ? "dark" : "";
  by("theme").setAttribute("aria-pressed", String(isDark));
  localStorage.setItem("cabin", isDark ? "dark" : "");
  if (flight.brief) drawMap(select);
  fitCharts();
}

by("theme").addEventListener("click", () => cabin(document.documentElement.dataset.theme !== "dark"));
cabin(localStorage.getItem("cabin") === "dark");
addEventListener("resize", fitCharts);
prepareImage(() => chosen != null && showImage(chosen));

let isLive = false;

// What the lamp of the link says: a service that landed ended by itself, and that is no fault.
function linkState(isLinked) {
  if (isLinked) return { word: "linked", style: "good" };
  if (!flight.brief) return { word: "connecting", style: "caution" };
  const at = new Date().toLocaleTimeString("en-GB");
  return flight.brief.phase === "landed"
    ? { word: "ended", style: "", title: "LANDED", sentence: `Landed. The service ended ${at}. Values are those at its end.` }
    : { word: "no link", style: "warning", title: "NO LINK", sentence: `✖ Connection lost ${at}. Values are frozen.` };
}

listen((isLinked) => {
  const link = by("link");
  const state = linkState(isLinked);
  if (isLinked || isLive || !flight.brief) {
    link.textContent = state.word;
    link.className = `chip ${state.style}`;
  }
  document.body.classList.toggle("stale", !isLinked);
  if (!isLinked && isLive) {
    by("stale").textContent = state.sentence;
    by("stale").classList.toggle("ended", state.title === "LANDED");
    document.title = `${state.title} · ${document.title}`;
  }
  by("stale").hidden = isLinked || !(isLive || flight.brief);
  isLive = isLinked;
}, async () => {
  by("link").textContent = "token needed";
  let token = "";
  while (!token) token = await askToken();
  sessionStorage.setItem("token", token);
});
