// The image at full resolution, by tiles on request, with residuals, saturation and sharpness as layers.

import { fetchJson, fetchOk } from "./http.js";
import { t } from "./i18n.js";
import { element } from "./dom.js";

const REDUCTION_ZOOM_MIN = -4;
const ZOOM_MIN = -8;
const ZOOM_MAX = 3;
const VECTOR_PX = 40;
const VECTOR_COLOURS = ["#ffe14d", "#5ce1ff", "#ff6b6b"];

// Tiles of one layer in the pixel grid of the image: row down, column right.
const ImageLayer = L.GridLayer.extend({
  initialize(number, name, options) {
    this.number = number;
    this.name = name;
    L.GridLayer.prototype.initialize.call(this, { minNativeZoom: REDUCTION_ZOOM_MIN, maxNativeZoom: 0, minZoom: ZOOM_MIN,
      maxZoom: ZOOM_MAX, updateWhenZooming: false, keepBuffer: 1, ...options });
  },
  createTile(at, done) {
    const tile = element("canvas", { width: 256, height: 256 });
    this.fill(tile, at).then(() => done(null, tile), (error) => done(error, tile));
    return tile;
  },
  async fill(tile, { x, y, z }) {
    if (x < 0 || y < 0) return;
    const of = this.options.of ? `?of=${this.options.of}` : "";
    const answer = await fetchOk(`/api/v1/images/${this.number}/${this.name}/${2 ** -z}/${x}/${y}${of}`);
    if (!answer || answer.status === 204) return;
    const picture = await createImageBitmap(await answer.blob());
    tile.getContext("2d").drawImage(picture, 0, 0);
    picture.close();
  },
});

let map = null;
let shownNumber = null;
let requestedNumber = null;
let base = null;
const overlays = new Map();
const wanted = new Set();
let layerName = null;

const box = element("div", { id: "deep", hidden: true, tabIndex: 0 });

// Residual vectors as lines, enlarged so that the 90th percentile is VECTOR_PX at the present zoom.
function vectorsLayer(residuals, width) {
  const group = L.layerGroup();
  const scale = width / residuals.width_px;
  const lengths = residuals.vectors.filter((v) => v[4] !== 2).map((v) => Math.hypot(v[2], v[3])).sort((a, b) => a - b);
  const p90 = lengths[Math.floor(lengths.length * 0.9)] || 1;
  const enlarge = VECTOR_PX / p90 / map.getZoomScale(map.getZoom(), 0);
  for (const [column, row, right, down, kind] of residuals.vectors) {
    const [x, y] = [(column + 0.5) * scale, (row + 0.5) * scale];
    L.polyline([[-y, x], [-(y + down * enlarge), x + right * enlarge]],
      { color: VECTOR_COLOURS[kind] || VECTOR_COLOURS[0], weight: 2, interactive: false }).addTo(group);
  }
  return group;
}

async function addOverlay(name, about) {
  const number = shownNumber;
  let layer = null;
  if (name === "residuals") {
    const residuals = await fetchJson(`/api/v1/exposures/${number}/residuals.json`);
    if (residuals?.vectors?.length) layer = vectorsLayer(residuals, about.layers[0].width_px);
  } else layer = new ImageLayer(number, name, { pane: "overlayPane", bounds: base.options.bounds, of: layerName });
  if (layer && number === shownNumber && wanted.has(name) && !overlays.has(name)) overlays.set(name, layer.addTo(map));
}

function drawControls(controls, about) {
  const buttons = about.layers.length > 1 ? about.layers.map(({ name }) => {
    const one = element("button", { type: "button", textContent: name, ariaPressed: String(name === layerName) });
    one.dataset.layer = name;
    one.addEventListener("click", () => { layerName = name; show(shownNumber, controls); });
    return one;
  }) : [];
  const toggles = ["residuals", ...about.derived].map((name) => {
    const one = element("button", { type: "button", textContent: t(`image.${name}`), title: t(`image.${name}_note`),
      ariaPressed: String(wanted.has(name)) });
    one.dataset.overlay = name;
    one.addEventListener("click", () => {
      if (wanted.delete(name)) {
        overlays.get(name)?.remove();
        overlays.delete(name);
      } else {
        wanted.add(name);
        addOverlay(name, about);
      }
      one.setAttribute("aria-pressed", String(wanted.has(name)));
    });
    return one;
  });
  controls.replaceChildren(...buttons, ...toggles);
}

// Remove every tile and layer, so that none of another exposure remains.
function clear() {
  base?.remove();
  base = null;
  for (const one of overlays.values()) one.remove();
  overlays.clear();
  shownNumber = null;
}

async function show(number, controls) {
  requestedNumber = number;
  const isNew = shownNumber !== number;
  if (isNew) {
    clear();
    controls.replaceChildren();
  }
  const about = await fetchJson(`/api/v1/images/${number}`);
  // Another exposure was selected, or the view was closed, before the answer came.
  if (requestedNumber !== number || box.hidden) return;
  if (!about) {
    clear();
    controls.replaceChildren(element("p", { className: "note", textContent: t("image.no_full") }));
    return;
  }
  const { width_px: width, height_px: height } = about.layers[0];
  const bounds = L.latLngBounds([[-height, 0], [0, width]]);
  if (!map) {
    map = L.map(box, { crs: L.CRS.Simple, attributionControl: false, zoomSnap: 0.5, minZoom: ZOOM_MIN, maxZoom: ZOOM_MAX });
    new ResizeObserver(() => map.invalidateSize()).observe(box);
  }
  clear();
  if (!about.layers.some((one) => one.name === layerName)) layerName = about.layers[0].name;
  shownNumber = number;
  if (isNew) map.fitBounds(bounds, { animate: false });
  base = new ImageLayer(number, layerName, { bounds }).addTo(map);
  for (const name of wanted) addOverlay(name, about);
  drawControls(controls, about);
}

export function start(root, feed) {
  const image = document.getElementById("image");
  image.after(box);
  const controls = element("div", { className: "tools", id: "deep-tools", hidden: true });
  box.after(controls);
  const toggle = element("button", { type: "button", id: "full-resolution", textContent: t("image.full"), ariaPressed: "false" });
  root.querySelector(".tools").append(toggle);
  let opened = null;
  const set = (isOn) => {
    toggle.setAttribute("aria-pressed", String(isOn));
    box.hidden = !isOn;
    controls.hidden = !isOn;
    image.hidden = isOn;
    if (isOn && feed.selected != null) {
      opened = feed.selected;
      feed.follow(false);
      show(feed.selected, controls);
    }
  };
  toggle.addEventListener("click", () => set(box.hidden));
  // Nothing of full resolution is read for the next exposure by itself.
  feed.onSelect((number) => { if (!box.hidden && number !== opened) set(false); });
  feed.subscribe((record, isFirstRecord) => {
    box.setAttribute("aria-label", t("image.full"));
    toggle.textContent = t("image.full");
    if (isFirstRecord) {
      requestedNumber = null;
      clear();
      set(false);
    }
  });
}
