// The operator's page: what came by telemetry, put where an operator looks for it.

import { flight, listen, onChange } from "./state.js";
import { command } from "./commands.js";
import { drawMap } from "./map.js";
import { drawExposure } from "./exposure.js";
import { followPlan } from "./plan.js";
import { prepareImage, showImage } from "./image.js";
import { drawCharts, fitCharts } from "./charts.js";

const MARKS = { good: "●", usable: "▲", refly: "■", lost: "✖" };
const PHASE_CLASS = { flying: "good", armed: "good", ready: "caution", fault: "warning", idle: "caution" };
const DEVICE_MARKS = { ready: "●", found: "○", unknown: "○", lost: "✖", absent: "✖" };
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
  return `${(ns / 1e6).toPrecision(3)} ms`;
}

function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

function drawHead() {
  const brief = flight.brief;
  const status = brief.status || {};
  const phase = by("phase");
  phase.textContent = brief.phase;
  phase.className = `chip ${PHASE_CLASS[brief.phase] || ""}`;
  by("simulated").hidden = !brief.simulated;
  document.title = `${brief.simulated ? "SIMULATED · " : ""}${brief.mission.rig || ""} · Syntopic`;
  text("left", status.exposures_left);
  text("sigma", duration(status.clock_sigma_ns));
  text("satellites", status.position?.satellites);
  const velocity = status.position?.velocity_ned_mps;
  text("speed", velocity && `${Math.hypot(velocity[0], velocity[1]).toFixed(1)} m/s`);
  text("triggers", status.ledger?.triggers?.triggers);
  text("lost", status.ledger?.triggers?.lost);
  const missing = brief.phase === "ready" || brief.phase === "armed" ? status.missing || [] : [];
  by("missing").replaceChildren(...missing.map((one) => element("li", { textContent: `Missing: ${one}` })));
  const temperatures = Object.entries(status.temperatures_c || {});
  by("temperatures").replaceChildren(...temperatures.map(([probe, value]) => element("div", {},
    element("dt", { textContent: probe }),
    element("dd", { textContent: value == null ? "open" : `${value.toFixed(2)} °C` }))));
}

function lastJudged() {
  let last = null;
  for (const one of flight.exposures.values()) {
    if ((one.verdict || one.step === "lost") && (!last || one.number > last.number)) last = one;
  }
  return last;
}

function drawVerdict() {
  const last = lastJudged();
  if (!last) return;
  const word = last.verdict || "lost";
  const room = by("verdict");
  const which = `exposure ${last.number}`;
  if (room.dataset.told === `${which} ${word}`) return;
  room.dataset.told = `${which} ${word}`;
  room.className = `verdict ${word}`;
  room.querySelector(".mark").textContent = MARKS[word];
  room.querySelector(".word").textContent = word;
  room.querySelector(".which").textContent = which;
  by("findings").replaceChildren(...(last.findings || []).map((finding) =>
    element("li", { textContent: finding.sentence })));
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
    const repeated = fault.count > 1 ? ` (${fault.count} times)` : "";
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

function drawDevices() {
  const devices = [...flight.devices.values()].sort((a, b) =>
    (a.state === "ready") - (b.state === "ready") || a.name.localeCompare(b.name));
  by("devices").replaceChildren(...devices.map((device) => element("li", { className: device.state },
    element("span", { textContent: DEVICE_MARKS[device.state] || "○", ariaHidden: "true" }),
    element("span", { textContent: device.name }),
    element("span", { className: "said", textContent:
      device.state === "ready" ? "ready" : `${device.state}. ${device.sentence}` }))));
}

function row(one) {
  const figures = one.figures || {};
  const word = one.verdict || one.step;
  const choose = element("button", { type: "button", textContent: one.number });
  choose.addEventListener("click", () => select(one.number));
  const cells = [
    [choose],
    [`${MARKS[one.verdict] || ""} ${word}`, one.verdict || (one.step === "lost" ? "lost" : "")],
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

onChange((record) => {
  drawHead();
  drawVerdict();
  drawFaults();
  drawExposure();
  const last = lastJudged();
  if (follows && last) chosen = last.number;
  if (record.devices) drawDevices();
  if (record.exposures || record.track) drawMap(select);
  followPlan(Boolean(record.exposures));
  if (record.exposures) drawRows();
  if (record.history || !document.querySelector("#chart-sigma0 .uplot")) drawCharts();
  if (chosen != null) showImage(chosen);
});

by("follow").addEventListener("click", () => follow(!follows));
by("theme").addEventListener("click", () => {
  const dark = document.documentElement.dataset.theme !== "dark";
  document.documentElement.dataset.theme = dark ? "dark" : "";
  by("theme").setAttribute("aria-pressed", String(dark));
  if (flight.brief) drawMap(select);
});
addEventListener("resize", fitCharts);
prepareImage(() => chosen != null && showImage(chosen));

listen((isLinked) => {
  const link = by("link");
  link.textContent = isLinked ? "linked" : "no link";
  link.className = `chip ${isLinked ? "good" : "warning"}`;
});
