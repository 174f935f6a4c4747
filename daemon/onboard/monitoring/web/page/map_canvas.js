// A layer of the map that is one canvas of the size of the map: its memory is that of the screen, whatever it draws.

export const CanvasLayer = L.Layer.extend({
  initialize(pane, order) {
    this.paneName = pane;
    this.order = order;
  },
  onAdd(map) {
    const pane = map.getPane(this.paneName) || map.createPane(this.paneName);
    pane.style.zIndex = this.order;
    pane.style.pointerEvents = "none";
    this.canvas = L.DomUtil.create("canvas", "leaflet-zoom-hide", pane);
    this.context = this.canvas.getContext("2d", { willReadFrequently: true });
    this.draw();
  },
  onRemove() {
    this.canvas.remove();
  },
  getEvents() {
    return { moveend: this.draw, zoomend: this.draw, viewreset: this.draw, resize: this.draw };
  },
  // Draw all of it again, by `paint(size)` of the layer, in CSS pixels of the container.
  draw() {
    if (!this._map) return;
    const { x: width, y: height } = this._map.getSize();
    const scale = window.devicePixelRatio || 1;
    for (const [side, size] of [["width", width], ["height", height]]) {
      const pixels = Math.round(size * scale);
      if (this.canvas[side] !== pixels) this.canvas[side] = pixels;
      this.canvas.style[side] = `${size}px`;
    }
    L.DomUtil.setPosition(this.canvas, this._map.containerPointToLayerPoint([0, 0]));
    this.context.setTransform(scale, 0, 0, scale, 0, 0);
    this.context.clearRect(0, 0, width, height);
    this.paint({ width, height });
  },
  // Pixels of places; null if all of them are outside on one side.
  pointsOf(places, { width, height }) {
    const points = places.map((one) => this._map.latLngToContainerPoint(one));
    const isOutside = points.every((one) => one.x < 0) || points.every((one) => one.x > width)
      || points.every((one) => one.y < 0) || points.every((one) => one.y > height);
    return isOutside ? null : points;
  },
  // Begin a path through points.
  trace(points, isClosed) {
    this.context.beginPath();
    points.forEach((one, k) => (k ? this.context.lineTo(one.x, one.y) : this.context.moveTo(one.x, one.y)));
    if (isClosed) this.context.closePath();
  },
});
