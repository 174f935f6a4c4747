// A layer of the map that draws the footprints of older exposures on one canvas.

export const OlderLayer = L.Layer.extend({
  // `styleOf(verdict)` is { color, dashArray, fillOpacity }.
  initialize(older, styleOf) {
    this.older = older;
    this.styleOf = styleOf;
    this.drawnKey = "";
    this.drawnCount = 0;
  },
  onAdd(map) {
    map.createPane("older").style.zIndex = 380;
    map.getPane("older").style.pointerEvents = "none";
    this.canvas = L.DomUtil.create("canvas", "leaflet-zoom-hide", map.getPane("older"));
    this.canvas.getContext("2d", { willReadFrequently: true });
    this.draw();
  },
  getEvents() {
    return { moveend: this.draw, zoomend: this.draw, viewreset: this.draw, resize: this.draw };
  },
  // Draw what was added since the last time, or all of it if an exposure, the theme or the mission changed.
  update(theme) {
    const key = `${this.older.changes} ${theme}`;
    if (key !== this.drawnKey) this.draw();
    else if (this.older.size > this.drawnCount) this.drawFrom(this.drawnCount);
    this.drawnKey = key;
  },
  draw() {
    const { x: width, y: height } = this._map.getSize();
    if (this.canvas.width !== width) this.canvas.width = width;
    if (this.canvas.height !== height) this.canvas.height = height;
    L.DomUtil.setPosition(this.canvas, this._map.containerPointToLayerPoint([0, 0]));
    this.canvas.getContext("2d").clearRect(0, 0, width, height);
    this.drawFrom(0);
  },
  drawFrom(first) {
    const { width, height } = this.canvas;
    const context = this.canvas.getContext("2d");
    const styles = new Map();
    for (let at = first; at < this.older.size; at += 1) {
      const points = [0, 1, 2, 3].map((corner) => this._map.latLngToContainerPoint(this.older.cornerAt(at, corner)));
      if (points.every((one) => one.x < 0) || points.every((one) => one.x > width)
        || points.every((one) => one.y < 0) || points.every((one) => one.y > height)) continue;
      const verdict = this.older.verdictAt(at);
      if (!styles.has(verdict)) styles.set(verdict, this.styleOf(verdict));
      const { color, dashArray, fillOpacity } = styles.get(verdict);
      context.strokeStyle = context.fillStyle = color;
      context.setLineDash(dashArray ? dashArray.split(" ").map(Number) : []);
      context.beginPath();
      points.forEach((one, k) => (k ? context.lineTo(one.x, one.y) : context.moveTo(one.x, one.y)));
      context.closePath();
      context.globalAlpha = fillOpacity;
      context.fill();
      context.globalAlpha = 1;
      context.stroke();
    }
    this.drawnCount = this.older.size;
  },
});
