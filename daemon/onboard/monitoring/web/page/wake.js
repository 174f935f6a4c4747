// A computer that slept: its monotonic clock stood still, so that what is shown would look as fresh as before.

const CHECK_MS = 1000;
const SLEPT_MS = 3000;
const listeners = new Set();

// `listener(sleptMs)` when the clock of the day went on without the monotonic clock, as it does in sleep.
export function onWake(listener) {
  listeners.add(listener);
}

let [wallMs, monotonicMs] = [Date.now(), performance.now()];

export function checkSleep() {
  const [nowWallMs, nowMonotonicMs] = [Date.now(), performance.now()];
  const sleptMs = nowWallMs - wallMs - (nowMonotonicMs - monotonicMs);
  [wallMs, monotonicMs] = [nowWallMs, nowMonotonicMs];
  if (sleptMs > SLEPT_MS) for (const listener of listeners) listener(sleptMs);
}

setInterval(checkSleep, CHECK_MS);
document.addEventListener("visibilitychange", checkSleep);
