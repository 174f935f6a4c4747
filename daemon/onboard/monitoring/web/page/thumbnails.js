// Thumbnails as addresses of blobs, each fetched once; the oldest are released.

import { fetchOk } from "./http.js";

const CACHED_MAX = 80;
const known = new Map();

// Address of the thumbnail of an exposure; null if there is none.
export function thumbnailOf(number) {
  if (!known.has(number)) {
    known.set(number, load(number));
    while (known.size > CACHED_MAX) {
      const [oldest, address] = known.entries().next().value;
      known.delete(oldest);
      address.then((one) => one && URL.revokeObjectURL(one));
    }
  }
  return known.get(number);
}

const SLOW_BYTES_PER_S = 80000;
let bytesPerS = Infinity;

// Whether the last thumbnails came at less than SLOW_BYTES_PER_S, requests included.
export const isSlow = () => bytesPerS < SLOW_BYTES_PER_S;

async function load(number) {
  const sinceMs = performance.now();
  const picture = await (await fetchOk(`/api/v1/exposures/${number}/thumbnail.jpg`))?.blob();
  if (picture) {
    const rate = 1000 * picture.size / Math.max(performance.now() - sinceMs, 1);
    bytesPerS = Number.isFinite(bytesPerS) ? 0.6 * bytesPerS + 0.4 * rate : rate;
  }
  if (!picture) {
    known.delete(number);
    return null;
  }
  return URL.createObjectURL(picture);
}

export function clearThumbnails() {
  for (const address of known.values()) address.then((one) => one && URL.revokeObjectURL(one));
  known.clear();
}
