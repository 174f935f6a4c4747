// Time of day, by the receiver of the aircraft where it is known: the clock of a tablet may be wrong by hours.

// What the link and the rounding to seconds may cost.
const TOLERANCE_MS = 5000;
let offsetMs = 0;

// Set from a time of the service, s since 1970; null leaves it as it is.
export function noteTime(unixS) {
  if (!Number.isFinite(unixS)) return;
  const foundMs = 1000 * unixS - Date.now();
  offsetMs = Math.abs(foundMs) > TOLERANCE_MS ? foundMs : 0;
}

// The time of day for an instant of this browser's clock; now by default.
export const timeOfDay = (ms = Date.now()) => new Date(ms + offsetMs);
