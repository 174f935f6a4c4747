// Values for experts, each with one line of explanation, its limit and a colour; and charts over the flight.

import { by, element, redraw, text } from "./dom.js";
import { serverText, t } from "./i18n.js";
import { angle, number, percent, sigma, speed } from "./format.js";
import { lastWhere } from "./feed.js";
import { fetchPatiently } from "./http.js";
import { presentPosition } from "./lamps.js";
import { VisibleRows } from "./visible_rows.js";
import { drawCharts, fitCharts } from "./charts.js";

const MARKS = { good: "●", caution: "▲", warning: "■", absent: "○" };
const RANK = { refly: "warning", usable: "caution" };

// Colour of a value from the finding of the last exposure that judges it.
function judged(latest, ...flags) {
  const found = (latest?.findings || []).filter((one) => flags.includes(one.flag));
  const worst = found.some((one) => one.verdict === "refly") ? "refly" : found.some((one) => one.verdict === "usable") ? "usable" : "";
  return worst ? { state: RANK[worst], limit: serverText(found[0]) } : { state: latest ? "good" : "", limit: "" };
}

// Figure that limits a value, and how the limit is written.
const LIMITS = {
  clock_sigma: ["time_sigma_ns", sigma], time_sigma: ["time_sigma_ns", sigma],
  sigma0: ["sigma0_px", (value) => `${number(value, 2)} px`], tie_points: ["tie_points_pp", number],
  saturated: ["saturated_fraction", (value) => percent(value, 1)], tilt: ["tilt_deg", (value) => angle(value, 1)],
  crab: ["crab_deg", (value) => angle(value, 1)], overlap: ["forward_overlap", percent],
  gsd: ["gsd_m", (value) => `${number(100 * value, 1)} cm`], sun: ["sun_deg", angle],
};
let limits = {};
let limitsOf = null;

function limitText(code) {
  const [figure, shown] = LIMITS[code] || [];
  const { most, least } = limits[figure] || {};
  if (most != null) return t("expert.most", { limit: shown(most) });
  return least == null ? "" : t("expert.least", { limit: shown(least) });
}

// The limits of a mission are read once.
async function readLimits(mission, redrawn) {
  if (mission === limitsOf) return;
  limitsOf = mission;
  limits = {};
  const found = mission && await fetchPatiently("/api/v1/limits", () => limitsOf === mission);
  if (limitsOf !== mission) return;
  limits = found || {};
  redrawn();
}

// Code, text, flags that judge it, and id of each value. The texts explain each in one line.
function values({ brief }) {
  const { status = {} } = brief;
  const latest = lastWhere((one) => one.figures);
  const f = latest?.figures || {};
  const known = (value, shown) => value == null ? "–" : shown(value);
  const listed = [
    ["clock_sigma", known(status.clock_sigma_ns, sigma), status.in_holdover ? { state: "caution", limit: "" } : judged(latest, "TIME_SIGMA", "TIME_HOLDOVER"), "sigma"],
    ["time_sigma", known(latest?.mark_sigma_ns, sigma), judged(latest, "TIME_SIGMA")],
    ["sigma0", known(f.sigma0_px, (value) => `${number(value, 3)} px`), judged(latest, "SIGMA0")],
    ["dc", known(f.dc_k, (value) => `${number(value, 1)} K`), judged(latest, "DC_DISAGREEMENT", "TEMPERATURE_RANGE")],
    ["tie_points", known(f.tie_points_pp, (value) => `${number(value)} + ${number(f.tie_points_pc ?? 0)}`), judged(latest, "TIE_POINTS")],
    ["accuracy", known(f.stitched_sigma_px, (value) => `${number(value, 3)} px`), judged(latest, "DISPLACED_SENSOR")],
    ["displaced", f.displaced_sensor || (latest && "displaced_sensor" in f ? t("expert.none") : "–"), judged(latest, "DISPLACED_SENSOR")],
    ["saturated", known(f.saturated_fraction, (value) => percent(value, 2)), judged(latest, "OVEREXPOSED")],
    ["tilt", known(f.tilt_deg, (value) => angle(value, 1)), judged(latest, "TILT")],
    ["crab", known(f.crab_deg, (value) => angle(value, 1)), judged(latest, "DRIFT")],
    ["overlap", known(f.forward_overlap, percent), judged(latest, "OVERLAP")],
    ["gsd", known(f.gsd_m, (value) => `${number(100 * value, 1)} cm`), judged(latest, "GSD")],
    ["sun", known(f.sun_deg, angle), judged(latest, "SUN")],
    ["queue", known(status.queue, number), { state: status.queue > 5 ? "caution" : "good", limit: "" }],
  ];
  // What is absent has no state, whatever else was judged good.
  return listed.map(([code, shown, state, id]) => [code, shown, shown === "–" ? { state: "absent", limit: state.limit } : state, id]);
}

// Figures of the stitching and of time, one row for each of the last exposures.
function cellsOf(one) {
  const f = one.figures || {};
  return [one.number, one.mark_sigma_ns == null ? "" : sigma(one.mark_sigma_ns), f.sigma0_px == null ? "" : number(f.sigma0_px, 3),
    f.tie_points_pp === undefined ? "" : `${f.tie_points_pp}+${f.tie_points_pc ?? 0}`, f.dc_k == null ? "" : number(f.dc_k, 1),
    f.displaced_sensor || ""];
}

const rowOf = (one) => element("tr", {}, ...cellsOf(one).map((content) => element("td", { textContent: content })));

function drawRows(table, flight) {
  table.set([...flight.exposures.values()].sort((a, b) => b.number - a.number));
}

export function start(_root, feed) {
  const table = new VisibleRows(by("expert-rows"), (one) => JSON.stringify(cellsOf(one)), rowOf);
  feed.subscribe((record, isFirstRecord) => {
    const { status = {} } = feed.flight.brief;
    const position = presentPosition(feed.flight);
    const velocity = position?.velocity_ned_mps;
    text("satellites", position?.satellites);
    text("speed", velocity && speed(Math.hypot(velocity[0], velocity[1])));
    text("triggers", status.ledger?.triggers?.triggers);
    text("lost", status.ledger?.triggers?.lost);
    readLimits(feed.flight.brief.mission?.id ?? null, feed.refresh);
    const rows = values(feed.flight);
    redraw(by("expert"), JSON.stringify([rows, limits]), () => rows.map(([code, shown, { state, limit }, id]) => element("div", { className: state },
      element("dt", {}, element("span", { textContent: t(`expert.${code}`) }),
        element("span", { id: id || "", textContent: `${MARKS[state] || ""} ${shown}` })),
      element("dd", { textContent: [t(`expert.${code}.text`), limitText(code), limit].filter(Boolean).join(" ") }))));
    if (isFirstRecord || !record || record.exposures) drawRows(table, feed.flight);
    if (isFirstRecord || !record || record.history) drawCharts();
    if (!record) fitCharts();
  });
  new ResizeObserver(fitCharts).observe(by("page-expert"));
}
