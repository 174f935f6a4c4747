// The mark of the aircraft on the map: an arrow along its track, a circle while that is unknown.

const SIZE_PX = 34;
const SLOW_MPS = 3;

// Track over ground in degrees, from a velocity north, east, down; null if that has no direction.
export function trackOf(velocity) {
  const [north, east] = velocity ?? [];
  if (!Number.isFinite(north) || !Number.isFinite(east) || Math.hypot(north, east) < SLOW_MPS) return null;
  return (Math.atan2(east, north) * 180 / Math.PI + 360) % 360;
}

function shape(name, attributes) {
  const created = L.SVG.create(name);
  for (const [key, value] of Object.entries(attributes)) created.setAttribute(key, value);
  return created;
}

// A marker with `show(map, place, trackDeg, state)` and `setState(state)`; the state is "present", "old" or "deviating".
export function aircraftMark() {
  const drawing = shape("svg", { viewBox: "-17 -17 34 34", width: SIZE_PX, height: SIZE_PX, "aria-hidden": "true" });
  const arrow = shape("path", { d: "M0,-14L10,12L0,6L-10,12Z" });
  const circle = shape("circle", { r: 7 });
  drawing.append(arrow, circle);
  const icon = L.divIcon({ html: drawing, className: "aircraft-mark", iconSize: [SIZE_PX, SIZE_PX] });
  const marker = L.marker([0, 0], { icon, interactive: false, keyboard: false });
  marker.show = (map, place, trackDeg, state) => {
    marker.setLatLng(place).addTo(map);
    const hasTrack = Number.isFinite(trackDeg);
    arrow.style.display = hasTrack ? "" : "none";
    circle.style.display = hasTrack ? "none" : "";
    if (hasTrack) arrow.setAttribute("transform", `rotate(${trackDeg})`);
    marker.setState(state);
  };
  marker.setState = (state) => drawing.setAttribute("class", state);
  return marker;
}
