// The map: track and footprints, coloured by verdict and marked by shape. No tiles: it works offline.

import { flight } from "./state.js";

const COLOURS = { good: "--good", usable: "--caution", refly: "--warning", lost: "--warning" };
const DASHES = { good: null, usable: "6 3", refly: "2 4", lost: "1 7" };

// A string would be taken for HTML.
const label = (words) => document.createTextNode(words);

const map = L.map("map", { zoomControl: true, attributionControl: false, zoomSnap: 0.25 });
map.setView([0, 0], 2);
L.control.scale({ imperial: false }).addTo(map);
const track = L.polyline([], { color: "#777", weight: 2 }).addTo(map);
const here = L.circleMarker([0, 0], { radius: 6, weight: 3 });
const footprints = new Map();
const follow = document.getElementById("map-follow");
let follows = true;
let isOurs = false;

function setFollows(wanted) {
  follows = wanted;
  follow.setAttribute("aria-pressed", String(wanted));
}

// Whoever moves the map, by finger, wheel, button or key, keeps it where it is put.
map.on("movestart", () => { if (!isOurs) setFollows(false); });
follow.addEventListener("click", () => {
  setFollows(!follows);
  frame();
});

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

function style(one) {
  const verdict = one.verdict || (one.step === "lost" ? "lost" : null);
  return {
    color: colour(COLOURS[verdict] || "--soft"),
    dashArray: DASHES[verdict] || null,
    weight: one.number === flight.brief?.last_number ? 4 : 2,
    fillOpacity: !verdict || verdict === "lost" ? 0.03 : 0.12,
  };
}

const plan = L.layerGroup().addTo(map);
const holes = L.layerGroup().addTo(map);
let planned = null;

// Where a line's id stands beside no other line: away from where it leads.
function behind([[lat0, lon0], [lat1, lon1]]) {
  const [north, east] = [lat1 - lat0, (lon1 - lon0) * Math.cos(lat0 * Math.PI / 180)];
  if (Math.abs(north) > Math.abs(east)) return north > 0 ? "bottom" : "top";
  return east > 0 ? "left" : "right";
}

// The planned lines with their ids, and where exposures are due.
export function drawPlan(told) {
  plan.clearLayers();
  planned = null;
  const lines = told?.lines || [];
  if (!lines.length) return;
  planned = L.latLngBounds(lines.flatMap((line) => line.at));
  for (const line of lines) {
    L.polyline(line.at, { color: colour("--soft"), weight: 2, dashArray: "8 6", interactive: false }).addTo(plan);
    L.circleMarker(line.at[0], { radius: 2, color: colour("--soft"), interactive: false })
      .bindTooltip(label(line.id), { permanent: true, direction: behind(line.at), className: "line-label" }).addTo(plan);
    if (line.places_m.length > 200) continue;
    const [[lat0, lon0], [lat1, lon1]] = line.at;
    const scale = Math.cos(lat0 * Math.PI / 180);
    const length = 111320 * Math.hypot(lat1 - lat0, (lon1 - lon0) * scale) || 1;
    for (const place of line.places_m) {
      const share = place / length;
      L.circleMarker([lat0 + share * (lat1 - lat0), lon0 + share * (lon1 - lon0)],
        { radius: 2, weight: 1, color: colour("--soft"), interactive: false }).addTo(plan);
    }
  }
}

// The ground that too few images see, and the parts of lines to be flown again for it.
export function drawHoles(segments) {
  holes.clearLayers();
  for (const one of segments) {
    if (one.kind !== "hole") continue;
    for (const ring of one.holes.flatMap((hole) => hole.rings)) {
      L.polygon(ring, { color: colour("--warning"), weight: 1, fillOpacity: 0.6, className: "hole-area", interactive: false })
        .addTo(holes);
    }
    L.polyline(one.at, { color: colour("--warning"), weight: 12, opacity: 0.55, dashArray: "2 6", lineCap: "butt" })
      .bindTooltip(label(`✖ ${one.line}`),
        { permanent: true, direction: "right", className: "hole-label" }).addTo(holes);
  }
}

export function drawMap(choose) {
  track.setLatLngs(flight.track.map((point) => point.at));
  const position = flight.brief?.status?.position;
  if (position?.latitude_deg != null) {
    here.setLatLng([position.latitude_deg, position.longitude_deg]).addTo(map);
    here.setStyle({ color: colour("--accent") });
  }
  for (const one of flight.exposures.values()) {
    if (!one.footprint) continue;
    let drawn = footprints.get(one.number);
    if (!drawn) {
      drawn = L.polygon(one.footprint, { interactive: true }).addTo(map);
      drawn.on("click", () => choose(one.number));
      drawn.bindTooltip(() => label(`${one.number}: ${flight.exposures.get(one.number)?.verdict || one.step}`));
      // By keyboard the table of exposures does the same; nobody steps through a thousand footprints.
      drawn.getElement().setAttribute("tabindex", "-1");
      footprints.set(one.number, drawn);
    }
    const looks = style(one);
    const told = JSON.stringify(looks);
    if (drawn.told !== told) drawn.setStyle(looks);
    drawn.told = told;
  }
  for (const number of footprints.keys()) {
    if (!flight.exposures.has(number)) {
      footprints.get(number).remove();
      footprints.delete(number);
    }
  }
  frame();
}

// Where the camera is, with what was exposed, or what is planned.
function frame() {
  if (!follows) return;
  const bounds = L.featureGroup([...footprints.values()]).getBounds();
  if (planned && (!bounds.isValid() || !planned.intersects(bounds))) bounds.extend(planned);
  const isSomewhere = map.hasLayer(here);
  isOurs = true;
  if (bounds.isValid()) {
    if (isSomewhere) bounds.extend(here.getLatLng());
    map.fitBounds(bounds, { padding: [20, 20], maxZoom: 17, animate: false });
  } else if (isSomewhere) map.setView(here.getLatLng(), 14, { animate: false });
  isOurs = false;
}
