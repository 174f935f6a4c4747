// The operator's page: draws the telemetry.

import { flight, connect, onChange } from "./telemetry.js";
import { confirmCommand, requestToken, command } from "./commands.js";
import { fetchJson } from "./http.js";
import { drawMap } from "./map.js";
import { drawExposure } from "./exposure.js";
import { followPlan } from "./plan.js";
import { clearImage, prepareImage, showImage } from "./quicklook.js";
import { drawCharts, fitCharts } from "./charts.js";

const MARKS = { good: "●", usable: "▲", refly: "■", lost: "✖" };
const PHASE_CLASS = { flying: "good", armed: "good", fault: "warning", idle: "caution" };
const POSITION_HOLDS_S = 5;
const DEVICE_MARKS = { ready: "●", searching: "◌", found: "○", unknown: "○", lost: "✖", absent: "✖" };
const KINDS = { head: "heads", navigator: "receivers", thermometer: "thermometers", trigger: "trigger", pps: "pulse per second" };
const SEVERITY_ORDER = { refly: 0, usable: 1, good: 2 };
const ROWS_SHOWN = 300;

const by = (id) => document.getElementById(id);
let selected = null;
let isFollowing = true;

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
  const created = Object.assign(document.createElement(name), properties);
  created.append(...children);
  return created;
}

// The position; null if it is older than POSITION_HOLDS_S.
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

// The disks of a mirrored mission, each with its command.
function drawDisks(disks) {
  by("disks-panel").hidden = !disks.length;
  const shown = JSON.stringify(disks);
  if (by("disks").dataset.shown === shown) return;
  by("disks").dataset.shown = shown;
  by("disks").replaceChildren(...disks.map((disk) => {
    const isUsed = disk.state === "in use";
    const details = [disk.state];
    if (isUsed && disk.exposures_left != null) details.push(`space for ${disk.exposures_left} exposures`);
    if (disk.exposures_to_copy) details.push(`${disk.exposures_to_copy} exposures to copy`);
    if (disk.temperature_c != null) details.push(`${disk.temperature_c} °C`);
    if (disk.wear_percent != null) details.push(`${disk.wear_percent} % worn`);
    if (disk.problems) details.push(...disk.problems);
    if (disk.sentence) details.push(disk.sentence);
    const item = element("li", { className: isUsed && disk.healthy !== false ? "ready" : "lost" },
      element("span", { textContent: isUsed ? "●" : "✖", ariaHidden: "true" }),
      element("span", { textContent: `${disk.disk} ${disk.path}` }),
      element("span", { className: "detail", textContent: details.join(", ") }));
    if (disks.length < 2) return item;
    const name = isUsed ? "release-disk" : "accept-disk";
    const button = element("button", { type: "button", textContent: isUsed ? "Release disk" : "Accept disk" });
    button.addEventListener("click", () => confirmCommand(name, { disk: disk.disk }));
    item.append(button);
    return item;
  }));
}

function lastWhere(predicate) {
  let found = null;
  for (const one of flight.exposures.values()) if (predicate(one) && (!found || one.number > found.number)) found = one;
  return found;
}

function drawVerdict() {
  const latest = lastWhere((one) => one.verdict || one.step === "lost");
  const label = latest ? latest.verdict || "lost" : "waiting";
  const container = by("verdict");
  const which = latest ? `exposure ${latest.number}` : "";
  if (container.dataset.shown === `${which} ${label}`) return;
  container.dataset.shown = `${which} ${label}`;
  container.className = `verdict ${label}`;
  container.querySelector(".mark").textContent = MARKS[label] || "·";
  container.querySelector(".word").textContent = label;
  container.querySelector(".which").textContent = which;
  const lost = { verdict: "lost", sentence: latest?.sentence || "The frames are lost. The table of re-flights lists its ground if the coverage is too low." };
  const findings = (label === "lost" ? [lost] : [...(latest?.findings || [])]).sort((a, b) => SEVERITY_ORDER[a.verdict] - SEVERITY_ORDER[b.verdict]);
  by("findings").replaceChildren(...findings.map((finding) =>
    element("li", { textContent: `${MARKS[finding.verdict] || ""} ${finding.sentence}`, className: finding.verdict })));
}

function drawFaults() {
  const faults = flight.brief.faults;
  const shownKey = JSON.stringify(faults);
  const list = by("faults");
  if (list.dataset.shown === shownKey) return;
  list.dataset.shown = shownKey;
  if (!faults.length) {
    list.replaceChildren(element("li", { className: "none", textContent: "none" }));
    return;
  }
  list.replaceChildren(...faults.map((fault) => {
    const label = fault.stands ? "✖ WARNING" : fault.previous ? "▲ BEFORE THE RESTART" : "▲ CLEARED";
    const repeated = (fault.count > 1 ? ` (${fault.count} times)` : "") + (fault.acknowledged ? ", acknowledged" : "");
    const item = element("li", { className: fault.stands ? "active" : "cleared" },
      element("span", {}, element("strong", { textContent: label + repeated }), fault.sentence));
    item.dataset.fault = fault.id;
    if (!fault.acknowledged) {
      const button = element("button", { type: "button", textContent: "Acknowledge" });
      button.addEventListener("click", () => command("acknowledge", { fault: fault.id }));
      item.append(button);
    }
    return item;
  }));
}

// Counters of the devices by name. They are not part of telemetry and are read for expanded kinds.
const counters = new Map();

async function readCounters() {
  for (const device of (await fetchJson("/api/v1/devices")) || []) counters.set(device.name, device.counters);
  for (const item of by("devices").querySelectorAll("li[data-device]")) {
    item.querySelector(".counters").textContent = countersText(item.dataset.device);
  }
}

function countersText(name) {
  return Object.entries(counters.get(name) || {}).filter(([, count]) => count)
    .map(([counter, count]) => `${counter.replaceAll("_", " ")} ${count}`).join(", ");
}

function deviceItem(device) {
  const item = element("li", { className: device.state },
    element("span", { textContent: DEVICE_MARKS[device.state] || "○", ariaHidden: "true" }),
    element("span", { textContent: device.name }),
    element("span", { className: "detail", textContent:
      device.state === "ready" ? "ready" : `${device.state}. ${device.sentence}` }),
    element("span", { className: "counters", textContent: countersText(device.name) }));
  item.dataset.device = device.name;
  return item;
}

const isWaiting = (device) => device.state === "searching";

// Devices by kind. Kinds with a device that is not ready come first and are expanded.
function drawDevices() {
  const kinds = Map.groupBy([...flight.devices.values()].sort((a, b) => a.name.localeCompare(b.name)),
    (device) => KINDS[device.kind] || device.kind || "other");
  const notReadyOf = (devices) => devices.filter((device) => device.state !== "ready");
  const opened = new Set([...by("devices").querySelectorAll("details.all-ready[open]")].map((one) => one.dataset.kind));
  const sorted = [...kinds].sort((a, b) => notReadyOf(b[1]).length - notReadyOf(a[1]).length || a[0].localeCompare(b[0]));
  by("devices").replaceChildren(...sorted.map(([kind, devices]) => {
    const notReady = notReadyOf(devices);
    const readyCount = devices.length - notReady.length;
    const container = element("details", { open: notReady.length > 0 || opened.has(kind), className: !notReady.length ? "all-ready" : notReady.every(isWaiting) ? "all-ready waiting" : "not-ready" },
      element("summary", { textContent: `${!notReady.length ? "●" : notReady.every(isWaiting) ? "◌" : "✖"} ${kind}: ${readyCount} of ${devices.length} ready` }),
      element("ul", {}, ...notReady.map(deviceItem), ...devices.filter((one) => !notReady.includes(one)).map(deviceItem)));
    container.dataset.kind = kind;
    container.addEventListener("toggle", () => container.open && readCounters());
    return element("li", {}, container);
  }));
}

function row(one) {
  const figures = one.figures || {};
  const label = one.verdict || one.step;
  const choose = element("button", { type: "button", textContent: one.number });
  const cells = [
    [choose],
    [`${MARKS[label] || ""} ${label}`, one.verdict || (one.step === "lost" ? "lost" : "")],
    [one.line || ""],
    [one.frames == null ? "" : `${one.frames}`],
    [duration(one.mark_sigma_ns) || ""],
    [figures.sigma0_px == null ? "" : figures.sigma0_px.toFixed(3)],
    [figures.tie_points_pp === undefined ? "" : `${figures.tie_points_pp}+${figures.tie_points_pc ?? 0}`],
    [figures.dc_k == null ? "" : figures.dc_k.toFixed(1)],
    [figures.displaced_sensor || ""],
  ];
  const tableRow = element("tr", {}, ...cells.map(([content, style]) =>
    element("td", { className: style || "" }, content)));
  tableRow.addEventListener("click", () => select(one.number));
  tableRow.setAttribute("aria-selected", String(one.number === selected));
  return tableRow;
}

function drawRows() {
  const newest = [...flight.exposures.values()].sort((a, b) => b.number - a.number).slice(0, ROWS_SHOWN);
  const focused = document.activeElement?.closest?.("#rows") ? document.activeElement.textContent : null;
  by("rows").replaceChildren(...newest.map(row));
  if (focused) [...by("rows").querySelectorAll("button")].find((b) => b.textContent === focused)?.focus();
}

function select(number) {
  selected = number;
  follow(false);
  showImage(number);
  drawRows();
}

function follow(wanted) {
  isFollowing = wanted;
  by("follow").setAttribute("aria-pressed", String(wanted));
}

onChange((record, isFirstRecord) => {
  if (isFirstRecord) {
    selected = null;
    clearImage();
  }
  drawHead();
  drawVerdict();
  drawFaults();
  drawExposure();
  // While following, select the latest processed exposure.
  if (isFollowing) selected = lastWhere((one) => one.step === "processed")?.number ?? selected;
  if (isFirstRecord || record.devices) drawDevices();
  if (isFirstRecord || record.exposures || record.track) drawMap(select);
  followPlan(Boolean(record.exposures));
  if (isFirstRecord || record.exposures) drawRows();
  if (isFirstRecord || record.history) drawCharts();
  if (selected != null) showImage(selected);
});

by("follow").addEventListener("click", () => follow(!isFollowing));
function setTheme(isDark) {
  document.documentElement.dataset.theme = isDark ? "dark" : "";
  by("theme").setAttribute("aria-pressed", String(isDark));
  localStorage.setItem("cabin", isDark ? "dark" : "");
  if (flight.brief) drawMap(select);
  fitCharts();
}

by("theme").addEventListener("click", () => setTheme(document.documentElement.dataset.theme !== "dark"));
setTheme(localStorage.getItem("cabin") === "dark");
addEventListener("resize", fitCharts);
prepareImage(() => selected != null && showImage(selected));

let isLive = false;

// State of the connection. A service that ended after landing is no fault.
function linkState(isLinked) {
  if (isLinked) return { label: "connected", style: "good" };
  if (!flight.brief) return { label: "connecting", style: "caution" };
  const at = new Date().toLocaleTimeString("en-GB");
  return flight.brief.phase === "landed"
    ? { label: "ended", style: "", title: "LANDED", sentence: `Landed. The service ended ${at}. Values are those at its end.` }
    : { label: "disconnected", style: "warning", title: "CONNECTION LOST", sentence: `✖ Connection lost ${at}. Values are frozen.` };
}

connect((isLinked) => {
  const link = by("link");
  const state = linkState(isLinked);
  if (isLinked || isLive || !flight.brief) {
    link.textContent = state.label;
    link.className = `chip ${state.style}`;
  }
  document.body.classList.toggle("connection-lost", !isLinked);
  if (!isLinked && isLive) {
    by("connection-lost").textContent = state.sentence;
    by("connection-lost").classList.toggle("ended", state.title === "LANDED");
    document.title = `${state.title} · ${document.title}`;
  }
  by("connection-lost").hidden = isLinked || !(isLive || flight.brief);
  isLive = isLinked;
}, async () => {
  by("link").textContent = "token needed";
  let token = "";
  while (!token) token = await requestToken();
  sessionStorage.setItem("token", token);
});
