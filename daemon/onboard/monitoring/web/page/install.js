// The installable page: its files are kept by a service worker, so that it opens without a connection and reconnects by itself.

// The worker sees no request of the page that registers it: it is given the addresses of that page's files.
async function keepFiles() {
  const { active } = await navigator.serviceWorker.ready;
  const loaded = performance.getEntriesByType("resource").map((one) => one.name);
  active.postMessage({ keep: [...new Set([location.href.split(/[?#]/)[0], ...loaded])] });
}

export function start() {
  if (!("serviceWorker" in navigator) || !isSecureContext) return;
  navigator.serviceWorker.register("worker.js").then(keepFiles).catch(() => {});
}
