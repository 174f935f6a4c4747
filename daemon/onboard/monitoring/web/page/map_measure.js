// Measuring on the map: length of a path of clicks, and its last bearing.

import { t } from "./i18n.js";
import { angle, distance, length } from "./format.js";
import { element } from "./dom.js";

const FAR_M = 2000;
let isOn = false;

// Whether clicks on the map measure; then they select nothing.
export const isMeasuring = () => isOn;

export function startMeasuring(map) {
  const button = element("button", { type: "button", id: "map-measure", textContent: t("map.measure"), ariaPressed: "false" });
  const result = element("output", { id: "map-measured", hidden: true });
  const path = L.polyline([], { color: "#d400aa", weight: 3, dashArray: "2 6", interactive: false });
  const dots = L.layerGroup();
  const draw = () => {
    const places = path.getLatLngs();
    let totalM = 0;
    for (let i = 1; i < places.length; i += 1) totalM += map.distance(places[i - 1], places[i]);
    const lengthText = totalM >= FAR_M ? distance(totalM, 2) : length(totalM);
    result.textContent = places.length < 2 ? t("map.measure_hint") : `${lengthText} · ${angle(bearing(places.at(-2), places.at(-1)))}`;
  };
  const set = (wanted) => {
    isOn = wanted;
    button.setAttribute("aria-pressed", String(isOn));
    result.hidden = !isOn;
    path.setLatLngs([]);
    dots.clearLayers();
    if (isOn) {
      path.addTo(map);
      dots.addTo(map);
    } else {
      path.remove();
      dots.remove();
    }
    draw();
  };
  button.addEventListener("click", () => set(!isOn));
  map.on("click", (event) => {
    if (!isOn) return;
    path.addLatLng(event.latlng);
    dots.addLayer(L.circleMarker(event.latlng, { radius: 4, color: "#d400aa", interactive: false }));
    draw();
  });
  document.getElementById("map-tools").append(button, result);
}

// Initial bearing of the great circle, in degrees.
export function bearing(from, to) {
  const rad = Math.PI / 180;
  const [a, b, d] = [from.lat * rad, to.lat * rad, (to.lng - from.lng) * rad];
  const y = Math.sin(d) * Math.cos(b);
  const x = Math.cos(a) * Math.sin(b) - Math.sin(a) * Math.cos(b) * Math.cos(d);
  return (Math.atan2(y, x) / rad + 360) % 360;
}
