// Service worker: the page's own files, from the network if it answers, else as they were last. Never data of a flight.

const CACHE = "syntopic-page";
const TIMEOUT_MS = 4000;

const isOfPage = (address) => address.origin === location.origin && !address.pathname.startsWith("/api/")
  && !/^\/(metrics|docs|openapi)/.test(address.pathname);

async function fromNetwork(request) {
  const response = await fetch(request, { signal: AbortSignal.timeout(TIMEOUT_MS) });
  if (response.ok) (await caches.open(CACHE)).put(request, response.clone());
  return response;
}

async function answer(request) {
  try {
    return await fromNetwork(request);
  } catch {
    return await caches.match(request, { ignoreSearch: true }) ?? Response.error();
  }
}

self.addEventListener("install", () => self.skipWaiting());
self.addEventListener("activate", (event) => event.waitUntil(self.clients.claim()));
self.addEventListener("fetch", (event) => {
  if (event.request.method === "GET" && isOfPage(new URL(event.request.url))) event.respondWith(answer(event.request));
});
