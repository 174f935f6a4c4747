// The screen stays on while armed or flying. Browsers permit that on localhost, or with TLS.

import { by } from "./dom.js";
import { t } from "./i18n.js";

const AWAKE = new Set(["armed", "flying"]);
let lock = null;
let isRequested = false;

async function request() {
  isRequested = true;
  try {
    lock = await navigator.wakeLock.request("screen");
    lock.addEventListener("release", () => { lock = null; show(); });
  } catch {
    lock = null;
  }
  isRequested = false;
  show();
}

// Whether the screen stays on, and why not.
function show() {
  const code = !("wakeLock" in navigator) || !isSecureContext ? "wake.needs_tls" : lock ? "wake.on" : "wake.off";
  by("wake").textContent = t(code);
}

// Keep the screen on while `isWanted()`. The returned function is called when that may have changed.
export function keepAwake(isWanted) {
  const update = () => {
    if (!("wakeLock" in navigator) || !isSecureContext) return;
    const isDue = isWanted();
    if (isDue && !lock && !isRequested && document.visibilityState === "visible") request();
    else if (!isDue) lock?.release();
  };
  show();
  // A browser releases the lock of a page that is not seen.
  document.addEventListener("visibilitychange", update);
  return update;
}

export function start(_root, feed) {
  feed.subscribe(keepAwake(() => AWAKE.has(feed.flight.brief?.phase)));
}
