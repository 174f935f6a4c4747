// The map: lines, track and footprints, coloured by verdict and marked by shape, over offline base maps.

import { flight, restore } from "./telemetry.js";
import { onGuidance } from "./guidance.js";
import { startLayers } from "./map_layers.js";
import { OlderLayer } from "./map_older.js";
import { isMeasuring, startMeasuring } from "./map_measure.js";
import { startNoData } from "./map_no_data.js";

const COLOURS = { good: "--good", usable: "--caution", refly: "--warning", lost: "--warning" };
// Of a line with more positions only the line is drawn.
const PLACES_MAX = 200;
const DASHES = { good: null, usable: "6 3", refly: "2 4", lost: "1 7" };

// Leaflet parses a string as HTML.
const label = (text) => document.createTextNode(text);

const map = L.map("map", { zoomControl: true, attributionControl: false, zoomSnap: 0.25 });
map.setView([0, 0], 2);
L.control.scale({ imperial: false }).addTo(map);
const track = L.polyline([], { color: "#777", weight: 2 }).addTo(map);
const marker = L.circleMarker([0, 0], { radius: 6, weight: 3 });
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

const plan = L.layerGroup().addTo(map);
// Planned exposure positions, thousands of them, on one canvas below the lines.
map.createPane("places").style.zIndex = 390;
map.getPane("places").style.pointerEvents = "none";
const places = L.layerGroup().addTo(map);
const placesCanvas = L.canvas({ pane: "places" });
const gaps = L.layerGroup().addTo(map);
let planBounds = null;

// Direction of a line's label: opposite to the line, so that it covers no other line.
function behind([[lat0, lon0], [lat1, lon1]]) {
  const [north, east] = [lat1 - lat0, (lon1 - lon0) * Math.cos(lat0 * Math.PI / 180)];
  if (Math.abs(north) > Math.abs(east)) return north > 0 ? "bottom" : "top";
  return east > 0 ? "left" : "right";
}

let planned = null;
let drawnState = "";
const lineState = () => JSON.stringify(flight.brief?.status?.lines || {});

// State of a line: flown, current, next, or only planned.
function styleOfLine(id) {
  const { flown = [], current, next } = flight.brief?.status?.lines || {};
  if (id === current) return { color: colour("--accent"), weight: 5, dashArray: null };
  if (id === next) return { color: colour("--accent"), weight: 4, dashArray: "14 6" };
  if (flown.includes(id)) return { color: colour("--soft"), weight: 3, dashArray: null };
  return { color: colour("--soft"), weight: 2, dashArray: "8 6" };
}

function drawRetakes(retakes) {
  for (const one of retakes) {
    L.polyline(one.at, { color: colour("--accent"), weight: 8, opacity: 0.5, interactive: false }).addTo(plan);
    L.circleMarker(one.at[0], { radius: 2, color: colour("--accent"), interactive: false })
      .bindTooltip(label(`↻ ${one.line}`), { permanent: true, direction: "left", className: "retake-label" }).addTo(plan);
  }
}

// The lines with their ids and states, and retakes.
function drawLines() {
  plan.clearLayers();
  drawnState = lineState();
  for (const line of planned?.lines || []) {
    L.polyline(line.at, { ...styleOfLine(line.id), interactive: false }).addTo(plan);
    L.circleMarker(line.at[0], { radius: 2, color: colour("--soft"), interactive: false })
      .bindTooltip(label(line.id), { permanent: true, direction: behind(line.at), className: "line-label" }).addTo(plan);
  }
  drawRetakes(planned?.retakes || []);
}

function drawPlaces() {
  places.clearLayers();
  const style = { pane: "places", renderer: placesCanvas, radius: 2, weight: 1, color: colour("--soft"), interactive: false };
  for (const { at: [[lat0, lon0], [lat1, lon1]], places_m: placesM } of planned?.lines || []) {
    if (placesM.length > PLACES_MAX) continue;
    const scale = Math.cos(lat0 * Math.PI / 180);
    const length = 111320 * Math.hypot(lat1 - lat0, (lon1 - lon0) * scale) || 1;
    for (const place of placesM) {
      const share = place / length;
      L.circleMarker([lat0 + share * (lat1 - lat0), lon0 + share * (lon1 - lon0)], style).addTo(places);
    }
  }
}

// Draw a plan: lines, planned exposure positions, and retakes.
export function drawPlan(received) {
  planned = received;
  const lines = received?.lines || [];
  planBounds = lines.length ? L.latLngBounds(lines.flatMap((line) => line.at)) : null;
  drawLines();
  drawPlaces();
}

// Redraw the lines when their state changed.
function updateLines() {
  if (planned && drawnState !== lineState()) drawLines();
}

// Ground covered by too few images, and the line segments to re-fly for it.
export function drawGaps(segments) {
  gaps.clearLayers();
  for (const one of segments) {
    if (one.kind !== "hole") continue;
    const rings = one.holes.flatMap((gap) => gap.rings).map((ring) => [ring]);
    L.polygon(rings, { color: colour("--warning"), weight: 1, fillOpacity: 0.6, className: "gap-area", interactive: false }).addTo(gaps);
    L.polyline(one.at, { color: colour("--warning"), weight: 12, opacity: 0.55, dashArray: "2 6", lineCap: "butt" })
      .bindTooltip(label(`✖ ${one.line}`),
        { permanent: true, direction: "right", className: "gap-label" }).addTo(gaps);
  }
}

function drawMap(choose) {
  track.setLatLngs(flight.track.map((point) => point.at));
  const position = flight.brief?.status?.position;
  if (position?.latitude_deg != null) {
    marker.setLatLng([position.latitude_deg, position.longitude_deg]).addTo(map);
    marker.setStyle({ color: colour("--accent") });
  }
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

// Fit the map to the footprints or the plan, and to the camera position.
function frame() {
  if (!isFollowing) return;
  // Not by a group of layers: each of them would keep every group that it was in.
  const bounds = L.latLngBounds([]);
  for (const one of footprints.values()) bounds.extend(one.getBounds());
  if (flight.older.bounds) {
    const [south, west, north, east] = flight.older.bounds;
    bounds.extend([[south, west], [north, east]]);
  }
  if (planBounds && (!bounds.isValid() || !planBounds.intersects(bounds))) bounds.extend(planBounds);
  const isSomewhere = map.hasLayer(marker);
  if (bounds.isValid() && isSomewhere) bounds.extend(marker.getLatLng());
  // Each fit draws every path again.
  const key = bounds.isValid() ? `${bounds.toBBoxString()} ${map.getSize()}` : "";
  if (key && key === framedKey) return;
  framedKey = key;
  isProgrammatic = true;
  if (bounds.isValid()) {
    map.fitBounds(bounds, { padding: [20, 20], maxZoom: 17, animate: false });
  } else if (isSomewhere) map.setView(marker.getLatLng(), 14, { animate: false });
  isProgrammatic = false;
}

export function start(root, feed) {
  startLayers(map, feed);
  startMeasuring(map);
  startNoData(map, feed);
  onGuidance((frame) => {
    if (frame.latitude_deg == null) return;
    marker.setLatLng([frame.latitude_deg, frame.longitude_deg]).addTo(map);
    marker.setStyle({ color: colour(frame.is_deviating ? "--warning" : "--accent") });
  });
  feed.subscribe((record, isFirstRecord) => {
    if (!record && planned) drawPlan(planned);
    updateLines();
    if (isFirstRecord || !record || record.exposures || record.track) drawMap(feed.select);
  });
  // A click on an older footprint; those of the newest exposures take their own.
  map.on("click", async ({ latlng }) => {
    const number = isMeasuring() ? null : flight.older.numberAt(latlng.lat, latlng.lng);
    if (number != null && await restore(number)) feed.select(number);
  });
  feed.key("f", "map.follow", () => follow.click());
  new ResizeObserver(() => {
    map.invalidateSize();
    frame();
  }).observe(root);
}
