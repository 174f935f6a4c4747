// State of the flight, merged from telemetry records. Notifies listeners of each record.

import { fetchJson, isRefused } from "./http.js";
import { near, nearPlaces } from "./longitudes.js";
import { OlderExposures } from "./older_exposures.js";
import { clearThumbnails } from "./thumbnails.js";
import { onWake } from "./wake.js";

export const flight = {
  brief: null,
  // The newest exposures, whole, and one that was selected; of those before them footprint and verdict.
  exposures: new Map(),
  older: new OlderExposures(),
  restoredNumber: null,
  devices: new Map(),
  track: [],
  history: [],
  settings: null,
};

const SILENCE_MS = 5000;
const EXPOSURES_MAX = 300;
const RETRY_MS = 5000;
const WANTED = `form=json&newest=${EXPOSURES_MAX}&without=events`;
const TRACK_MAX = 2000;
const HISTORY_MAX = 1000;
const listeners = new Set();

export function onChange(listener) {
  listeners.add(listener);
}

// What belongs to one mission. Devices and their settings outlive it.
function clearMission() {
  flight.exposures.clear();
  flight.older.clear();
  flight.restoredNumber = null;
  flight.track.length = 0;
  flight.history.length = 0;
  // Before any listener asks for those of the new state.
  clearThumbnails();
}

function clear() {
  clearMission();
  flight.devices.clear();
  flight.settings = null;
}

// Drop every second item of the older half, so that the length stays bounded and the end detailed.
function thin(items, maximum) {
  if (items.length <= maximum) return;
  const half = items.length >> 1;
  const kept = items.filter((_, k) => k >= half || k % 2 === 0);
  items.length = 0;
  for (const one of kept) items.push(one);
}

// Reduce the oldest exposures to footprint and verdict.
function prune() {
  const excess = flight.exposures.size - EXPOSURES_MAX;
  if (excess <= 0) return;
  const oldest = [...flight.exposures.keys()].filter((one) => one !== flight.restoredNumber).sort((a, b) => a - b);
  for (const number of oldest.slice(0, excess)) {
    const one = flight.exposures.get(number);
    flight.older.add(number, one.verdict ?? (one.step === "lost" ? "lost" : null), one.footprint);
    flight.exposures.delete(number);
  }
}

// Footprints of the exposures before those that telemetry sends whole, after a connection late in a flight.
async function loadOlder() {
  if ((flight.brief.last_number ?? 0) <= EXPOSURES_MAX) return;
  const mission = flight.brief.mission?.id;
  const listed = await fetchJson(`/api/v1/footprints?newest=${EXPOSURES_MAX}`);
  if (flight.brief?.mission?.id !== mission) return;
  if (!listed) {
    // Refused for a moment, or the link was lost: without them the map would have a hole.
    setTimeout(loadOlder, RETRY_MS);
    return;
  }
  for (const { number, verdict, footprint } of listed) {
    if (!flight.exposures.has(number) && flight.older.indexOf(number) < 0) flight.older.add(number, verdict, nearPlaces(footprint));
  }
  for (const listener of listeners) listener(null, false);
}

// Make a reduced exposure whole again; false if the service does not have it.
export async function restore(number) {
  if (flight.exposures.has(number)) return true;
  const one = await fetchJson(`/api/v1/exposures/${number}`);
  if (!one) return false;
  flight.restoredNumber = number;
  addExposure(one);
  return true;
}

function addExposure(one) {
  if (one.footprint) one.footprint = nearPlaces(one.footprint);
  flight.exposures.set(one.number, one);
}

const bySequence = (a, b) => a.sequence - b.sequence;

function merge(record, isFirstRecord) {
  const { exposures = [], devices = [], track = [], history = [], settings = [], ...brief } = record;
  const { position } = brief.status ?? {};
  if (position) position.longitude_deg = near(position.longitude_deg);
  const isOther = isFirstRecord || flight.brief?.mission?.id !== brief.mission?.id;
  if (isOther && !isFirstRecord) clearMission();
  flight.brief = brief;
  for (const one of exposures) addExposure(one);
  for (const one of devices) flight.devices.set(one.name, one);
  flight.settings = settings.at(-1) || flight.settings;
  for (const one of track) flight.track.push({ ...one, at: [one.at[0], near(one.at[1])] });
  for (const one of history) flight.history.push(one);
  // The past comes newest first, in several records.
  flight.track.sort(bySequence);
  flight.history.sort(bySequence);
  thin(flight.track, TRACK_MAX);
  thin(flight.history, HISTORY_MAX);
  prune();
  for (const listener of listeners) listener(record, isOther);
  if (isOther) loadOlder();
}

// Receive telemetry and reconnect for ever. `onLinkChange(isLinked)` is called when the connection
// opens or closes. `requestToken()` is called if reading requires a token; it resolves with one.
export function connect(onLinkChange, requestToken) {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  let waitMs = 500;
  let silence = null;
  let closeConnection = null;
  // After a sleep the connection is dead, and until a time-out it would look alive.
  onWake(() => closeConnection?.());
  const open = () => {
    let isFirstRecord = true;
    const token = sessionStorage.getItem("token");
    // A browser sets no other header of a WebSocket; a token in the address would appear in logs.
    const protocols = token ? ["syntopic.v1", `bearer.${token}`] : ["syntopic.v1"];
    const socket = new WebSocket(`${scheme}://${location.host}/api/v1/telemetry?${WANTED}`, protocols);
    let hasEnded = false;
    // Also called if the service is silent: a browser may wait long for the end of a dead connection.
    const end = async () => {
      if (hasEnded) return;
      hasEnded = true;
      clearTimeout(silence);
      onLinkChange(false);
      if (isFirstRecord && await isRefused()) {
        sessionStorage.removeItem("token");
        await requestToken();
        waitMs = 500;
      }
      setTimeout(open, waitMs);
      waitMs = Math.min(waitMs * 2, 8000);
    };
    const close = () => {
      socket.close();
      end();
    };
    closeConnection = close;
    const restartTimeout = () => {
      clearTimeout(silence);
      silence = setTimeout(close, SILENCE_MS);
    };
    // Also while it opens.
    restartTimeout();
    socket.onopen = restartTimeout;
    socket.onmessage = (message) => {
      if (hasEnded) return;
      let record = null;
      try {
        record = JSON.parse(message.data);
      } catch {
        // Unreadable: the values shown would be frozen on a link that looks live.
        close();
        return;
      }
      waitMs = 500;
      restartTimeout();
      // What the first record leaves out follows. The previous state may belong to another flight.
      if (isFirstRecord) {
        clear();
        onLinkChange(true);
      }
      merge(record, isFirstRecord);
      isFirstRecord = false;
    };
    socket.onclose = end;
  };
  open();
}
