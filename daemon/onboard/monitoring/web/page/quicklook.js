// The quick look: zoom, pan, histogram, residual vectors.

import { fetchOk, fetchJson } from "./http.js";
import { flight } from "./telemetry.js";
import { t } from "./i18n.js";
import { isSlow, thumbnailOf } from "./thumbnails.js";
import { drawHistogram, drawVectors, clearHistogram, listOverlaps } from "./residuals.js";

const viewport = document.getElementById("image");
const image = document.getElementById("quicklook");
const placeholder = document.getElementById("no-image");
const canvas = document.getElementById("histogram");
const numberLabel = document.getElementById("image-which");
const figuresList = document.getElementById("about-image");
const residuals = document.getElementById("show-residuals");
const vectorsNote = document.getElementById("vectors-note");
const drawing = document.getElementById("vectors");
const RETRY_MS = 5000;
const view = { scale: 1, x: 0, y: 0 };
let shownAddress = null;
let ownAddress = null;

function place() {
  image.style.transform = `translate(${view.x}px, ${view.y}px) scale(${view.scale})`;
  drawing.style.transform = image.style.transform;
}

function fit() {
  if (!image.naturalWidth || !viewport.clientWidth) return;
  view.scale = Math.min(viewport.clientWidth / image.naturalWidth, viewport.clientHeight / image.naturalHeight);
  view.x = (viewport.clientWidth - image.naturalWidth * view.scale) / 2;
  view.y = (viewport.clientHeight - image.naturalHeight * view.scale) / 2;
  place();
}

function zoom(factor, x = viewport.clientWidth / 2, y = viewport.clientHeight / 2) {
  const scale = Math.min(Math.max(view.scale * factor, 0.02), 32);
  view.x = x - (x - view.x) * (scale / view.scale);
  view.y = y - (y - view.y) * (scale / view.scale);
  view.scale = scale;
  place();
}

function quicklookHistogram() {
  const sample = document.createElement("canvas");
  sample.width = Math.min(image.naturalWidth, 512);
  sample.height = Math.max(1, Math.round(sample.width * image.naturalHeight / image.naturalWidth));
  const pen = sample.getContext("2d", { willReadFrequently: true });
  pen.drawImage(image, 0, 0, sample.width, sample.height);
  const pixels = pen.getImageData(0, 0, sample.width, sample.height).data;
  const counts = [0, 1, 2].map(() => new Float64Array(256));
  for (let i = 0; i < pixels.length; i += 4) {
    for (let band = 0; band < 3; band += 1) counts[band][pixels[i + band]] += 1;
  }
  const draw = canvas.getContext("2d");
  clearHistogram(canvas);
  canvas.setAttribute("aria-label", "Histogram of the quick look");
  const maximum = Math.max(...counts.flatMap((one) => [...one.slice(1, 255)]), 1);
  ["#d33", "#2a2", "#35e"].forEach((colour, band) => {
    draw.strokeStyle = colour;
    draw.beginPath();
    counts[band].forEach((count, value) => {
      draw.lineTo(value * 2, canvas.height * (1 - Math.sqrt(Math.min(count / maximum, 1))));
    });
    draw.stroke();
  });
}

function share(value) {
  return value == null ? null : `${(100 * value).toFixed(0)} %`;
}

function showFigures(one) {
  figuresList.replaceChildren();
  const figures = one.figures || {};
  const lines = {
    "tie points": figures.tie_points_pp === undefined ? null : `${figures.tie_points_pp} + ${figures.tie_points_pc ?? 0}`,
    "σ0": figures.sigma0_px == null ? null : `${figures.sigma0_px.toFixed(3)} px`,
    "accuracy": figures.stitched_sigma_px == null ? null : `${figures.stitched_sigma_px.toFixed(3)} px`,
    "displaced": figures.displaced_sensor,
    "saturated": figures.saturated_fraction == null ? null : `${(100 * figures.saturated_fraction).toFixed(2)} %`,
    "tilt": figures.tilt_deg == null ? null : `${figures.tilt_deg.toFixed(1)}°`,
    "overlap": share(figures.forward_overlap),
    "sidelap": share(figures.sidelap),
    "crab": figures.crab_deg == null ? null : `${figures.crab_deg.toFixed(1)}°`,
    "sun": figures.sun_deg == null ? null : `${figures.sun_deg.toFixed(0)}°`,
    "GSD": figures.gsd_m == null ? null : `${(100 * figures.gsd_m).toFixed(1)} cm`,
    "pipeline": one.duration_s == null ? null : `${one.duration_s.toFixed(2)} s`,
  };
  for (const [name, value] of Object.entries(lines)) {
    if (value == null) continue;
    const line = document.createElement("div");
    const term = document.createElement("dt");
    const definition = document.createElement("dd");
    term.textContent = name;
    definition.textContent = value;
    line.append(term, definition);
    figuresList.append(line);
  }
}

// On a slow link nothing is fetched while the image is not seen, and only the thumbnail until an exposure is selected.
async function showImage(number, isFollowing = false) {
  const one = flight.exposures.get(number);
  if (!one) return;
  showFigures(one);
  numberLabel.textContent = `${number}`;
  if (one.step !== "processed") {
    showPlaceholder(`exposure ${number}: ${one.step === "lost" ? "lost, no image" : `${one.step}, no image yet`}`);
    return;
  }
  if (!viewport.clientWidth && isFollowing && isSlow()) return;
  drawing.toggleAttribute("hidden", residuals.getAttribute("aria-pressed") !== "true");
  vectorsNote.hidden = drawing.hasAttribute("hidden");
  const address = `/api/v1/exposures/${number}/quicklook.jpg`;
  if (shownAddress === address || (isFollowing && shownAddress === `thumbnail ${number}`)) return;
  shownAddress = address;
  const refit = image.hidden;
  const products = isFollowing && isSlow() ? Promise.resolve([null, null])
    : Promise.all(["histogram.json", "residuals.json"].map((name) => fetchJson(`/api/v1/exposures/${number}/${name}`)));
  image.onload = async () => {
    image.hidden = false;
    placeholder.hidden = true;
    if (refit) fit();
    const [raw, vectors] = await products;
    if (shownAddress !== address && shownAddress !== `thumbnail ${number}`) return;
    if (raw) drawHistogram(canvas, raw);
    else quicklookHistogram();
    drawVectors(drawing, vectors, image.naturalWidth, image.naturalHeight);
    listOverlaps(vectors, number);
    place();
  };
  image.onerror = () => showPlaceholder(`exposure ${number}: the quick look cannot be read`);
  image.alt = `Quick look of exposure ${number}, verdict ${one.verdict}`;
  if (isFollowing && isSlow()) {
    const thumbnail = await thumbnailOf(number);
    if (shownAddress !== address) return;
    shownAddress = `thumbnail ${number}`;
    if (thumbnail) image.src = thumbnail;
    return;
  }
  const picture = await (await fetchOk(address))?.blob();
  if (shownAddress !== address) return;
  if (!picture) {
    showPlaceholder(`exposure ${number}: no quick look`);
    // Retry after RETRY_MS, not with every telemetry record.
    shownAddress = address;
    setTimeout(() => { if (shownAddress === address) shownAddress = null; }, RETRY_MS);
    return;
  }
  if (ownAddress) URL.revokeObjectURL(ownAddress);
  image.src = ownAddress = URL.createObjectURL(picture);
}

function clearImage() {
  showPlaceholder("no image yet");
  numberLabel.textContent = "";
  figuresList.replaceChildren();
}

// Show a placeholder instead of the image of another exposure.
function showPlaceholder(why) {
  shownAddress = null;
  image.hidden = true;
  placeholder.hidden = false;
  placeholder.textContent = why;
  drawVectors(drawing, null);
  vectorsNote.hidden = true;
  clearHistogram(canvas);
  listOverlaps(null, null);
}

function prepareImage(redraw) {
  document.getElementById("zoom-in").addEventListener("click", () => zoom(1.5));
  document.getElementById("zoom-out").addEventListener("click", () => zoom(1 / 1.5));
  document.getElementById("zoom-fit").addEventListener("click", fit);
  residuals.addEventListener("click", () => {
    const pressed = residuals.getAttribute("aria-pressed") === "true";
    residuals.setAttribute("aria-pressed", String(!pressed));
    redraw();
  });
  viewport.addEventListener("wheel", (event) => {
    event.preventDefault();
    const box = viewport.getBoundingClientRect();
    zoom(event.deltaY < 0 ? 1.2 : 1 / 1.2, event.clientX - box.left, event.clientY - box.top);
  }, { passive: false });
  viewport.addEventListener("keydown", (event) => {
    const moves = { ArrowLeft: [40, 0], ArrowRight: [-40, 0], ArrowUp: [0, 40], ArrowDown: [0, -40] };
    if (event.key in moves) {
      view.x += moves[event.key][0];
      view.y += moves[event.key][1];
      place();
    } else if (event.key === "+") zoom(1.5);
    else if (event.key === "-") zoom(1 / 1.5);
    else if (event.key === "0") fit();
    else return;
    event.preventDefault();
  });
  // One finger pans. Two fingers zoom about their midpoint.
  const fingers = new Map();
  const pinchState = () => {
    const at = [...fingers.values()];
    const middle = [0, 1].map((k) => at.reduce((sum, one) => sum + one[k], 0) / at.length);
    return [...middle, at.length > 1 ? Math.hypot(at[0][0] - at[1][0], at[0][1] - at[1][1]) : 0];
  };
  viewport.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    viewport.setPointerCapture(event.pointerId);
  });
  viewport.addEventListener("pointermove", (event) => {
    if (!fingers.has(event.pointerId)) return;
    const [x0, y0, spread0Px] = pinchState();
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    const [x, y, spreadPx] = pinchState();
    view.x += x - x0;
    view.y += y - y0;
    const box = viewport.getBoundingClientRect();
    zoom(spread0Px && spreadPx ? spreadPx / spread0Px : 1, x - box.left, y - box.top);
  });
  for (const end of ["pointerup", "pointercancel"]) {
    viewport.addEventListener(end, (event) => fingers.delete(event.pointerId));
  }
  new ResizeObserver(fit).observe(viewport);
}

export function start(_root, feed) {
  const follow = document.getElementById("follow");
  const draw = () => feed.selected == null ? clearImage() : showImage(feed.selected, feed.isFollowing);
  prepareImage(draw);
  follow.addEventListener("click", () => feed.follow(!feed.isFollowing));
  feed.subscribe((record) => { if (record && feed.selected != null) showImage(feed.selected, feed.isFollowing); });
  new ResizeObserver(() => { if (viewport.clientWidth) draw(); }).observe(viewport);
  feed.onSelect(() => {
    follow.setAttribute("aria-pressed", String(feed.isFollowing));
    draw();
  });
}
