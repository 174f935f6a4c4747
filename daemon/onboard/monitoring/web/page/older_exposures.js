// Footprints and verdicts of exposures that the page no longer keeps whole: numbers in typed arrays, 70 bytes each.

const CORNERS = 4;
const FIRST_CAPACITY = 1024;
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
    this.verdicts = new Uint8Array(FIRST_CAPACITY);
    this.numbers = new Int32Array(FIRST_CAPACITY);
    this.corners = new Float64Array(2 * CORNERS * FIRST_CAPACITY);
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
    this.corners.set(footprint.flat(), 2 * CORNERS * at);
    for (const [latitude, longitude] of footprint) this.extend(latitude, longitude);
  }

  extend(latitude, longitude) {
    const [south, west, north, east] = this.bounds || [latitude, longitude, latitude, longitude];
    this.bounds = [Math.min(south, latitude), Math.min(west, longitude), Math.max(north, latitude), Math.max(east, longitude)];
  }

  grow() {
    for (const name of ["verdicts", "numbers", "corners"]) {
      const longer = new this[name].constructor(2 * this[name].length);
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
    return [this.corners[first], this.corners[first + 1]];
  }

  // The newest exposure whose footprint contains a place; null if there is none.
  numberAt(latitude, longitude) {
    for (let at = this.size - 1; at >= 0; at -= 1) if (this.contains(at, latitude, longitude)) return this.numbers[at];
    return null;
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
