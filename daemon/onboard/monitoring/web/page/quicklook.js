// The quick look: zoom, pan, histogram, residual vectors.

import { fetchOk, fetchJson } from "./http.js";
import { flight } from "./telemetry.js";
import { t } from "./i18n.js";
import { angle, number as formatNumber, percent } from "./format.js";
import { element } from "./dom.js";
import { verdictText } from "./verdict.js";
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
const LOAD_TIMEOUT_MS = 30000;
const view = { scale: 1, x: 0, y: 0 };
let shownAddress = null;
let ownAddress = null;
// Ends the loading of an image; null if none is loaded.
let loading = null;

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
  canvas.setAttribute("aria-label", t("image.histogram_quicklook"));
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

// Figures of the exposure; those of the stitching are on the page for experts.
function showFigures(one) {
  const f = one.figures || {};
  const listed = [
    ["expert.saturated", f.saturated_fraction, (value) => percent(value, 2)],
    ["expert.tilt", f.tilt_deg, (value) => angle(value, 1)],
    ["expert.overlap", f.forward_overlap, percent],
    ["image.sidelap", f.sidelap, percent],
    ["expert.crab", f.crab_deg, (value) => angle(value, 1)],
    ["expert.sun", f.sun_deg, angle],
    ["expert.gsd", f.gsd_m, (value) => `${formatNumber(100 * value, 1)} cm`],
    ["image.pipeline", one.duration_s, (value) => `${formatNumber(value, 2)} s`],
  ];
  figuresList.replaceChildren(...listed.filter(([, value]) => value != null).map(([code, value, shown]) =>
    element("div", {}, element("dt", { textContent: t(code) }), element("dd", { textContent: shown(value) }))));
}

// On a slow link nothing is fetched while the image is not seen, and only the thumbnail until an exposure is selected.
async function showImage(number, isFollowing = false) {
  const one = flight.exposures.get(number);
  if (!one) return;
  showFigures(one);
  numberLabel.textContent = `${number}`;
  if (one.step !== "processed") {
    showPlaceholder(one.step === "lost" ? t("image.lost", { number }) : t("image.waiting", { number, step: verdictText(one.step) }));
    return;
  }
  if (!viewport.clientWidth && isFollowing && isSlow()) return;
  drawing.toggleAttribute("hidden", residuals.getAttribute("aria-pressed") !== "true");
  vectorsNote.hidden = drawing.hasAttribute("hidden");
  const address = `/api/v1/exposures/${number}/quicklook.jpg`;
  if (shownAddress === address || (isFollowing && shownAddress === `thumbnail ${number}`)) return;
  // What is seen is of another exposure until this one is loaded.
  image.classList.add("stale");
  // Exposures may come faster than their images: the next record asks for the newest.
  if (isFollowing && loading) return;
  loading?.abort();
  const control = new AbortController();
  loading = control;
  const signal = AbortSignal.any([control.signal, AbortSignal.timeout(LOAD_TIMEOUT_MS)]);
  shownAddress = address;
  try {
    await loadImage(one, address, isFollowing, signal);
  } finally {
    if (loading === control) loading = null;
  }
}

async function loadImage(one, address, isFollowing, signal) {
  const { number } = one;
  const [isHidden, width] = [image.hidden, image.naturalWidth];
  const products = isFollowing && isSlow() ? Promise.resolve([null, null])
    : Promise.all(["histogram.json", "residuals.json"].map((name) => fetchJson(`/api/v1/exposures/${number}/${name}`, signal)));
  image.onload = async () => {
    image.hidden = false;
    placeholder.hidden = true;
    image.classList.toggle("stale", numberLabel.textContent !== `${number}`);
    // A thumbnail has another size than the quick look.
    if (isHidden || image.naturalWidth !== width) fit();
    const [raw, vectors] = await products;
    if (shownAddress !== address && shownAddress !== `thumbnail ${number}`) return;
    if (raw) drawHistogram(canvas, raw);
    else quicklookHistogram();
    drawVectors(drawing, vectors, image.naturalWidth, image.naturalHeight);
    listOverlaps(vectors, number);
    place();
  };
  image.onerror = () => showPlaceholder(t("image.unreadable", { number }));
  image.alt = t("image.alt", { number, verdict: verdictText(one.verdict) });
  if (isFollowing && isSlow()) {
    const thumbnail = await thumbnailOf(number);
    if (shownAddress !== address) return;
    shownAddress = `thumbnail ${number}`;
    if (thumbnail) image.src = thumbnail;
    return;
  }
  const picture = await (await fetchOk(address, signal))?.blob().catch(() => null);
  if (shownAddress !== address) return;
  if (!picture) {
    showPlaceholder(t("image.no_quicklook", { number }));
    // Retry after RETRY_MS, not with every telemetry record.
    shownAddress = address;
    setTimeout(() => { if (shownAddress === address) shownAddress = null; }, RETRY_MS);
    return;
  }
  if (ownAddress) URL.revokeObjectURL(ownAddress);
  image.src = ownAddress = URL.createObjectURL(picture);
}

function clearImage() {
  showPlaceholder(t("image.none"));
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
