// The coverage of the plan and what to fly again: one request at a time for all panels, parsed only if the answer is another.

import { flight } from "./telemetry.js";
import { fetchOk } from "./http.js";

// An answer that never comes must not keep all later ones waiting.
const TIMEOUT_MS = 60000;
let running = null;
let waiting = null;
let control = null;
let latest = { mission: null, text: "", advice: null };

const missionOf = () => flight.brief?.mission?.id ?? null;

function begin() {
  if (latest.mission !== missionOf()) latest = { mission: missionOf(), text: "", advice: null };
  control = new AbortController();
  const timer = setTimeout(() => control.abort(), TIMEOUT_MS);
  running = load(latest, control.signal).finally(() => {
    clearTimeout(timer);
    running = null;
  });
  return running;
}

// The advice of the present mission, the same object while it is unchanged; null if there is none. While one request runs all
// others wait for the next, since its answer may not know the newest exposure.
export function fetchAdvice() {
  if (!running) return begin();
  if (latest.mission !== missionOf()) control.abort();
  waiting ??= running.then(() => { waiting = null; return begin(); });
  return waiting;
}

async function load(known, signal) {
  try {
    const text = await (await fetchOk("/api/v1/advice", signal))?.text() ?? "";
    if (!text || known !== latest) return null;
    if (text !== known.text) {
      const advice = JSON.parse(text);
      Object.assign(known, { text, advice: advice.segments ? advice : null });
    }
    return known.advice;
  } catch {
    // The link was lost, or the mission changed, within the answer.
    return null;
  }
}
