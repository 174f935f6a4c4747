// Residuals of the stitching over the quick look, and the histogram of raw counts.

import { t } from "./i18n.js";
import { number as formatNumber } from "./format.js";

const FEW = 12;
const SCREEN_PX = 24;
const KINDS = ["", "colour", "left-out"];
const COLOURS = { PAN: "#888", R: "#d33", G: "#2a2", B: "#35e", N: "#a3a" };
const note = document.getElementById("vectors-note");
const histogramNote = document.getElementById("histogram-note");

// Residual vectors in pixels of the virtual image, enlarged so that most are visible.
export function drawVectors(svg, residuals, width, height) {
  svg.replaceChildren();
  note.textContent = t("image.no_vectors");
  if (!residuals?.vectors?.length) return;
  const reduced = width / residuals.width_px;
  const lengths = residuals.vectors.filter((v) => v[4] !== 2).map((v) => Math.hypot(v[2], v[3])).sort((a, b) => a - b);
  const p90Px = lengths[Math.floor(lengths.length * 0.9)] || 1;
  const enlarge = 2 * SCREEN_PX / p90Px;
  svg.setAttribute("width", width);
  svg.setAttribute("height", height);
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const longestPx = 8 * SCREEN_PX;
  KINDS.forEach((kind, index) => {
    const path = document.createElementNS(svg.namespaceURI, "path");
    path.setAttribute("class", kind);
    path.setAttribute("d", residuals.vectors.filter((v) => v[4] === index).map(([column, row, right, down]) => {
      const shrink = Math.min(1, longestPx / (enlarge * Math.hypot(right, down) || 1)) * enlarge;
      const [x, y] = [(column + 0.5) * reduced, (row + 0.5) * reduced];
      return `M${x.toFixed(1)} ${y.toFixed(1)}l${(right * shrink).toFixed(1)} ${(down * shrink).toFixed(1)}`;
    }).join(""));
    svg.append(path);
  });
  note.textContent = t("image.vectors_note", { n: residuals.vectors.length, enlarge: formatNumber(enlarge / reduced),
    p90: formatNumber(p90Px, 2) });
}

export function clearHistogram(canvas) {
  canvas.getContext("2d").clearRect(0, 0, canvas.width, canvas.height);
  canvas.setAttribute("aria-label", t("image.histogram"));
  histogramNote.replaceChildren();
}

export function listOverlaps(residuals, number) {
  const rows = (residuals?.overlaps || []).map((one) => {
    const row = document.createElement("tr");
    const few = one.used < FEW ? `▲ ${t("image.few")}: ` : "";
    const cells = [one.sensors.join("–"), `${few}${one.used}`, one.sought, one.rms_px == null ? "" : formatNumber(one.rms_px, 3)];
    row.append(...cells.map((text) => Object.assign(document.createElement("td"),
      { textContent: text, className: few ? "usable" : "" })));
    return row;
  });
  document.getElementById("overlaps").replaceChildren(...rows);
  document.getElementById("overlaps-which").textContent = rows.length ? number : "";
  const drawing = document.getElementById("drawing");
  drawing.hidden = !residuals;
  drawing.href = `/api/v1/exposures/${number}/residuals.svg`;
}

function quantile(counts, share) {
  const total = counts.reduce((a, b) => a + b, 0);
  let sum = 0;
  for (let bin = 0; bin < counts.length; bin += 1) {
    sum += counts[bin];
    if (sum >= share * total) return (bin + 0.5) / counts.length;
  }
  return 1;
}

// Raw counts: one curve for all PAN sensors, one per colour. Also as text, for readers who cannot distinguish the colours.
export function drawHistogram(canvas, countsOfSensor) {
  const groups = {};
  for (const [sensor, counts] of Object.entries(countsOfSensor)) {
    const name = COLOURS[sensor] ? sensor : "PAN";
    groups[name] = groups[name] ? groups[name].map((value, bin) => value + counts[bin]) : [...counts];
  }
  const pen = canvas.getContext("2d");
  pen.clearRect(0, 0, canvas.width, canvas.height);
  histogramNote.replaceChildren(`${t("image.histogram_note")} `);
  for (const [name, counts] of Object.entries(groups)) {
    const maximum = Math.max(...counts, 1);
    pen.strokeStyle = COLOURS[name];
    pen.lineWidth = name === "PAN" ? 3 : 1.5;
    pen.beginPath();
    counts.forEach((count, bin) => pen.lineTo((bin + 0.5) * canvas.width / counts.length,
      canvas.height * (1 - 0.95 * Math.sqrt(count / maximum))));
    pen.stroke();
    const total = counts.reduce((a, b) => a + b, 0) || 1;
    const high = 100 * counts[counts.length - 1] / total;
    const label = `${name} ${(100 * quantile(counts, 0.5)).toFixed(0)} / ${(100 * quantile(counts, 0.99)).toFixed(0)} %` +
      (high >= 0.5 ? ` ▲ ${t("image.full_share", { share: formatNumber(high, 1) })}` : "");
    const swatch = document.createElement("i");
    swatch.className = "swatch";
    swatch.style.borderTop = `${name === "PAN" ? 4 : 2}px solid ${COLOURS[name]}`;
    const curveItem = Object.assign(document.createElement("span"), { className: "curve" });
    curveItem.append(swatch, label);
    histogramNote.append(curveItem, " ");
  }
  canvas.setAttribute("aria-label", `${t("image.histogram_raw")}. ${histogramNote.textContent}`);
}
