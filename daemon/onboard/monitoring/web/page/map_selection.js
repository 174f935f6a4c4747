// The selected exposure on the map: its outline, and the gap of the coverage in it.

import { t } from "./i18n.js";
import { number as formatNumber } from "./format.js";
import { gaps } from "./plan.js";

// Whether a place lies in a ring of places; both are latitude and longitude.
function isInside([y, x], ring) {
  let inside = false;
  for (let i = 0, k = ring.length - 1; i < ring.length; k = i, i += 1) {
    const [[y0, x0], [y1, x1]] = [ring[i], ring[k]];
    if ((y0 > y) !== (y1 > y) && x < (x1 - x0) * (y - y0) / (y1 - y0) + x0) inside = !inside;
  }
  return inside;
}

const touches = (a, b) => a.some((one) => isInside(one, b)) || b.some((one) => isInside(one, a));

// The first gap whose area touches a footprint.
export function gapOf(footprint, segments) {
  return segments.find((one) => one.holes.some((hole) => hole.rings.some((ring) => touches(ring, footprint)))) || null;
}

function labelOf(one) {
  const found = gaps();
  if (!found) return t("strip.exposure", { number: one.number });
  const gap = gapOf(one.footprint, found);
  return gap ? `✖ ${t("map.gap_of", { number: one.number, line: gap.line, from: formatNumber(gap.from_m), to: formatNumber(gap.to_m) })}`
    : `● ${t("map.no_gap_of", { number: one.number })}`;
}

export function startSelection(map, feed) {
  const outline = L.layerGroup().addTo(map);
  let shown = "";
  const draw = () => {
    const one = feed.isFollowing ? null : feed.flight.exposures.get(feed.selected);
    const colour = getComputedStyle(document.documentElement).getPropertyValue("--accent").trim();
    const text = one?.footprint ? labelOf(one) : "";
    const key = `${one?.number} ${text} ${colour}`;
    if (key === shown) return;
    const isOther = shown.split(" ")[0] !== String(one?.number);
    shown = key;
    outline.clearLayers();
    if (!one?.footprint) return;
    const drawn = L.polygon(one.footprint, { color: colour, weight: 6, fill: false, interactive: false }).addTo(outline);
    // Leaflet parses a string as HTML.
    drawn.bindTooltip(document.createTextNode(text), { permanent: true, direction: "bottom", className: "selection-label" });
    // Only a new selection moves the map, and only if it is out of view.
    if (isOther && !map.getBounds().pad(-0.1).contains(drawn.getBounds())) map.panTo(drawn.getBounds().getCenter(), { animate: false });
  };
  feed.onSelect(draw);
  feed.subscribe(draw);
}
