// The installable page: its files are kept by a service worker, so that it opens without a connection and reconnects by itself.

export function start() {
  if (!("serviceWorker" in navigator) || !isSecureContext) return;
  navigator.serviceWorker.register("worker.js").catch(() => {});
}
