// Before the flight: what a flight needs, item by item with a live lamp, and a test exposure with the setting it suggests.

import { by, button, element, redraw } from "./dom.js";
import { serverText, t } from "./i18n.js";
import { bytes, number, percent } from "./format.js";
import { fetchJson, fetchPatiently } from "./http.js";
import { lampStates } from "./lamps.js";
import { lastWhere } from "./feed.js";

const MARKS = { good: "●", caution: "▲", warning: "✖", off: "○" };
const FLIGHT_PHASES = new Set(["idle", "ready", "armed"]);
// A test exposure is well exposed if the brightest percent of its pixels lies here; full scale is 1.
const TARGET = 0.75;
const STEP_MAX = 4;
const ENOUGH = 0.1;
const FULL_SHARE = 0.005;

let plan;
let test = null;
let mission = null;

function quantile(counts, share) {
  const total = counts.reduce((a, b) => a + b, 0);
  let sum = 0;
  for (let bin = 0; bin < counts.length; bin += 1) {
    sum += counts[bin];
    if (sum >= share * total) return (bin + 1) / counts.length;
  }
  return 1;
}

const PAN = "pan";

// Counts of the sensors of each group of settings. A sensor outside PAN has a group of its own name.
export function countsOfGroups(groups, countsOfSensor) {
  const found = Object.fromEntries(groups.map((group) => [group, {}]));
  for (const [sensor, counts] of Object.entries(countsOfSensor || {})) {
    const group = groups.includes(sensor) ? sensor : PAN;
    if (group in found) found[group][sensor] = counts;
  }
  return found;
}

// The factor by which the exposure time of a group should change, from raw counts of its sensors.
export function suggestedFactor(countsOfSensor) {
  const all = Object.values(countsOfSensor || {}).filter((counts) => counts.some(Boolean));
  if (!all.length) return null;
  const isSaturated = all.some((counts) => counts.at(-1) / counts.reduce((a, b) => a + b, 0) > FULL_SHARE);
  if (isSaturated) return 0.5;
  const brightest = Math.max(...all.map((counts) => quantile(counts, 0.99)));
  const factor = Math.min(STEP_MAX, Math.max(1 / STEP_MAX, TARGET / brightest));
  return Math.abs(factor - 1) < ENOUGH ? 1 : factor;
}

function items(feed) {
  const { brief } = feed.flight;
  const { status = {} } = brief;
  const lamps = lampStates(feed);
  const listed = ["heads", "trigger", "time", "position", "processing"].map((name) =>
    ({ name, state: lamps[name].state, text: `${t(`lamp.${name}`)}: ${lamps[name].value}` }));
  const temperatures = Object.values(status.temperatures_c || {});
  if (temperatures.length) {
    const read = temperatures.filter((one) => one != null).length;
    listed.push({ name: "temperatures", state: read === temperatures.length ? "good" : "caution",
      text: t("check.temperatures", { read, all: temperatures.length }) });
  }
  const { exposures_left: left, exposures_planned: planned, exposure_bytes: each, disk_free_bytes: free } = status;
  const needed = planned ?? plan?.lines?.reduce((sum, line) => sum + line.places_m.length, 0) ?? null;
  if (left != null) {
    const isEnough = needed == null || left >= needed;
    listed.push({ name: "disk", state: left === 0 ? "warning" : isEnough ? "good" : "caution",
      text: needed == null || each == null ? t("check.disk", { free: free == null ? number(left) : bytes(free) })
        : t("check.disk_need", { free: bytes(free), need: bytes(needed * each), n: number(needed) }) });
  }
  listed.push(plan?.lines ? { name: "plan", state: "good", text: t("check.plan", { n: plan.lines.length }) }
    : { name: "plan", state: "off", text: t("check.no_plan") });
  for (const fault of brief.faults.filter((one) => one.code === "prerequisite" && one.stands)) {
    listed.push({ name: fault.id, state: "caution", text: serverText(fault) });
  }
  const verdict = test && feed.flight.exposures.get(test.number)?.verdict;
  const VERDICTS = { good: "good", usable: "caution", refly: "warning" };
  listed.push({ name: "test", state: verdict ? VERDICTS[verdict] : "off",
    text: verdict ? t("check.test_done", { number: test.number, verdict: t(`verdict.${verdict}`) }) : t("check.test") });
  return listed;
}

// After the verdict of a test exposure: the exposure time that its histograms suggest, for each group of heads.
async function readTest(feed) {
  const one = lastWhere((each) => each.step === "processed" && !each.line);
  if (!one || one.number === test?.number) return;
  const current = test = { number: one.number };
  const counts = await fetchJson(`/api/v1/exposures/${one.number}/histogram.json`);
  if (test !== current) return;
  const settings = feed.flight.settings?.settings || {};
  const groups = countsOfGroups(Object.keys(settings), counts);
  const judged = Object.entries(groups).map(([group, own]) => [group, suggestedFactor(own)]).filter(([, factor]) => factor != null);
  const rows = judged.filter(([, factor]) => factor !== 1).map(([group, factor]) => {
    const microseconds = Math.round(settings[group].exposure_time_us * factor);
    return element("li", { dataset: { group } },
      t("check.suggestion", { group, us: number(microseconds), change: `${factor > 1 ? "+" : ""}${percent(factor - 1)}` }), " ",
      button(t("check.use"), () => feed.command("exposure", { of: group, exposure_time_us: microseconds })));
  });
  if (judged.length) {
    by("exposure-suggestion").replaceChildren(...(rows.length ? rows
      : [element("li", { textContent: t("check.exposure_fits", { number: one.number }) })]));
  }
}

async function readPlan(id) {
  if (id === mission) return;
  mission = id;
  test = null;
  by("exposure-suggestion").replaceChildren();
  plan = id && await fetchPatiently("/api/v1/plan", () => mission === id);
}

export function start(root, feed) {
  // The button stays when an item changes: replaced, it would lose its touch.
  const list = element("div");
  root.append(list, button(t("check.do_test"), () => feed.command("trigger"), { id: "test-exposure" }));
  feed.subscribe(async (record) => {
    const { brief } = feed.flight;
    root.hidden = !FLIGHT_PHASES.has(brief.phase) || (brief.status?.ledger?.triggers?.triggers ?? 0) > 3;
    await readPlan(brief.mission?.id || null);
    if (record?.exposures) await readTest(feed);
    by("exposure-suggestion").hidden = root.hidden;
    if (root.hidden) return;
    const listed = items(feed);
    redraw(list, JSON.stringify(listed), () => [
      element("h2", { textContent: t("check.title") }),
      element("ul", { className: "checklist" }, ...listed.map((one) => element("li", { className: one.state, dataset: { check: one.name } },
        element("span", { className: "mark", ariaHidden: "true", textContent: MARKS[one.state] }),
        element("span", { textContent: one.text }), element("span", { className: "unseen", textContent: t(`lamp.state.${one.state}`) })))),
    ]);
  });
}
