// The map: lines, track and footprints, coloured by verdict and marked by shape, over offline base maps.

import { flight, restore } from "./telemetry.js";
import { onGuidance } from "./guidance.js";
import { presentPosition } from "./lamps.js";
import { startLayers } from "./map_layers.js";
import { OlderLayer } from "./map_older.js";
import { PlanLayer } from "./map_plan.js";
import { near } from "./longitudes.js";
import { aircraftMark, trackOf } from "./aircraft_mark.js";
import { ageOf } from "./guidance_link.js";
import { STALE_S } from "./guidance_view.js";
import { isMeasuring, startMeasuring } from "./map_measure.js";
import { startNoData } from "./map_no_data.js";

const COLOURS = { good: "--good", usable: "--caution", refly: "--warning", lost: "--warning" };
const DASHES = { good: null, usable: "6 3", refly: "2 4", lost: "1 7" };

// Leaflet parses a string as HTML.
const label = (text) => document.createTextNode(text);

const map = L.map("map", { zoomControl: true, attributionControl: false, zoomSnap: 0.25 });
map.setView([0, 0], 2);
L.control.scale({ imperial: false, maxWidth: 140 }).addTo(map);
const track = L.polyline([], { color: "#777", weight: 2 }).addTo(map);
const marker = aircraftMark();
// What is farther from the plan is no part of the view: one wrong position would make the flight a dot.
const AREA_DEG = 3;
// Under the tools nothing is seen, and a low map has no room to spare.
const TOOLS_PX = 62;
const LOW_PX = 160;
const PADDING_PX = 20;
const GUIDED_MS = 1000 * STALE_S;
let guidedMs = -Infinity;
const footprints = new Map();
const follow = document.getElementById("map-follow");
let isFollowing = true;
let isProgrammatic = false;
let framedKey = "";

function setFollowing(wanted) {
  framedKey = "";
  isFollowing = wanted;
  follow.setAttribute("aria-pressed", String(wanted));
}

// A map that the operator moved no longer follows the flight.
map.on("movestart", () => { if (!isProgrammatic) setFollowing(false); });
follow.addEventListener("click", () => {
  setFollowing(!isFollowing);
  frame();
});

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

const styleOfVerdict = (verdict) => ({
  color: colour(COLOURS[verdict] || "--soft"),
  dashArray: DASHES[verdict] || null,
  fillOpacity: !verdict || verdict === "lost" ? 0.03 : 0.12,
});

function styleOf(one) {
  const verdict = one.verdict || (one.step === "lost" ? "lost" : null);
  return { ...styleOfVerdict(verdict), weight: one.number === flight.brief?.last_number ? 4 : 2 };
}

const older = new OlderLayer(flight.older, styleOfVerdict).addTo(map);

// Number of exposures whose footprint is on the map.
export const footprintCount = () => footprints.size + flight.older.size;
export const footprintLayers = () => [...footprints.values()];

// Above the footprints, so that nothing covers a label.
const plan = new PlanLayer().addTo(map);
let planBounds = null;
let drawnState = "";

// Labels of the plan that are seen, by kind, and areas of gaps.
export const planShown = () => plan.shown;

// Draw a plan: lines, planned exposure positions, and retakes.
export function drawPlan(planned) {
  planBounds = planned?.lines.length ? L.latLngBounds(planned.lines.flatMap((line) => line.at)) : null;
  plan.set({ plan: planned });
  frame();
}

// Draw the lines again when their state changed.
function updateLines() {
  const state = flight.brief?.status?.lines || {};
  if (drawnState === JSON.stringify(state)) return;
  drawnState = JSON.stringify(state);
  plan.set({ state });
}

// Draw gaps of the coverage, and the line segments to re-fly for them.
export const drawGaps = (gaps) => plan.set({ gaps });

// With each record: a position gets old without a new one. Guidance is newer while it comes.
function showAircraft({ isLinked }) {
  // Without a link it stays where it was last, which guidance knew better than the status.
  if (!isLinked) {
    marker.setState("old");
    return;
  }
  const isLive = flight.brief?.phase !== "landed";
  if (isLive && performance.now() - guidedMs < GUIDED_MS) return;
  const position = flight.brief?.status?.position;
  if (position?.latitude_deg != null) {
    // An old position is no longer where the aircraft is.
    marker.show(map, [position.latitude_deg, position.longitude_deg], trackOf(position.velocity_ned_mps),
      presentPosition(flight) ? "present" : "old");
  } else marker.setState("old");
}

function drawMap(choose) {
  track.setLatLngs(flight.track.map((point) => point.at));
  for (const one of flight.exposures.values()) {
    if (!one.footprint) continue;
    let drawn = footprints.get(one.number);
    if (!drawn) {
      drawn = L.polygon(one.footprint, { interactive: true }).addTo(map);
      drawn.on("click", () => { if (!isMeasuring()) choose(one.number); });
      drawn.bindTooltip(() => label(`${one.number}: ${flight.exposures.get(one.number)?.verdict || one.step}`));
      // Footprints take no keyboard focus; the table of exposures serves the keyboard.
      drawn.getElement().setAttribute("tabindex", "-1");
      footprints.set(one.number, drawn);
    }
    const style = styleOf(one);
    const key = JSON.stringify(style);
    if (drawn.key !== key) drawn.setStyle(style);
    drawn.key = key;
  }
  older.update(document.documentElement.dataset.theme || "");
  for (const number of footprints.keys()) {
    if (!flight.exposures.has(number)) {
      footprints.get(number).remove();
      footprints.delete(number);
    }
  }
  frame();
}

// The surroundings of the plan, or without one of the newest footprint; null if there is neither.
function areaOf() {
  const newest = flight.exposures.size ? footprints.get(Math.max(...footprints.keys())) : null;
  const { lat, lng } = (planBounds ?? newest?.getBounds())?.getCenter() ?? {};
  if (lat == null) return null;
  const area = L.latLngBounds([[lat - AREA_DEG, lng - AREA_DEG], [lat + AREA_DEG, lng + AREA_DEG]]);
  return planBounds ? area.extend(planBounds) : area;
}

// What the map shows while it follows the flight: footprints, or the plan, and the aircraft.
function boundsOfFlight() {
  // Not by a group of layers: each of them would keep every group that it was in.
  const bounds = L.latLngBounds([]);
  const area = areaOf();
  const isNear = (one) => !area || area.contains(one);
  for (const one of footprints.values()) if (isNear(one.getBounds())) bounds.extend(one.getBounds());
  if (flight.older.bounds) {
    const [south, west, north, east] = flight.older.bounds;
    if (isNear([[south, west], [north, east]])) bounds.extend([[south, west], [north, east]]);
  }
  if (planBounds && (!bounds.isValid() || !planBounds.intersects(bounds))) bounds.extend(planBounds);
  if (bounds.isValid() && map.hasLayer(marker) && isNear(marker.getLatLng())) bounds.extend(marker.getLatLng());
  return bounds;
}

// Fit the map to the flight.
function frame() {
  if (!isFollowing) return;
  const bounds = boundsOfFlight();
  const isSomewhere = map.hasLayer(marker);
  // Each fit draws every path again.
  const key = bounds.isValid() ? `${bounds.toBBoxString()} ${map.getSize()}` : "";
  if (key && key === framedKey) return;
  framedKey = key;
  isProgrammatic = true;
  if (bounds.isValid()) {
    const topPx = map.getSize().y < LOW_PX ? PADDING_PX : TOOLS_PX;
    map.fitBounds(bounds, { paddingTopLeft: [PADDING_PX, topPx], paddingBottomRight: [PADDING_PX, PADDING_PX], maxZoom: 17, animate: false });
  } else if (isSomewhere) map.setView(marker.getLatLng(), 14, { animate: false });
  isProgrammatic = false;
}

export function start(_root, feed) {
  startLayers(map, feed);
  startMeasuring(map);
  startNoData(map, feed);
  onGuidance((frame) => {
    if (frame.latitude_deg == null || frame.longitude_deg == null) return;
    // Without a newer one the service sends the last frame again.
    if (!feed.isLinked || ageOf(frame) > STALE_S) return;
    guidedMs = performance.now();
    marker.show(map, [frame.latitude_deg, near(frame.longitude_deg)], frame.track_deg, frame.is_deviating ? "deviating" : "present");
  });
  feed.subscribe((record, isFirstRecord) => {
    if (!record) plan.draw();
    updateLines();
    showAircraft(feed);
    if (isFirstRecord || !record || record.exposures || record.track) drawMap(feed.select);
  });
  // A click on an older footprint; those of the newest exposures take their own.
  map.on("click", async ({ latlng }) => {
    const number = isMeasuring() ? null : flight.older.numberAt(latlng.lat, latlng.lng);
    if (number != null && await restore(number)) feed.select(number);
  });
  feed.key("f", "map.follow", () => follow.click());
  // The map, not its panel: guidance above it comes and goes.
  new ResizeObserver(() => {
    map.invalidateSize();
    frame();
  }).observe(map.getContainer());
}
