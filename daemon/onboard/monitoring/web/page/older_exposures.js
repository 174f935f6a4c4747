// Footprints and verdicts of exposures that the page no longer keeps whole: numbers in typed arrays, 37 bytes each.

const CORNERS = 4;
// Room for a long flight from its begin, 300 kB; grown by as much if that does not do.
const CAPACITY = 8192;
// Of the first corner; what is farther is a wrong position, and not good to centimetres.
const NEAR_DEG = 4;
const VERDICTS = [null, "good", "usable", "refly", "lost"];

export class OlderExposures {
  constructor() {
    this.clear();
  }

  clear() {
    this.size = 0;
    // Counts what is no mere addition.
    this.changes = (this.changes ?? 0) + 1;
    this.bounds = null;
    // Latitude and longitude of the first corner. The others are offsets from it, good to 3 cm within 4 degrees.
    this.origin = null;
    this.verdicts = new Uint8Array(CAPACITY);
    this.numbers = new Int32Array(CAPACITY);
    this.corners = new Float32Array(2 * CORNERS * CAPACITY);
  }

  // Place of an exposure in the arrays; -1 if it is not in them.
  indexOf(number) {
    return this.size ? this.numbers.lastIndexOf(number, this.size - 1) : -1;
  }

  // Add or replace an exposure. One without a footprint has nothing to draw.
  add(number, verdict, footprint) {
    if (footprint?.length !== CORNERS) return;
    const known = this.indexOf(number);
    const at = known < 0 ? this.size : known;
    if (known >= 0) this.changes += 1;
    else {
      if (this.size === this.numbers.length) this.grow();
      this.size += 1;
    }
    this.numbers[at] = number;
    this.verdicts[at] = Math.max(0, VERDICTS.indexOf(verdict ?? null));
    this.origin ??= footprint[0];
    const [latitude0, longitude0] = this.origin;
    this.corners.set(footprint.flatMap(([latitude, longitude]) => [latitude - latitude0, longitude - longitude0]), 2 * CORNERS * at);
    for (const [latitude, longitude] of footprint) {
      if (Math.abs(latitude - latitude0) <= NEAR_DEG && Math.abs(longitude - longitude0) <= NEAR_DEG) this.extend(latitude, longitude);
    }
  }

  extend(latitude, longitude) {
    const [south, west, north, east] = this.bounds || [latitude, longitude, latitude, longitude];
    this.bounds = [Math.min(south, latitude), Math.min(west, longitude), Math.max(north, latitude), Math.max(east, longitude)];
  }

  grow() {
    for (const [name, each] of [["verdicts", 1], ["numbers", 1], ["corners", 2 * CORNERS]]) {
      const longer = new this[name].constructor(this[name].length + each * CAPACITY);
      longer.set(this[name]);
      this[name] = longer;
    }
  }

  verdictAt(at) {
    return VERDICTS[this.verdicts[at]];
  }

  // Latitude and longitude of a corner.
  cornerAt(at, corner) {
    const first = 2 * (CORNERS * at + corner);
    return [this.origin[0] + this.corners[first], this.origin[1] + this.corners[first + 1]];
  }

  // The newest exposure whose footprint contains a place; null if there is none.
  numberAt(latitude, longitude) {
    let newest = null;
    // They come in any order: the past is loaded while new ones are added.
    for (let at = 0; at < this.size; at += 1) {
      if (this.numbers[at] > newest && this.contains(at, latitude, longitude)) newest = this.numbers[at];
    }
    return newest;
  }

  contains(at, latitude, longitude) {
    let isInside = false;
    for (let k = 0; k < CORNERS; k += 1) {
      const [[y0, x0], [y1, x1]] = [this.cornerAt(at, k), this.cornerAt(at, (k + 1) % CORNERS)];
      if ((y0 > latitude) !== (y1 > latitude) && longitude < x0 + ((latitude - y0) / (y1 - y0)) * (x1 - x0)) isInside = !isInside;
    }
    return isInside;
  }
}
