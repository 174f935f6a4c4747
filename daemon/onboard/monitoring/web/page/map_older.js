// A layer of the map that draws the footprints of older exposures on one canvas.

import { CanvasLayer } from "./map_canvas.js";

const CORNERS = [0, 1, 2, 3];

export const OlderLayer = CanvasLayer.extend({
  // `styleOf(verdict)` is { color, dashArray, fillOpacity }.
  initialize(older, styleOf) {
    CanvasLayer.prototype.initialize.call(this, "older", 380);
    this.older = older;
    this.styleOf = styleOf;
    this.drawnKey = "";
    this.drawnCount = 0;
  },
  // Draw what was added since the last time, or all of it if an exposure, the theme or the mission changed.
  update(theme) {
    const key = `${this.older.changes} ${theme}`;
    if (key !== this.drawnKey) this.draw();
    else if (this.older.size > this.drawnCount) this.drawFrom(this.drawnCount, this.size);
    this.drawnKey = key;
  },
  paint(size) {
    this.size = size;
    this.drawFrom(0, size);
  },
  drawFrom(first, size) {
    const { context } = this;
    const styles = new Map();
    for (let at = first; at < this.older.size; at += 1) {
      const points = this.pointsOf(CORNERS.map((corner) => this.older.cornerAt(at, corner)), size);
      if (!points) continue;
      const verdict = this.older.verdictAt(at);
      if (!styles.has(verdict)) styles.set(verdict, this.styleOf(verdict));
      const { color, dashArray, fillOpacity } = styles.get(verdict);
      context.strokeStyle = context.fillStyle = color;
      context.setLineDash(dashArray ? dashArray.split(" ").map(Number) : []);
      this.trace(points, true);
      context.globalAlpha = fillOpacity;
      context.fill();
      context.globalAlpha = 1;
      context.stroke();
    }
    this.drawnCount = this.older.size;
  },
});
