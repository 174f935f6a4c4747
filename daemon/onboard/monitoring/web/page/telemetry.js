// State of the flight, merged from telemetry records. Notifies listeners of each record.

import { isRefused } from "./http.js";

export const flight = {
  brief: null,
  exposures: new Map(),
  devices: new Map(),
  track: [],
  history: [],
  settings: null,
};

const SILENCE_MS = 5000;
const listeners = new Set();

export function onChange(listener) {
  listeners.add(listener);
}

function clear() {
  flight.exposures.clear();
  flight.devices.clear();
  flight.track.length = 0;
  flight.history.length = 0;
  flight.settings = null;
}

function merge(record, isFirstRecord) {
  const { exposures = [], devices = [], track = [], history = [], settings = [], events: _, ...brief } = record;
  flight.brief = brief;
  for (const one of exposures) flight.exposures.set(one.number, one);
  for (const one of devices) flight.devices.set(one.name, one);
  flight.settings = settings.at(-1) || flight.settings;
  flight.track.push(...track);
  flight.history.push(...history);
  for (const listener of listeners) listener(record, isFirstRecord);
}

// Receive telemetry and reconnect for ever. `onLinkChange(isLinked)` is called when the connection
// opens or closes. `requestToken()` is called if reading requires a token; it resolves with one.
export function connect(onLinkChange, requestToken) {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  let waitMs = 500;
  let silence = null;
  const open = () => {
    let isFirstRecord = true;
    const token = sessionStorage.getItem("token");
    // A browser sets no other header of a WebSocket; a token in the address would appear in logs.
    const protocols = token ? ["syntopic.v1", `bearer.${token}`] : ["syntopic.v1"];
    const socket = new WebSocket(`${scheme}://${location.host}/api/v1/telemetry?form=json`, protocols);
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
    const restartTimeout = () => {
      clearTimeout(silence);
      silence = setTimeout(() => {
        socket.close();
        end();
      }, SILENCE_MS);
    };
    // Also while it opens.
    restartTimeout();
    socket.onopen = restartTimeout;
    socket.onmessage = (message) => {
      if (hasEnded) return;
      waitMs = 500;
      restartTimeout();
      // The first record is complete. The previous state may belong to another flight.
      if (isFirstRecord) {
        clear();
        onLinkChange(true);
      }
      merge(JSON.parse(message.data), isFirstRecord);
      isFirstRecord = false;
    };
    socket.onclose = end;
  };
  open();
}
