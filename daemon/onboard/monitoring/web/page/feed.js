// What the modules of the page share: state of the flight, selection, commands, alarms, tabs and keys.

import { flight, onChange } from "./telemetry.js";
import { command, confirmCommand } from "./commands.js";

const listeners = new Set();
const selectionListeners = new Set();
const pageAlarms = new Map();
const keys = new Map();

export const feed = {
  flight,
  keys,
  pageAlarms,
  selected: null,
  isFollowing: true,
  isLinked: false,

  // `listener(record, isFirstRecord)` after each record; `listener(null, false)` when units or theme change.
  subscribe(listener) {
    listeners.add(listener);
  },
  refresh() {
    if (flight.brief) notify(null, false);
  },
  onSelect(listener) {
    selectionListeners.add(listener);
  },
  // Select an exposure everywhere. The page then no longer follows the latest one.
  select(number) {
    feed.follow(false);
    setSelected(number);
  },
  follow(wanted) {
    feed.isFollowing = wanted;
    for (const listener of selectionListeners) listener(feed.selected);
  },
  command: (name, body = {}) => confirmCommand(name, body),
  acknowledge: (fault) => command("acknowledge", { fault }),

  // An alarm that the page itself detects: `code` is an entry of the catalogs, alarm.CODE and alarm.CODE.action.
  raiseAlarm({ code, params = {}, severity = "caution" }) {
    const known = pageAlarms.get(code);
    pageAlarms.set(code, { code, params, severity, sinceMs: known?.sinceMs ?? performance.now(),
      isAcknowledged: known?.isAcknowledged ?? false });
    if (!known || known.severity !== severity || JSON.stringify(known.params) !== JSON.stringify(params)) feed.refresh();
  },
  clearAlarm(code) {
    if (pageAlarms.delete(code)) feed.refresh();
  },

  // `action()` runs when `key` is pressed outside a field; `label` is the code of its description.
  key(key, label, action) {
    keys.set(key, { label, action });
  },
  showTab: () => {},
};

function setSelected(number) {
  feed.selected = number;
  for (const listener of selectionListeners) listener(number);
}

function notify(record, isFirstRecord) {
  for (const listener of listeners) {
    // A fault of one panel leaves the others alive.
    try {
      listener(record, isFirstRecord);
    } catch (error) {
      console.error(error);
    }
  }
}

// The exposure of the highest number for which `predicate` holds.
export function lastWhere(predicate) {
  let found = null;
  for (const one of flight.exposures.values()) if (predicate(one) && (!found || one.number > found.number)) found = one;
  return found;
}

let mission = null;

onChange((record, isFirstRecord) => {
  const id = flight.brief.mission?.id ?? null;
  // After a reconnection to the same flight the selection stays; to another one, the page follows the latest exposure again.
  if (isFirstRecord && (id !== mission || !flight.exposures.has(feed.selected))) {
    feed.isFollowing = true;
    setSelected(null);
  }
  mission = id;
  if (feed.isFollowing) {
    const latest = lastWhere((one) => one.step === "processed")?.number;
    if (latest != null && latest !== feed.selected) setSelected(latest);
  }
  notify(record, isFirstRecord);
});
