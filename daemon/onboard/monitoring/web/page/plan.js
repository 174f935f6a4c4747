// The flight plan of the mission, and the segments to re-fly.

import { fetchJson } from "./http.js";
import { flight } from "./telemetry.js";
import { drawGaps, drawPlan } from "./map.js";
import { serverTexts, t } from "./i18n.js";
import { distance, number, percent } from "./format.js";
import { button } from "./dom.js";

const REFRESH_MS = 3000;
const coverageText = document.getElementById("coverage");
const rows = document.getElementById("segments");
let mission = null;
let hasPlan = false;
let requestedMs = 0;
let timer = null;
let retakes = 0;
let sendCommand = null;
let gapsFound = null;

// Gaps of the coverage as it was last computed; null before that.
export const gaps = () => gapsFound;

const areaOf = (one) => one.holes.reduce((sum, gap) => sum + gap.area_m2, 0);

// Shortfalls of a segment: missing bands, and images found of images required.
function shortfallsOf(one) {
  const texts = one.holes.map((gap) =>
    `${gap.bands.length ? `${gap.bands.join(", ")}: ` : ""}${t("lines.images", gap)}`);
  return [...new Set(texts)];
}

function row(one) {
  const tableRow = document.createElement("tr");
  for (const text of [one.line, one.from_m.toFixed(0), one.to_m.toFixed(0),
    (areaOf(one) / 1e4).toFixed(2), `✖ ${[...shortfallsOf(one), ...serverTexts(one, "reasons")].join("; ")}`]) {
    const cell = document.createElement("td");
    cell.textContent = text;
    tableRow.append(cell);
  }
  const action = document.createElement("td");
  action.append(button(t("lines.retake"), () => sendCommand("retake", { line: one.line, from_m: one.from_m, to_m: one.to_m }),
    { ariaLabel: `${t("lines.retake")} ${one.line} ${one.from_m.toFixed(0)}` }));
  tableRow.append(action);
  return tableRow;
}

async function updateAdvice() {
  requestedMs = Date.now();
  const advice = await fetchJson("/api/v1/advice");
  if (!advice?.segments) return;
  const found = advice.segments.filter((one) => one.kind === "hole");
  const share = advice.planned_m ? advice.covered_m / advice.planned_m : 0;
  coverageText.textContent = [
    t("lines.covered", { share: percent(share), length: distance(advice.planned_m) }),
    found.length ? t("lines.gaps", { n: found.length, ha: number(advice.hole_m2 / 1e4, 2) }) : t("lines.no_gap"),
    ...serverTexts(advice, "notes"),
  ].join(". ");
  // Unchanged gaps are not drawn again.
  if (gapsFound && JSON.stringify(gapsFound) === JSON.stringify(found)) return;
  rows.replaceChildren(...found.map(row));
  rows.closest(".scroll").hidden = !found.length;
  gapsFound = found;
  drawGaps(found);
}

// Fetch the plan once per mission. Fetch the coverage after new exposures, at most every REFRESH_MS.
async function followPlan(hasNewExposures) {
  const current = flight.brief?.mission?.id || null;
  const wantedRetakes = flight.brief?.retakes || 0;
  if (current !== mission || wantedRetakes !== retakes) {
    mission = current;
    retakes = wantedRetakes;
    const plan = current && await fetchJson("/api/v1/plan");
    hasPlan = Boolean(plan?.lines);
    gapsFound = null;
    drawPlan(plan);
    if (hasPlan) updateAdvice();
    return;
  }
  if (!hasPlan || !hasNewExposures || timer) return;
  timer = setTimeout(() => { timer = null; updateAdvice(); }, Math.max(0, requestedMs + REFRESH_MS - Date.now()));
}

export function start(_root, feed) {
  sendCommand = feed.command;
  feed.subscribe((record) => followPlan(Boolean(record?.exposures)));
}
