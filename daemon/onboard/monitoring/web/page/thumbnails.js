// Thumbnails as addresses of blobs, each fetched once, a few at a time; the oldest are released.

import { fetchOk } from "./http.js";

const CACHED_MAX = 80;
// Until a thumbnail that there was not is requested again: each record of a flight asks for all that are shown.
const RETRY_MS = 5000;
const known = new Map();

const AT_ONCE = 3;
// Thumbnails to be fetched, by number. Over a thin link more are made than it carries: the newest come first.
const waiting = new Map();
let running = 0;

function inTurn(number) {
  return new Promise((resolve) => {
    waiting.set(number, resolve);
    next();
  });
}

async function next() {
  if (running >= AT_ONCE || !waiting.size) return;
  const number = Math.max(...waiting.keys());
  const resolve = waiting.get(number);
  waiting.delete(number);
  running += 1;
  resolve(await load(number).catch(() => null));
  running -= 1;
  next();
}

// What is no longer wanted is not fetched.
function drop(number) {
  waiting.get(number)?.(null);
  waiting.delete(number);
}

// Address of the thumbnail of an exposure; null if there is none.
export function thumbnailOf(number) {
  if (!known.has(number)) {
    const loaded = inTurn(number);
    known.set(number, loaded);
    loaded.then((address) => {
      if (!address) setTimeout(() => { if (known.get(number) === loaded) known.delete(number); }, RETRY_MS);
    });
    while (known.size > CACHED_MAX) {
      const [oldest, address] = known.entries().next().value;
      known.delete(oldest);
      drop(oldest);
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
  for (const number of [...waiting.keys()]) drop(number);
  for (const address of known.values()) address.then((one) => one && URL.revokeObjectURL(one));
  known.clear();
}
