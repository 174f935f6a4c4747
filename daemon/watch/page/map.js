// The map: track and footprints, coloured by verdict and marked by shape. No tiles: it works offline.

import { flight } from "./state.js";

const COLOURS = { good: "--good", usable: "--caution", refly: "--warning", lost: "--warning" };
const DASHES = { good: null, usable: "6 3", refly: "2 4", lost: "2 4" };

const map = L.map("map", { zoomControl: true, attributionControl: false, zoomSnap: 0.25 });
map.setView([0, 0], 2);
L.control.scale({ imperial: false }).addTo(map);
const track = L.polyline([], { color: "#777", weight: 2 }).addTo(map);
const here = L.circleMarker([0, 0], { radius: 6, weight: 3 });
const footprints = new Map();
let framed = false;

map.on("dragstart", () => { framed = true; });

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

function style(one) {
  const verdict = one.verdict || (one.step === "lost" ? "lost" : null);
  return {
    color: colour(COLOURS[verdict] || "--soft"),
    dashArray: DASHES[verdict] || null,
    weight: one.number === flight.brief?.last_number ? 4 : 2,
    fillOpacity: verdict ? 0.12 : 0.03,
  };
}

export function drawMap(choose) {
  track.setLatLngs(flight.track.map((point) => point.at));
  const position = flight.brief?.status?.position;
  if (position) {
    here.setLatLng([position.latitude_deg, position.longitude_deg]).addTo(map);
    here.setStyle({ color: colour("--accent") });
  }
  for (const one of flight.exposures.values()) {
    if (!one.footprint) continue;
    let drawn = footprints.get(one.number);
    if (!drawn) {
      drawn = L.polygon(one.footprint, { interactive: true }).addTo(map);
      drawn.on("click", () => choose(one.number));
      footprints.set(one.number, drawn);
    }
    drawn.setStyle(style(one));
    const word = one.verdict || one.step;
    drawn.bindTooltip(`${one.number}: ${word}`);
  }
  for (const number of footprints.keys()) {
    if (!flight.exposures.has(number)) {
      footprints.get(number).remove();
      footprints.delete(number);
    }
  }
  if (!framed) {
    const bounds = L.featureGroup([...footprints.values()]).getBounds();
    if (bounds.isValid()) map.fitBounds(bounds, { padding: [20, 20], maxZoom: 17 });
    else if (position) map.setView(here.getLatLng(), 14);
  }
}
