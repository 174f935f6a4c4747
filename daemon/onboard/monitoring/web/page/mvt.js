// Vector tiles: reads Mapbox Vector Tile 2.1 and draws it on a canvas in one of two styles.
// A tile comes from a file of the operator: every length is checked, and what is damaged ends the tile.

const FEATURES_MAX = 60000;
const POINTS_MAX = 2000000;
const LAYERS_MAX = 60;
const LABELS_MAX = 40;
const TEXT_MAX = 60;

class Reader {
  constructor(bytes, at = 0, end = bytes.length) {
    this.bytes = bytes;
    this.at = at;
    this.end = end;
  }

  varint() {
    let value = 0;
    for (let shift = 0; shift < 70; shift += 7) {
      if (this.at >= this.end) throw new RangeError("truncated");
      const byte = this.bytes[this.at++];
      // Beyond 28 bits the shift operators of JavaScript overflow.
      value += shift < 28 ? (byte & 0x7f) << shift : (byte & 0x7f) * 2 ** shift;
      if (byte < 0x80) return value;
    }
    throw new RangeError("number too long");
  }

  // The next field: [number, value]; a length-delimited value is a Reader, others are numbers.
  field() {
    const key = this.varint();
    const kind = key & 7;
    if (kind === 0) return [key >>> 3, this.varint()];
    const length = kind === 2 ? this.varint() : kind === 1 ? 8 : kind === 5 ? 4 : -1;
    if (length < 0 || this.at + length > this.end) throw new RangeError("truncated");
    const part = new Reader(this.bytes, this.at, this.at + length);
    this.at += length;
    return [key >>> 3, part];
  }

  * fields() {
    while (this.at < this.end) yield this.field();
  }

  text() {
    return new TextDecoder().decode(this.bytes.subarray(this.at, this.end));
  }
}

function valueOf(reader) {
  for (const [number, value] of reader.fields()) {
    if (number === 1) return value.text();
    if (number >= 4 && typeof value === "number") return number === 6 ? (value >>> 1) ^ -(value & 1) : value;
    if (value instanceof Reader) {
      const view = new DataView(value.bytes.buffer, value.bytes.byteOffset + value.at, value.end - value.at);
      return view.byteLength === 4 ? view.getFloat32(0, true) : view.byteLength === 8 ? view.getFloat64(0, true) : null;
    }
  }
  return null;
}

// Parts of a geometry: arrays of x, y, x, y, ... in units of the tile; `isClosed` where it is a ring.
export function partsOf(reader, budget) {
  const parts = [];
  let part = null;
  let [x, y] = [0, 0];
  const zigzag = () => {
    const value = reader.varint();
    return value % 2 ? -(value + 1) / 2 : value / 2;
  };
  while (reader.at < reader.end) {
    const command = reader.varint();
    const count = Math.floor(command / 8);
    const kind = command & 7;
    if (kind === 7) {
      if (part) part.isClosed = true;
      continue;
    }
    if (kind !== 1 && kind !== 2) throw new RangeError("unknown command");
    for (let i = 0; i < count; i += 1) {
      if ((budget.points -= 1) < 0) throw new RangeError("too many points");
      x += zigzag();
      y += zigzag();
      if (kind === 1 || !part) parts.push(part = []);
      part.push(x, y);
    }
  }
  return parts;
}

// Layers of a tile by name: extent, and features with type (1 point, 2 line, 3 area), parts and properties.
export function readTile(bytes) {
  const layers = new Map();
  const budget = { points: POINTS_MAX, features: FEATURES_MAX };
  for (const [number, value] of new Reader(bytes).fields()) {
    if (number !== 3 || !(value instanceof Reader) || layers.size >= LAYERS_MAX) continue;
    const layer = readLayer(value, budget);
    layers.set(layer.name, layer);
  }
  return layers;
}

function readLayer(reader, budget) {
  const layer = { name: "", extent: 4096, features: [] };
  const [keys, values, raw] = [[], [], []];
  for (const [number, value] of reader.fields()) {
    if (number === 1) layer.name = value.text();
    else if (number === 2) raw.push(value);
    else if (number === 3) keys.push(value.text());
    else if (number === 4) values.push(valueOf(value));
    else if (number === 5 && value > 0) layer.extent = value;
  }
  for (const feature of raw) {
    if ((budget.features -= 1) < 0) throw new RangeError("too many features");
    const read = { type: 0, parts: [], properties: {} };
    for (const [number, value] of feature.fields()) {
      if (number === 3) read.type = value;
      else if (number === 4) read.parts = partsOf(value, budget);
      else if (number === 2) {
        while (value.at < value.end) {
          const key = keys[value.varint()];
          const found = values[value.varint()];
          if (key !== undefined) read.properties[key] = found;
        }
      }
    }
    layer.features.push(read);
  }
  return layer;
}

// Groups of layers in their order of drawing, by the names of OpenMapTiles, Protomaps and Shortbread.
const GROUPS = [
  ["land", /^(landcover|landuse|land|park|earth|natural|sites)$/],
  ["water", /^(water|ocean|water_polygons|waterway|water_lines|rivers)$/],
  ["building", /^buildings?$/],
  ["road", /^(transportation|roads|streets|street_polygons|aeroway|ferries)$/],
  ["border", /^(boundary|boundaries)$/],
];
const LABELS = /^(place|places|place_labels|pois|water_name|mountain_peak)$/;
const STYLES = {
  day: { ground: "#f4f2ec", land: "#dde8d3", water: "#b7d3ea", building: "#d9d2c7", road: "#ffffff", casing: "#b9b2a4",
    border: "#8d7fa8", other: "#a7a294", text: "#3a3a3a", halo: "#ffffff" },
  night: { ground: "#14171a", land: "#1a211b", water: "#152534", building: "#24262a", road: "#3a4048", casing: "#1b1e22",
    border: "#5b5170", other: "#41464c", text: "#b9c0c6", halo: "#14171a" },
};
const MAJOR = /motorway|trunk|primary|highway|major/;

function trace(pen, feature, scale) {
  pen.beginPath();
  for (const part of feature.parts) {
    for (let i = 0; i < part.length; i += 2) {
      if (i) pen.lineTo(part[i] * scale, part[i + 1] * scale);
      else pen.moveTo(part[0] * scale, part[1] * scale);
    }
    if (part.isClosed) pen.closePath();
  }
}

function drawLayer(pen, layer, group, style, scale) {
  for (const feature of layer.features) {
    if (feature.type === 3) {
      trace(pen, feature, scale);
      pen.fillStyle = style[group] || style.other;
      pen.fill("evenodd");
    } else if (feature.type === 2) {
      const kind = String(feature.properties.class ?? feature.properties.kind ?? feature.properties["pmap:kind"] ?? "");
      const width = group === "road" ? MAJOR.test(kind) ? 4 : 1.8 : 1.2;
      trace(pen, feature, scale);
      if (group === "road") {
        pen.strokeStyle = style.casing;
        pen.lineWidth = width + 1.5;
        pen.stroke();
      }
      pen.strokeStyle = style[group] || style.other;
      pen.lineWidth = width;
      pen.stroke();
    }
  }
}

function drawLabels(pen, layer, style, scale, size) {
  pen.font = "600 12px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.lineWidth = 4;
  pen.strokeStyle = style.halo;
  pen.fillStyle = style.text;
  let count = 0;
  for (const feature of layer.features) {
    const name = feature.properties.name;
    if (feature.type !== 1 || typeof name !== "string" || !feature.parts.length) continue;
    const [x, y] = [feature.parts[0][0] * scale, feature.parts[0][1] * scale];
    if (x < 0 || y < 0 || x > size || y > size) continue;
    const text = name.slice(0, TEXT_MAX);
    pen.strokeText(text, x, y);
    pen.fillText(text, x, y);
    if ((count += 1) >= LABELS_MAX) return;
  }
}

// Draw a tile; `isNight` picks the style. What cannot be read leaves the ground colour.
export function drawTile(canvas, bytes, isNight) {
  const style = isNight ? STYLES.night : STYLES.day;
  const pen = canvas.getContext("2d");
  pen.fillStyle = style.ground;
  pen.fillRect(0, 0, canvas.width, canvas.height);
  if (!bytes?.length) return;
  const layers = readTile(bytes);
  const scaleOf = (layer) => canvas.width / layer.extent;
  pen.lineJoin = "round";
  for (const [group, names] of GROUPS) {
    for (const layer of layers.values()) {
      if (names.test(layer.name)) drawLayer(pen, layer, group, style, scaleOf(layer));
    }
  }
  const isKnown = (name) => LABELS.test(name) || GROUPS.some(([, names]) => names.test(name));
  for (const layer of layers.values()) {
    if (!isKnown(layer.name)) drawLayer(pen, layer, "other", style, scaleOf(layer));
  }
  for (const layer of layers.values()) {
    if (LABELS.test(layer.name)) drawLabels(pen, layer, style, scaleOf(layer), canvas.width);
  }
}
