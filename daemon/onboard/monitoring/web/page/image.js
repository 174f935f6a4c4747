// The quick look: zoom, pan, histogram, residual vectors in its place.

import { asked, askedJson } from "./asking.js";
import { flight } from "./state.js";
import { drawHistogram, drawVectors, forgetHistogram, listOverlaps } from "./residuals.js";

const room = document.getElementById("image");
const image = document.getElementById("quicklook");
const nothing = document.getElementById("no-image");
const canvas = document.getElementById("histogram");
const which = document.getElementById("image-which");
const about = document.getElementById("about-image");
const residuals = document.getElementById("show-residuals");
const noteRoom = document.getElementById("vectors-note");
const drawing = document.getElementById("vectors");
const AGAIN_MS = 5000;
const view = { scale: 1, x: 0, y: 0 };
let shown = null;

function place() {
  image.style.transform = `translate(${view.x}px, ${view.y}px) scale(${view.scale})`;
  drawing.style.transform = image.style.transform;
}

function fit() {
  if (!image.naturalWidth) return;
  view.scale = Math.min(room.clientWidth / image.naturalWidth, room.clientHeight / image.naturalHeight);
  view.x = (room.clientWidth - image.naturalWidth * view.scale) / 2;
  view.y = (room.clientHeight - image.naturalHeight * view.scale) / 2;
  place();
}

function zoom(factor, x = room.clientWidth / 2, y = room.clientHeight / 2) {
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
  forgetHistogram(canvas);
  canvas.setAttribute("aria-label", "Histogram of the quick look");
  const most = Math.max(...counts.flatMap((one) => [...one.slice(1, 255)]), 1);
  ["#d33", "#2a2", "#35e"].forEach((colour, band) => {
    draw.strokeStyle = colour;
    draw.beginPath();
    counts[band].forEach((count, value) => {
      draw.lineTo(value * 2, canvas.height * (1 - Math.sqrt(Math.min(count / most, 1))));
    });
    draw.stroke();
  });
}

function share(value) {
  return value == null ? null : `${(100 * value).toFixed(0)} %`;
}

function figures(one) {
  about.replaceChildren();
  const told = one.figures || {};
  const lines = {
    "tie points": told.tie_points_pp === undefined ? null : `${told.tie_points_pp} + ${told.tie_points_pc ?? 0}`,
    "σ0": told.sigma0_px == null ? null : `${told.sigma0_px.toFixed(3)} px`,
    "accuracy": told.stitched_sigma_px == null ? null : `${told.stitched_sigma_px.toFixed(3)} px`,
    "displaced": told.displaced_sensor,
    "saturated": told.saturated_fraction == null ? null : `${(100 * told.saturated_fraction).toFixed(2)} %`,
    "tilt": told.tilt_deg == null ? null : `${told.tilt_deg.toFixed(1)}°`,
    "overlap": share(told.forward_overlap),
    "sidelap": share(told.sidelap),
    "crab": told.crab_deg == null ? null : `${told.crab_deg.toFixed(1)}°`,
    "sun": told.sun_deg == null ? null : `${told.sun_deg.toFixed(0)}°`,
    "GSD": told.gsd_m == null ? null : `${(100 * told.gsd_m).toFixed(1)} cm`,
    "pipeline": one.duration_s == null ? null : `${one.duration_s.toFixed(2)} s`,
  };
  for (const [name, value] of Object.entries(lines)) {
    if (value == null) continue;
    const line = document.createElement("div");
    const term = document.createElement("dt");
    const said = document.createElement("dd");
    term.textContent = name;
    said.textContent = value;
    line.append(term, said);
    about.append(line);
  }
}

export async function showImage(number) {
  const one = flight.exposures.get(number);
  if (!one) return;
  figures(one);
  which.textContent = `${number}`;
  if (one.step !== "processed") {
    showNone(`exposure ${number}: ${one.step === "lost" ? "lost, no image" : `${one.step}, no image yet`}`);
    return;
  }
  drawing.toggleAttribute("hidden", residuals.getAttribute("aria-pressed") !== "true");
  noteRoom.hidden = drawing.hasAttribute("hidden");
  const address = `/api/v1/exposures/${number}/quicklook.jpg`;
  if (shown === address) return;
  shown = address;
  const refit = image.hidden;
  const products = Promise.all(["histogram.json", "residuals.json"].map((name) =>
    askedJson(`/api/v1/exposures/${number}/${name}`)));
  image.onload = async () => {
    image.hidden = false;
    nothing.hidden = true;
    if (refit) fit();
    const [raw, vectors] = await products;
    if (shown !== address) return;
    if (raw) drawHistogram(canvas, raw);
    else quicklookHistogram();
    drawVectors(drawing, vectors, image.naturalWidth, image.naturalHeight);
    listOverlaps(vectors, number);
    place();
  };
  image.onerror = () => showNone(`exposure ${number}: its quick look cannot be read`);
  image.alt = `Quick look of exposure ${number}, verdict ${one.verdict}`;
  const picture = await (await asked(address))?.blob();
  if (shown !== address) return;
  if (!picture) {
    showNone(`exposure ${number}: no quick look`);
    // Asked for again in a while, not with every word of the service.
    shown = address;
    setTimeout(() => { if (shown === address) shown = null; }, AGAIN_MS);
    return;
  }
  if (image.src) URL.revokeObjectURL(image.src);
  image.src = URL.createObjectURL(picture);
}

export function forgetImage() {
  showNone("no image yet");
  which.textContent = "";
  about.replaceChildren();
}

// Better no image than that of another exposure.
function showNone(why) {
  shown = null;
  image.hidden = true;
  nothing.hidden = false;
  nothing.textContent = why;
  drawVectors(drawing, null);
  noteRoom.hidden = true;
  forgetHistogram(canvas);
  listOverlaps(null, null);
}

export function prepareImage(again) {
  document.getElementById("zoom-in").addEventListener("click", () => zoom(1.5));
  document.getElementById("zoom-out").addEventListener("click", () => zoom(1 / 1.5));
  document.getElementById("zoom-fit").addEventListener("click", fit);
  residuals.addEventListener("click", () => {
    const pressed = residuals.getAttribute("aria-pressed") === "true";
    residuals.setAttribute("aria-pressed", String(!pressed));
    again();
  });
  room.addEventListener("wheel", (event) => {
    event.preventDefault();
    const box = room.getBoundingClientRect();
    zoom(event.deltaY < 0 ? 1.2 : 1 / 1.2, event.clientX - box.left, event.clientY - box.top);
  }, { passive: false });
  room.addEventListener("keydown", (event) => {
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
  // One finger moves, two zoom about the middle between them.
  const fingers = new Map();
  const grip = () => {
    const at = [...fingers.values()];
    const middle = [0, 1].map((k) => at.reduce((sum, one) => sum + one[k], 0) / at.length);
    return [...middle, at.length > 1 ? Math.hypot(at[0][0] - at[1][0], at[0][1] - at[1][1]) : 0];
  };
  room.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    room.setPointerCapture(event.pointerId);
  });
  room.addEventListener("pointermove", (event) => {
    if (!fingers.has(event.pointerId)) return;
    const [x0, y0, apart0] = grip();
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    const [x, y, apart] = grip();
    view.x += x - x0;
    view.y += y - y0;
    const box = room.getBoundingClientRect();
    zoom(apart0 && apart ? apart / apart0 : 1, x - box.left, y - box.top);
  });
  for (const end of ["pointerup", "pointercancel"]) {
    room.addEventListener(end, (event) => fingers.delete(event.pointerId));
  }
  addEventListener("resize", fit);
}
