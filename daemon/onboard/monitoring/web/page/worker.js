// Service worker: the page's own files, from the network if it answers, else as they were last. Never data of a flight.
// A page that was opened from the network has all of its files from there, and one that was opened from the store from
// the store, so that versions are not mixed after an update.

const CACHE = "syntopic-page";
// To the begin of the answer to an opened page; then the stored page opens.
const OPEN_TIMEOUT_MS = 4000;
// Without a byte. A file may take longer: 150 kB take 6 s at 27 kB/s.
const STALL_MS = 15000;
const ATTEMPTS = 3;

// Whether a page was opened from the store, by the id of its client.
const isStored = new Map();

const isOfPage = (address) => address.origin === location.origin && !address.pathname.startsWith("/api/")
  && !/^\/(metrics|docs|openapi)/.test(address.pathname);

const stored = (request) => caches.match(request, { ignoreSearch: true, ignoreVary: true });

// What opens without a connection and without a stored page. Unlike the error page of a browser it tries again.
const waitingPage = () => new Response(
  `<!doctype html><meta charset="utf-8"><meta http-equiv="refresh" content="3"><title>↻</title><p style="font:2rem sans-serif">↻ ${self.location.host}`,
  { status: 503, headers: { "Content-Type": "text/html; charset=utf-8" } });

// The answer with its whole body. Silence of `timeoutMs` before the answer, or of STALL_MS within it, is a failure.
async function fetchWhole(request, timeoutMs) {
  const control = new AbortController();
  let timer = setTimeout(() => control.abort(), timeoutMs);
  try {
    const response = await fetch(request, { signal: control.signal });
    if (!response.body) return response;
    const parts = [];
    const reader = response.body.getReader();
    for (;;) {
      clearTimeout(timer);
      timer = setTimeout(() => control.abort(), STALL_MS);
      const { done, value } = await reader.read();
      if (done) break;
      parts.push(value);
    }
    const { status, statusText, headers } = response;
    return new Response(new Blob(parts, { type: headers.get("Content-Type") || "" }), { status, statusText, headers });
  } finally {
    clearTimeout(timer);
  }
}

async function fromNetwork(request, timeoutMs) {
  const response = await fetchWhole(request, timeoutMs);
  // Refused for a moment, as by the limit of requests: no file of the page.
  if (response.status === 429 || response.status >= 500) throw new Error(`status ${response.status}`);
  if (response.ok) (await caches.open(CACHE)).put(request, response.clone());
  return response;
}

async function answerOpened(request, client) {
  try {
    const response = await fromNetwork(request, OPEN_TIMEOUT_MS);
    isStored.set(client, false);
    return response;
  } catch {
    isStored.set(client, true);
    return await stored(request) ?? waitingPage();
  }
}

async function answerFile(request, client) {
  if (isStored.get(client)) {
    const found = await stored(request);
    if (found) return found;
  }
  for (let attempt = 1; attempt <= ATTEMPTS; attempt += 1) {
    try {
      return await fromNetwork(request, STALL_MS);
    } catch {
      // Tried again; after the last attempt the stored file is better than none.
    }
  }
  return await stored(request) ?? Response.error();
}

// Store the files of a page that was opened before there was a worker; one at a time, since the link may be thin.
async function keep(addresses) {
  for (const address of addresses.filter((one) => isOfPage(new URL(one)))) {
    try {
      if (!await stored(address)) await fromNetwork(new Request(address), STALL_MS);
    } catch {
      // The next page that is opened stores it.
    }
  }
}

self.addEventListener("message", (event) => event.waitUntil(keep(event.data?.keep || [])));
// What is never answered here does not come here, where the browser can be configured: over a flight, thousands of requests
// that are let through would leave megabytes of objects.
const routes = ["/api/*", "/metrics"].map((pathname) => ({ condition: { urlPattern: { pathname } }, source: "network" }));
self.addEventListener("install", (event) => {
  if (event.addRoutes) event.waitUntil(event.addRoutes(routes).catch(() => {}));
  self.skipWaiting();
});
self.addEventListener("activate", (event) => event.waitUntil(self.clients.claim()));
self.addEventListener("fetch", (event) => {
  const { request } = event;
  if (request.method !== "GET" || !isOfPage(new URL(request.url))) return;
  event.respondWith(request.mode === "navigate" ? answerOpened(request, event.resultingClientId)
    : answerFile(request, event.clientId));
});
