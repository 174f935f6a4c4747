// Layers below and above the lines of the map: base maps of the service, hill shade, thumbnails at their place.

import { fetchOk, fetchPatiently } from "./http.js";
import { t } from "./i18n.js";
import { element } from "./dom.js";
import { drawTile } from "./mvt.js";
import { startLiveMap } from "./live_map.js";
import { startSelection } from "./map_selection.js";
import { thumbnailOf } from "./thumbnails.js";

const THUMBNAILS_MAX = 60;
const OVERZOOM = 4;
const AGAIN_MIN_MS = 1000;
const AGAIN_MAX_MS = 32000;
const isNight = () => document.documentElement.dataset.theme === "dark";

// A tile that was refused or lost with the link would stay a hole: asked for again while it is on the map.
async function fetchTile(tile, address) {
  for (let waitMs = AGAIN_MIN_MS; ; waitMs = Math.min(2 * waitMs, AGAIN_MAX_MS)) {
    const answer = await fetchOk(address);
    if (answer || !tile.isConnected) return answer;
    await new Promise((resolve) => setTimeout(resolve, waitMs));
  }
}

// Tiles of the service: pictures, or vector tiles drawn here. Fetched, since a picture's address carries no token.
const ServiceTiles = L.GridLayer.extend({
  initialize(about, options) {
    this.about = about;
    // Vector tiles have a style of the night of their own; pictures are dimmed then.
    if (about.kind !== "vector") options.className = "raster";
    L.GridLayer.prototype.initialize.call(this, options);
  },
  createTile(at, done) {
    const size = this.getTileSize();
    const tile = element("canvas", { width: size.x, height: size.y });
    tile.dataset.map = this.about.id;
    this.fill(tile, at).then(() => done(null, tile), (error) => done(error, tile));
    return tile;
  },
  async fill(tile, at) {
    // The name keeps tiles of another map with the same number apart in the browser's cache.
    const query = `?name=${encodeURIComponent(this.about.name)}`;
    const answer = await fetchTile(tile, `/api/v1/maps/${this.about.id}/${at.z}/${at.x}/${at.y}${query}`);
    const isEmpty = !answer || answer.status === 204;
    if (this.about.kind === "vector") {
      drawTile(tile, isEmpty ? null : new Uint8Array(await answer.arrayBuffer()), isNight());
    } else if (!isEmpty) {
      const picture = await createImageBitmap(await answer.blob());
      tile.getContext("2d").drawImage(picture, 0, 0, tile.width, tile.height);
      picture.close();
    }
  },
});

// A picture whose corners lie on four places: an affine transformation of an <img>.
const PlacedPicture = L.Layer.extend({
  initialize(corners, address) {
    this.corners = corners;
    this.address = address;
  },
  onAdd(map) {
    this.picture = element("img", { className: "placed leaflet-zoom-hide", alt: "", src: this.address });
    this.picture.onload = () => this.place();
    map.getPane("thumbnails").append(this.picture);
    this.place();
  },
  onRemove() {
    this.picture.remove();
  },
  getEvents() {
    return { zoomend: this.place, viewreset: this.place };
  },
  place() {
    const { naturalWidth: w, naturalHeight: h } = this.picture;
    if (!w || !this._map) return;
    const [lowerLeft, , upperRight, upperLeft] = this.corners.map((one) => this._map.latLngToLayerPoint(one));
    const right = upperRight.subtract(upperLeft).divideBy(w);
    const down = lowerLeft.subtract(upperLeft).divideBy(h);
    this.picture.style.transform =
      `matrix(${right.x}, ${right.y}, ${down.x}, ${down.y}, ${upperLeft.x}, ${upperLeft.y})`;
  },
});

let shown = null;
let shade = null;
let listed = [];

function pick(map, about) {
  shown?.remove();
  shown = null;
  if (about) {
    const bounds = L.latLngBounds([[about.bounds[1], about.bounds[0]], [about.bounds[3], about.bounds[2]]]);
    shown = new ServiceTiles(about, { pane: "ground", bounds, minNativeZoom: about.min_zoom, maxNativeZoom: about.max_zoom,
      maxZoom: about.max_zoom + OVERZOOM + 8, attribution: "" }).addTo(map);
  }
  localStorage.setItem("map", about ? about.name : "");
  document.getElementById("map-attribution").textContent = about?.attribution.replace(/<[^>]*>/g, "") || "";
}

function drawChoices(map, tools) {
  const maps = listed.filter((one) => !one.is_overlay);
  const relief = listed.find((one) => one.is_overlay);
  if (maps.length) {
    const choice = element("select", { id: "map-choice", ariaLabel: t("map.base") },
      new Option(t("map.no_base"), ""), ...maps.map((one) => new Option(one.name, one.id)));
    choice.addEventListener("change", () => pick(map, maps.find((one) => String(one.id) === choice.value)));
    tools.append(choice);
    const stored = localStorage.getItem("map");
    const first = stored === "" ? null : maps.find((one) => one.name === stored) || maps[0];
    choice.value = first ? String(first.id) : "";
    pick(map, first);
  }
  if (relief) {
    const button = element("button", { type: "button", id: "map-relief", textContent: t("map.relief"), ariaPressed: "false" });
    button.addEventListener("click", () => {
      const wanted = !shade;
      shade?.remove();
      shade = wanted ? new ServiceTiles(relief, { pane: "relief", minNativeZoom: relief.min_zoom,
        maxNativeZoom: relief.max_zoom, maxZoom: relief.max_zoom + OVERZOOM + 8 }).addTo(map) : null;
      button.setAttribute("aria-pressed", String(wanted));
    });
    tools.append(button);
  }
}

const placed = new Map();
let areThumbnailsShown = localStorage.getItem("thumbnails") !== "off";

// A fetch that is pending holds the number of its exposure, and nothing else.
async function place(map, exposures, number) {
  const address = await thumbnailOf(number);
  const { footprint } = exposures.get(number) ?? {};
  if (!placed.has(number) || placed.get(number)) return;
  if (address && footprint) placed.set(number, new PlacedPicture(footprint, address).addTo(map));
  else placed.delete(number);
}

function placeThumbnails(map, { exposures }) {
  const newest = areThumbnailsShown ? [...exposures.values()].filter((one) => one.step === "processed" && one.footprint)
    .map((one) => one.number).sort((a, b) => b - a).slice(0, THUMBNAILS_MAX) : [];
  const wanted = new Set(newest);
  for (const [number, layer] of placed) {
    if (!wanted.has(number)) {
      layer?.remove();
      placed.delete(number);
    }
  }
  for (const number of newest) {
    if (placed.has(number)) continue;
    placed.set(number, null);
    place(map, exposures, number);
  }
}

export function startLayers(map, feed) {
  const tools = document.getElementById("map-tools");
  startSelection(map, feed);
  for (const [name, order] of [["ground", 150], ["relief", 180], ["thumbnails", 350]]) {
    map.createPane(name).style.zIndex = order;
    map.getPane(name).style.pointerEvents = "none";
  }
  document.getElementById("map").append(element("p", { id: "map-attribution" }));
  const button = element("button", { type: "button", id: "map-thumbnails", textContent: t("map.thumbnails"),
    ariaPressed: String(areThumbnailsShown) });
  button.addEventListener("click", () => {
    areThumbnailsShown = !areThumbnailsShown;
    localStorage.setItem("thumbnails", areThumbnailsShown ? "on" : "off");
    button.setAttribute("aria-pressed", String(areThumbnailsShown));
    placeThumbnails(map, feed.flight);
  });
  tools.append(button);
  startLiveMap(map, feed, tools);
  // On a phone the tools cover the map only while they are wanted.
  const more = document.getElementById("map-more");
  more.addEventListener("click", () => more.setAttribute("aria-expanded", String(tools.classList.toggle("opened"))));
  let isNightShown = isNight();
  let isAsked = false;
  feed.subscribe(async (record, isFirstRecord) => {
    if (record?.exposures || isFirstRecord) {
      if (isFirstRecord) for (const number of placed.keys()) { placed.get(number)?.remove(); placed.delete(number); }
      placeThumbnails(map, feed.flight);
    }
    if (isNightShown !== isNight()) {
      isNightShown = isNight();
      // Pictures are dimmed as they are: without a link they could not be fetched again.
      if (shown?.about.kind === "vector") shown.redraw();
    }
    if (isAsked) return;
    isAsked = true;
    listed = await fetchPatiently("/api/v1/maps");
    drawChoices(map, tools);
  });
}
