// The screen stays on while armed or flying. Browsers permit that on localhost, or with TLS.

import { by } from "./dom.js";
import { t } from "./i18n.js";

const AWAKE = new Set(["armed", "flying"]);
let lock = null;

async function request() {
  try {
    lock = await navigator.wakeLock.request("screen");
    lock.addEventListener("release", () => { lock = null; show(); });
  } catch {
    lock = null;
  }
  show();
}

// Whether the screen stays on, and why not.
function show() {
  const code = !("wakeLock" in navigator) || !isSecureContext ? "wake.needs_tls" : lock ? "wake.on" : "wake.off";
  by("wake").textContent = t(code);
}

export function start(_root, feed) {
  const isWanted = () => AWAKE.has(feed.flight.brief?.phase) && document.visibilityState === "visible";
  const update = () => {
    if (!("wakeLock" in navigator) || !isSecureContext) return;
    if (isWanted() && !lock) request();
    else if (!AWAKE.has(feed.flight.brief?.phase)) lock?.release();
  };
  show();
  feed.subscribe(update);
  document.addEventListener("visibilitychange", update);
}
