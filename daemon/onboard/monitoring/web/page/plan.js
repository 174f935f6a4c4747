// The flight plan of the mission, and the segments to re-fly.

import { fetchAdvice } from "./advice.js";
import { fetchPatiently } from "./http.js";
import { nearPlaces } from "./longitudes.js";
import { flight } from "./telemetry.js";
import { drawGaps, drawPlan } from "./map.js";
import { serverTexts, t } from "./i18n.js";
import { distance, number, percent } from "./format.js";
import { button, element } from "./dom.js";
import { VisibleRows } from "./visible_rows.js";

const REFRESH_MS = 3000;
const coverageText = document.getElementById("coverage");
let mission = null;
let hasPlan = false;
let requestedMs = 0;
let timer = null;
let retakes = 0;
let sendCommand = null;
let gapsFound = null;
let shownAdvice = null;
let plan = null;

// Gaps of the coverage as it was last computed; null before that.
export const gaps = () => gapsFound;

// Whether every line of the plan and every retake is flown. Unknown without a plan: false.
export function isPlanFlown({ flown = [], current = null } = {}) {
  if (!plan?.lines.length || current != null) return false;
  const done = new Set(flown);
  return plan.lines.every((one) => done.has(one.id)) && plan.retakes.every((one) => done.has(one.line));
}

const areaOf = (one) => one.holes.reduce((sum, gap) => sum + gap.area_m2, 0);

// Shortfalls of a segment: missing bands, and images found of images required.
function shortfallsOf(one) {
  const texts = one.holes.map((gap) =>
    `${gap.bands.length ? `${gap.bands.join(", ")}: ` : ""}${t("lines.images", gap)}`);
  return [...new Set(texts)];
}

// Ids of the planned retakes of a line that repeat the middle of a segment: it needs no other one.
export function retakesOf(segment, planned) {
  const line = planned?.lines?.find((one) => one.id === segment.line);
  if (!line) return [];
  const [[lat0, lon0], [lat1, lon1]] = line.at;
  const [north, east] = [lat1 - lat0, lon1 - lon0];
  // The place along the line: 0 at its start, 1 at its end.
  const shareOf = ([latitude, longitude]) => ((latitude - lat0) * north + (longitude - lon0) * east) / (north ** 2 + east ** 2);
  const middle = (shareOf(segment.at[0]) + shareOf(segment.at[1])) / 2;
  return (planned.retakes || []).filter(({ of, at }) => of === segment.line && (shareOf(at[0]) - middle) * (shareOf(at[1]) - middle) <= 0)
    .map((one) => one.line);
}

const cellsOf = (one) => [one.line, one.from_m.toFixed(0), one.to_m.toFixed(0), number(areaOf(one) / 1e4, 2),
  [`✖ ${[...shortfallsOf(one), ...serverTexts(one, "reasons")].join("; ")}`, ...retakesOf(one, plan).map((id) => `↻ ${id}`)].join(" ")];

function row(one) {
  const retake = button(t("lines.retake"), () => sendCommand("retake", { line: one.line, from_m: one.from_m, to_m: one.to_m }),
    { ariaLabel: `${t("lines.retake")} ${one.line} ${one.from_m.toFixed(0)}` });
  const cells = cellsOf(one).map((textContent) => element("td", { textContent }));
  cells.at(-1).append(retake);
  return element("tr", {}, ...cells);
}

const rows = new VisibleRows(document.getElementById("segments"), (one) => cellsOf(one).join(), row);

function drawRows(found) {
  rows.table.closest(".scroll").hidden = !found.length;
  rows.set(found.map((one) => Object.assign(one, { number: `${one.line} ${one.from_m}` })));
}

// Gaps of an advice, their places next to those of the flight. They are moved where they are: a copy would be held as well.
function gapsOf(advice) {
  const found = advice.segments.filter((one) => one.kind === "hole");
  for (const one of found) {
    one.at = nearPlaces(one.at);
    for (const gap of one.holes) gap.rings = gap.rings.map(nearPlaces);
  }
  return found;
}

function drawCoverage() {
  const advice = shownAdvice;
  if (!advice) return;
  const share = advice.planned_m ? advice.covered_m / advice.planned_m : 0;
  coverageText.textContent = [
    t("lines.covered", { share: percent(share), length: distance(advice.planned_m) }),
    gapsFound.length ? t("lines.gaps", { n: gapsFound.length, ha: number(advice.hole_m2 / 1e4, 2) }) : t("lines.no_gap"),
    ...serverTexts(advice, "notes"),
  ].join(". ");
}

async function updateAdvice() {
  requestedMs = performance.now();
  const advice = await fetchAdvice();
  if (!advice || advice === shownAdvice) return;
  shownAdvice = advice;
  gapsFound = gapsOf(advice);
  drawCoverage();
  drawRows(gapsFound);
  drawGaps(gapsFound);
}

const placed = (lines = []) => lines.map((one) => ({ ...one, at: nearPlaces(one.at) }));

// Fetch the plan once per mission. Fetch the coverage after new exposures, at most every REFRESH_MS.
async function followPlan(hasNewExposures) {
  const current = flight.brief?.mission?.id || null;
  const wantedRetakes = flight.brief?.retakes || 0;
  if (current !== mission || wantedRetakes !== retakes) {
    mission = current;
    retakes = wantedRetakes;
    const isPresent = () => mission === current && retakes === wantedRetakes;
    const received = current && await fetchPatiently("/api/v1/plan", isPresent);
    if (!isPresent()) return;
    plan = received && { lines: placed(received.lines), retakes: placed(received.retakes) };
    hasPlan = Boolean(received?.lines);
    gapsFound = shownAdvice = null;
    drawPlan(plan);
    if (!hasPlan) {
      coverageText.textContent = t("lines.no_plan");
      drawRows([]);
      drawGaps([]);
    }
    if (hasPlan) updateAdvice();
    return;
  }
  if (!hasPlan || !hasNewExposures || timer) return;
  timer = setTimeout(() => { timer = null; updateAdvice(); }, Math.max(0, requestedMs + REFRESH_MS - performance.now()));
}

export function start(_root, feed) {
  sendCommand = feed.command;
  feed.subscribe((record) => {
    if (!record) drawCoverage();
    followPlan(Boolean(record?.exposures));
  });
}
