// The preliminary orthomosaic: layers of the map that grow in flight, a coarse one below a fine one.

import { fetchJson, fetchOk } from "./http.js";
import { t } from "./i18n.js";
import { length, number } from "./format.js";
import { element } from "./dom.js";

const COARSER = 2;
const OVERZOOM = 6;
const AT_ONCE = 4;

const address = ({ z, x, y }) => `/api/v1/orthomosaic/${z}/${x}/${y}`;

const waiting = [];
let running = 0;

// Fetches run a few at a time, coarse tiles first: the link is shared with telemetry.
function fetchInTurn(at) {
  return new Promise((resolve) => {
    waiting.push({ at, resolve });
    waiting.sort((a, b) => a.at.z - b.at.z);
    next();
  });
}

async function next() {
  if (running >= AT_ONCE || !waiting.length) return;
  running += 1;
  const { at, resolve } = waiting.shift();
  resolve(await fetchOk(address(at)));
  running -= 1;
  next();
}

const LiveTiles = L.GridLayer.extend({
  createTile(at, done) {
    const size = this.getTileSize();
    const tile = element("canvas", { width: size.x, height: size.y });
    this.fill(tile, at).then(() => done(null, tile), (error) => done(error, tile));
    return tile;
  },
  async fill(tile, at) {
    const answer = await fetchInTurn(at);
    if (!answer || answer.status === 204) return;
    const picture = await createImageBitmap(await answer.blob());
    const context = tile.getContext("2d");
    context.clearRect(0, 0, tile.width, tile.height);
    context.drawImage(picture, 0, 0, tile.width, tile.height);
    picture.close();
    tile.dataset.filled = "";
  },
  // Draw a tile again, if it is seen. One that waits already will be drawn as it is then.
  renew(z, x, y) {
    const shown = Object.values(this._tiles).find(({ coords }) => coords.z === z && coords.x === x && coords.y === y);
    if (shown && !waiting.some(({ at }) => at === shown.coords)) this.fill(shown.el, shown.coords);
  },
});

const shown = { about: null, mission: null, version: 0, layers: [], isWanted: localStorage.getItem("orthomosaic") !== "off" };

function removeLayers() {
  for (const layer of shown.layers) layer.remove();
  shown.layers = [];
}

function addLayers(map) {
  const { zoom, min_zoom: lowest } = shown.about;
  const coarse = Math.max(zoom - COARSER, lowest);
  const options = { pane: "orthomosaic", maxZoom: zoom + OVERZOOM };
  shown.layers = [
    new LiveTiles({ ...options, minNativeZoom: lowest, maxNativeZoom: coarse, zIndex: 1 }),
    new LiveTiles({ ...options, minZoom: coarse + 1, minNativeZoom: lowest, maxNativeZoom: zoom, zIndex: 2 }),
  ];
  for (const layer of shown.layers) layer.addTo(map);
}

function groundText({ kind, source, height_m: heightM }) {
  if (kind === "height model") return t("orthomosaic.model");
  return t(source === "plan" ? "orthomosaic.plane_of_plan" : "orthomosaic.plane", { height: length(heightM) });
}

// What the map is, and what is not in it.
function describe(note) {
  const { about } = shown;
  note.hidden = !about || !shown.isWanted;
  if (note.hidden) return;
  note.textContent = [
    `▲ ${t("orthomosaic.preliminary")}`, `GSD ${length(about.gsd_m, 2)}`, groundText(about.ground),
    t("orthomosaic.images", { n: about.images, count: number(about.images) }),
    about.measured_only ? t("orthomosaic.measured", { n: about.measured_only, count: number(about.measured_only) }) : "",
    about.not_placed ? t("orthomosaic.absent", { n: about.not_placed, count: number(about.not_placed) }) : "",
    about.pending ? t("orthomosaic.pending", { n: about.pending, count: number(about.pending) }) : "",
  ].filter(Boolean).join(" · ");
}

async function update(map, { mission, orthomosaic: version }, note, button) {
  if (mission?.id !== shown.mission) {
    removeLayers();
    Object.assign(shown, { about: null, mission: mission?.id, version: 0 });
  }
  if (!version || version === shown.version) return;
  const after = shown.version;
  shown.version = version;
  const found = await fetchJson(`/api/v1/orthomosaic?after=${after}`);
  if (!found?.zoom || mission?.id !== shown.mission) {
    shown.version = after;
    return;
  }
  const isOther = shown.about?.zoom !== found.zoom;
  shown.about = found;
  button.hidden = false;
  describe(note);
  if (!shown.isWanted) return;
  if (isOther || !shown.layers.length) {
    removeLayers();
    addLayers(map);
  } else if (found.is_cut) for (const layer of shown.layers) layer.redraw();
  else for (const [z, x, y] of found.tiles) for (const layer of shown.layers) layer.renew(z, x, y);
}

export function startLiveMap(map, feed, tools) {
  // Above the thumbnails: it shows the same ground, levelled and in its place.
  map.createPane("orthomosaic").style.zIndex = 360;
  map.getPane("orthomosaic").style.pointerEvents = "none";
  const note = element("p", { id: "map-orthomosaic-note", hidden: true });
  note.setAttribute("role", "note");
  document.getElementById("map").append(note);
  const button = element("button", { type: "button", id: "map-orthomosaic", textContent: t("orthomosaic.layer"),
    ariaPressed: String(shown.isWanted), hidden: true });
  button.addEventListener("click", () => {
    shown.isWanted = !shown.isWanted;
    localStorage.setItem("orthomosaic", shown.isWanted ? "on" : "off");
    button.setAttribute("aria-pressed", String(shown.isWanted));
    removeLayers();
    if (shown.isWanted && shown.about) addLayers(map);
    describe(note);
  });
  tools.append(button);
  feed.subscribe((record) => {
    if (record) update(map, feed.flight.brief, note, button);
    else describe(note);
  });
}
