// The flight as this page knows it: telemetry records merged, and listeners told.

import { headers } from "./asking.js";

export const flight = {
  brief: null,
  exposures: new Map(),
  devices: new Map(),
  track: [],
  history: [],
  settings: null,
};

const listeners = new Set();

export function onChange(listener) {
  listeners.add(listener);
}

function forget() {
  flight.exposures.clear();
  flight.devices.clear();
  flight.track.length = 0;
  flight.history.length = 0;
  flight.settings = null;
}

function merge(record, isFresh) {
  const { exposures = [], devices = [], track = [], history = [], settings = [], events: _, ...brief } = record;
  flight.brief = brief;
  for (const one of exposures) flight.exposures.set(one.number, one);
  for (const one of devices) flight.devices.set(one.name, one);
  flight.settings = settings.at(-1) || flight.settings;
  flight.track.push(...track);
  flight.history.push(...history);
  for (const listener of listeners) listener(record, isFresh);
}

async function isRefused() {
  try {
    return (await fetch("/api/v1/brief", { headers: headers() })).status === 401;
  } catch {
    return false;
  }
}

// Hear the service for ever; `told(isLinked)` is called whenever the link comes or goes, and
// `needsToken()` where looking is not for everybody: it gives back when there is a token to try.
export function listen(told, needsToken) {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  let waitMs = 500;
  let silence = null;
  const connect = () => {
    let isFresh = true;
    const token = sessionStorage.getItem("token");
    // A browser sets no other header of a WebSocket; in the address a token would end up in logs.
    const protocols = token ? ["syntopic.v1", `bearer.${token}`] : ["syntopic.v1"];
    const socket = new WebSocket(`${scheme}://${location.host}/api/v1/telemetry?form=json`, protocols);
    const alive = () => {
      clearTimeout(silence);
      silence = setTimeout(() => socket.close(), 5000);
    };
    socket.onopen = alive;
    socket.onmessage = (message) => {
      waitMs = 500;
      alive();
      // Each link tells all there is: what is known from before may be of another flight.
      if (isFresh) {
        forget();
        told(true);
      }
      merge(JSON.parse(message.data), isFresh);
      isFresh = false;
    };
    socket.onclose = async () => {
      clearTimeout(silence);
      told(false);
      if (isFresh && await isRefused()) {
        sessionStorage.removeItem("token");
        await needsToken();
        waitMs = 500;
      }
      setTimeout(connect, waitMs);
      waitMs = Math.min(waitMs * 2, 8000);
    };
  };
  connect();
}
