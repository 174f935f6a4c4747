// The flight as this page knows it: telemetry records merged, and listeners told.

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

function merge(record) {
  const restarted = flight.brief && record.sequence < flight.brief.sequence;
  if (restarted) {
    flight.exposures.clear();
    flight.devices.clear();
    flight.track.length = 0;
    flight.history.length = 0;
  }
  const { exposures = [], devices = [], track = [], history = [], settings = [], events: _, ...brief } = record;
  flight.brief = brief;
  for (const one of exposures) flight.exposures.set(one.number, one);
  for (const one of devices) flight.devices.set(one.name, one);
  flight.settings = settings.at(-1) || flight.settings;
  flight.track.push(...track);
  flight.history.push(...history);
  for (const listener of listeners) listener(record);
}

// Hear the service for ever; `told(isLinked)` is called whenever the link comes or goes.
export function listen(told) {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  let waitMs = 500;
  let silence = null;
  const connect = () => {
    const token = sessionStorage.getItem("token");
    const query = new URLSearchParams({ form: "json" });
    if (token) query.set("token", token);
    const socket = new WebSocket(`${scheme}://${location.host}/api/v1/telemetry?${query}`);
    const alive = () => {
      clearTimeout(silence);
      silence = setTimeout(() => socket.close(), 5000);
    };
    socket.onopen = () => { flight.track.length = 0; flight.history.length = 0; alive(); };
    socket.onmessage = (message) => {
      waitMs = 500;
      alive();
      told(true);
      merge(JSON.parse(message.data));
    };
    socket.onclose = () => {
      clearTimeout(silence);
      told(false);
      setTimeout(connect, waitMs);
      waitMs = Math.min(waitMs * 2, 8000);
    };
  };
  connect();
}
