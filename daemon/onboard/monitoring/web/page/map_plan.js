// A layer of the map that draws the plan on one canvas: lines with their state, planned positions, retakes, gaps, labels.

import { CanvasLayer } from "./map_canvas.js";

// Planned positions that are closer than this are not drawn: they would be a second line.
const PLACES_APART_PX = 5;
const M_PER_DEG = 111320;
const LABEL_MAX = 24;
const LABEL_HEIGHT_PX = 20;
const PADDING_PX = 4;
const FONT = "px system-ui, 'Noto Sans', 'Noto Sans CJK SC', sans-serif";

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const short = (text) => text.length > LABEL_MAX ? `${text.slice(0, LABEL_MAX - 1)}…` : text;

// Side of a line's start at which its label covers no other line: opposite to the line.
function sideOf([[lat0, lon0], [lat1, lon1]]) {
  const [north, east] = [lat1 - lat0, (lon1 - lon0) * Math.cos(lat0 * Math.PI / 180)];
  if (Math.abs(north) > Math.abs(east)) return north > 0 ? "bottom" : "top";
  return east > 0 ? "left" : "right";
}

// Left and top of a label of a width at a side of a point.
function cornerOf({ x, y }, side, width) {
  const [middle, above] = [x - width / 2, y - LABEL_HEIGHT_PX / 2];
  return { bottom: [middle, y + PADDING_PX], top: [middle, y - LABEL_HEIGHT_PX - PADDING_PX],
    left: [x - width - PADDING_PX, above], right: [x + PADDING_PX, above] }[side];
}

const CONTROLS = "#map-tools > *, #map-legend, #map-attribution, #map .leaflet-control";

// Areas of the map that controls cover, in its pixels.
function coveredBy(map) {
  const { left, top } = map.getContainer().getBoundingClientRect();
  return [...document.querySelectorAll(CONTROLS)].map((one) => one.getBoundingClientRect()).filter((one) => one.width)
    .map((one) => ({ left: one.left - left, right: one.right - left, top: one.top - top, bottom: one.bottom - top }));
}

const STYLES = {
  gap: { weight: 700, ink: "--warning", ground: "--warning-ground" },
  retake: { weight: 700, ink: "--accent-ink", ground: "--accent" },
  line: { weight: 600, ink: "--ink", ground: "--ground" },
};

export const PlanLayer = CanvasLayer.extend({
  initialize() {
    CanvasLayer.prototype.initialize.call(this, "plan", 450);
    this.plan = null;
    this.gaps = [];
    this.state = {};
    // Texts of the labels for which there was room, by kind; their places and inks; and the number of areas of gaps in view.
    this.shown = { line: [], retake: [], gap: [], labels: [], areas: 0 };
  },
  set(changed) {
    Object.assign(this, changed);
    this.draw();
  },
  paint(size) {
    this.shown = { line: [], retake: [], gap: [], labels: [], areas: 0 };
    const labels = [];
    this.paintLines(size, labels);
    this.paintRetakes(size, labels);
    this.paintGaps(size, labels);
    this.context.setLineDash([]);
    this.context.globalAlpha = 1;
    this.paintLabels(size, labels);
  },
  stroke(points, { color, weight, dash = [], alpha = 1 }) {
    const { context } = this;
    Object.assign(context, { strokeStyle: color, lineWidth: weight, globalAlpha: alpha });
    context.setLineDash(dash);
    this.trace(points, false);
    context.stroke();
  },
  paintLines(size, labels) {
    const { flown = [], current, next } = this.state;
    const [soft, accent, done] = [colour("--soft"), colour("--accent"), new Set(flown)];
    for (const { id, at, places_m: placesM } of this.plan?.lines || []) {
      const points = this.pointsOf(at, size);
      if (!points) continue;
      const isMarked = id === current || id === next;
      const dash = id === next && id !== current ? [14, 6] : isMarked || done.has(id) ? [] : [8, 6];
      this.stroke(points, { color: isMarked ? accent : soft, dash, weight: id === current ? 5 : id === next ? 4 : done.has(id) ? 3 : 2 });
      this.paintPlaces(at, points, placesM, soft);
      labels.push({ kind: "line", text: id, point: points[0], side: sideOf(at), rank: isMarked ? 2 : 3 });
    }
  },
  paintPlaces([[lat0, lon0], [lat1, lon1]], [start, end], placesM, color) {
    const lengthM = M_PER_DEG * Math.hypot(lat1 - lat0, (lon1 - lon0) * Math.cos(lat0 * Math.PI / 180)) || 1;
    if (Math.hypot(end.x - start.x, end.y - start.y) / placesM.length < PLACES_APART_PX) return;
    const { context } = this;
    Object.assign(context, { strokeStyle: color, lineWidth: 1, globalAlpha: 1 });
    context.setLineDash([]);
    context.beginPath();
    for (const place of placesM) {
      const [x, y] = [start.x + (place / lengthM) * (end.x - start.x), start.y + (place / lengthM) * (end.y - start.y)];
      context.moveTo(x + 2, y);
      context.arc(x, y, 2, 0, 2 * Math.PI);
    }
    context.stroke();
  },
  paintRetakes(size, labels) {
    const accent = colour("--accent");
    for (const { line, at } of this.plan?.retakes || []) {
      const points = this.pointsOf(at, size);
      if (!points) continue;
      this.stroke(points, { color: accent, weight: 8, alpha: 0.5 });
      labels.push({ kind: "retake", text: `↻ ${line}`, point: points[0], side: "left", rank: 1 });
    }
  },
  // Ground covered by too few images, and the segments to be flown again for it.
  paintGaps(size, labels) {
    const { context } = this;
    const warning = colour("--warning");
    for (const { line, at, holes } of this.gaps) {
      for (const ring of holes.flatMap((gap) => gap.rings)) {
        const points = this.pointsOf(ring, size);
        if (!points) continue;
        context.fillStyle = warning;
        context.globalAlpha = 0.6;
        this.trace(points, true);
        context.fill();
        this.shown.areas += 1;
      }
      const points = this.pointsOf(at, size);
      if (!points) continue;
      this.stroke(points, { color: warning, weight: 12, dash: [2, 6], alpha: 0.55 });
      const [a, b] = [points[0], points.at(-1)];
      labels.push({ kind: "gap", text: `✖ ${line}`, point: { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2 }, side: "right", rank: 0 });
    }
  },
  // The important first; a label that would cover another one is left out. The tables have them all.
  paintLabels({ width, height }, labels) {
    const { context } = this;
    const taken = [];
    const covered = coveredBy(this._map);
    const inks = Object.fromEntries(Object.entries(STYLES).map(([kind, { ink, ground }]) => [kind, [colour(ink), colour(ground)]]));
    Object.assign(context, { textBaseline: "middle", lineJoin: "round" });
    for (const { kind, text, point, side } of labels.sort((a, b) => a.rank - b.rank)) {
      const [ink, ground] = inks[kind];
      context.font = `${STYLES[kind].weight} 14${FONT}`;
      const boxWidth = context.measureText(short(text)).width + 2 * PADDING_PX;
      if (point.x < 0 || point.y < 0 || point.x > width || point.y > height) continue;
      // Neither across an edge of the map nor below a control: above or below that instead.
      const [wantedLeft, wantedTop] = cornerOf(point, side, boxWidth);
      const left = Math.max(0, Math.min(wantedLeft, width - boxWidth));
      let top = Math.max(0, Math.min(wantedTop, height - LABEL_HEIGHT_PX));
      for (const one of covered) {
        if (left >= one.right || left + boxWidth <= one.left || top >= one.bottom || top + LABEL_HEIGHT_PX <= one.top) continue;
        top = one.top < height / 2 ? one.bottom : one.top - LABEL_HEIGHT_PX;
      }
      if (taken.some(([x, y, w]) => left < x + w && x < left + boxWidth && Math.abs(top - y) < LABEL_HEIGHT_PX)) continue;
      taken.push([left, top, boxWidth]);
      this.shown[kind].push(text);
      this.shown.labels.push({ text, ink, left, top, width: boxWidth, height: LABEL_HEIGHT_PX });
      const middle = top + LABEL_HEIGHT_PX / 2;
      if (kind === "line") {
        Object.assign(context, { strokeStyle: ground, lineWidth: 4 });
        context.strokeText(short(text), left + PADDING_PX, middle);
      } else {
        context.fillStyle = ground;
        context.fillRect(left, top, boxWidth, LABEL_HEIGHT_PX);
        Object.assign(context, { strokeStyle: ink, lineWidth: 1 });
        context.strokeRect(left + 0.5, top + 0.5, boxWidth - 1, LABEL_HEIGHT_PX - 1);
      }
      context.fillStyle = ink;
      context.fillText(short(text), left + PADDING_PX, middle);
    }
  },
});
