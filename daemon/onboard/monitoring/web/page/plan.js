// The plan of the mission, and what of it has to be flown again.

import { askedJson } from "./asking.js";
import { flight } from "./state.js";
import { drawHoles, drawPlan } from "./map.js";

const AGAIN_MS = 3000;
const room = document.getElementById("fly-again");
const well = document.getElementById("well");
const rows = document.getElementById("segments");
let mission = null;
let hasPlan = false;
let asked = 0;
let waits = null;

const areaOf = (one) => one.holes.reduce((sum, hole) => sum + hole.area_m2, 0);

// What is wrong in a segment: bands that some ground lacks, and by how many images it is seen.
function lacksOf(one) {
  const words = one.holes.map((hole) =>
    `${hole.bands.length ? `${hole.bands.join(", ")}: ` : ""}${hole.images} of ${hole.needed} images`);
  return [...new Set(words)];
}

function row(one) {
  const made = document.createElement("tr");
  for (const text of [one.line, one.from_m.toFixed(0), one.to_m.toFixed(0),
    (areaOf(one) / 1e4).toFixed(2), `✖ ${[...lacksOf(one), ...one.reasons].join("; ")}`]) {
    const cell = document.createElement("td");
    cell.textContent = text;
    made.append(cell);
  }
  return made;
}

async function advise() {
  asked = Date.now();
  const advice = await askedJson("/api/v1/advice");
  if (!advice?.segments) return;
  const holes = advice.segments.filter((one) => one.kind === "hole");
  const share = advice.planned_m ? 100 * advice.covered_m / advice.planned_m : 0;
  well.textContent = [
    `${share.toFixed(0)} % of ${(advice.planned_m / 1000).toFixed(1)} km covered`,
    holes.length ? `${holes.length} ${holes.length === 1 ? "gap" : "gaps"} to re-fly, ${(advice.hole_m2 / 1e4).toFixed(2)} ha`
      : "no gap to re-fly",
    ...advice.notes,
  ].join(". ");
  rows.replaceChildren(...holes.map(row));
  rows.closest(".scroll").hidden = !holes.length;
  drawHoles(holes);
}

// Ask for the plan once a mission, and for advice when exposures came, not more often than is useful.
export async function followPlan(hasNewExposures) {
  const current = flight.brief?.mission?.id || null;
  if (current !== mission) {
    mission = current;
    const plan = current && await askedJson("/api/v1/plan");
    hasPlan = Boolean(plan?.lines);
    room.hidden = !hasPlan;
    drawPlan(plan);
    if (hasPlan) advise();
    return;
  }
  if (!hasPlan || !hasNewExposures || waits) return;
  waits = setTimeout(() => { waits = null; advise(); }, Math.max(0, asked + AGAIN_MS - Date.now()));
}
