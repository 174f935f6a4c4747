// Thumbnails as addresses of blobs, each fetched once; the oldest are released.

import { fetchOk } from "./http.js";

const CACHED_MAX = 80;
// Until a thumbnail that there was not is requested again: each record of a flight asks for all that are shown.
const RETRY_MS = 5000;
const known = new Map();

// Address of the thumbnail of an exposure; null if there is none.
export function thumbnailOf(number) {
  if (!known.has(number)) {
    const loaded = load(number);
    known.set(number, loaded);
    loaded.then((address) => {
      if (!address) setTimeout(() => { if (known.get(number) === loaded) known.delete(number); }, RETRY_MS);
    });
    while (known.size > CACHED_MAX) {
      const [oldest, address] = known.entries().next().value;
      known.delete(oldest);
      address.then((one) => one && URL.revokeObjectURL(one));
    }
  }
  return known.get(number);
}

const SLOW_BYTES_PER_S = 80000;
// What TCP sends before the first acknowledgement, RFC 6928: a smaller file uses a part of what the link could carry.
const FIRST_WINDOW_BYTES = 14600;
let secondsPerByte = 0;
let latencyMs = Infinity;

// Whether the last thumbnails came at less than SLOW_BYTES_PER_S.
export const isSlow = () => secondsPerByte > 1 / SLOW_BYTES_PER_S;

async function load(number) {
  const sinceMs = performance.now();
  const response = await fetchOk(`/api/v1/exposures/${number}/thumbnail.jpg`);
  const answeredMs = performance.now();
  const picture = await response?.blob();
  if (picture) {
    // The latency of the link is the shortest seen; what an answer took longer is the work of the service.
    latencyMs = Math.min(latencyMs, answeredMs - sinceMs);
    const bodyMs = performance.now() - answeredMs;
    const perByteMs = latencyMs / Math.max(picture.size, FIRST_WINDOW_BYTES) + bodyMs / Math.max(picture.size, 1);
    secondsPerByte = 0.6 * secondsPerByte + 0.4 * perByteMs / 1000;
  }
  if (!picture) return null;
  return URL.createObjectURL(picture);
}

export function clearThumbnails() {
  for (const address of known.values()) address.then((one) => one && URL.revokeObjectURL(one));
  known.clear();
}
