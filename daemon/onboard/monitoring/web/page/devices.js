// Devices by kind, disks, and temperatures.

import { by, element, redraw } from "./dom.js";
import { knows, serverText, serverTexts, t } from "./i18n.js";
import { temperature } from "./format.js";
import { fetchJson } from "./http.js";
import { confirmCommand } from "./commands.js";

const DEVICE_MARKS = { ready: "●", searching: "◌", found: "○", unknown: "○", lost: "✖", absent: "✖" };

// Counters of the devices by name. They are not part of telemetry and are read for expanded kinds.
const counters = new Map();

const stateText = (state) => knows(`device.${state}`) ? t(`device.${state}`) : state;
const kindText = (kind) => knows(`device.kind.${kind}`) ? t(`device.kind.${kind}`) : kind;

async function readCounters() {
  for (const device of (await fetchJson("/api/v1/devices")) || []) counters.set(device.name, device.counters);
  for (const item of by("devices").querySelectorAll("li[data-device]")) {
    item.querySelector(".counters").textContent = countersText(item.dataset.device);
  }
}

function countersText(name) {
  return Object.entries(counters.get(name) || {}).filter(([, count]) => count)
    .map(([counter, count]) => `${counter.replaceAll("_", " ")} ${count}`).join(", ");
}

function deviceItem(device) {
  return element("li", { className: device.state, dataset: { device: device.name } },
    element("span", { textContent: DEVICE_MARKS[device.state] || "○", ariaHidden: "true" }),
    element("span", { textContent: device.name }),
    element("span", { className: "detail", textContent:
      device.state === "ready" ? stateText("ready") : `${stateText(device.state)}. ${serverText(device)}` }),
    element("span", { className: "counters", textContent: countersText(device.name) }));
}

const isWaiting = (device) => device.state === "searching";

// Devices by kind. Kinds with a device that is not ready come first and are expanded.
function drawDevices(flight) {
  const kinds = Map.groupBy([...flight.devices.values()].sort((a, b) => a.name.localeCompare(b.name)),
    (device) => device.kind || "other");
  const notReadyOf = (devices) => devices.filter((device) => device.state !== "ready");
  const opened = new Set([...by("devices").querySelectorAll("details.all-ready[open]")].map((one) => one.dataset.kind));
  const sorted = [...kinds].sort((a, b) => notReadyOf(b[1]).length - notReadyOf(a[1]).length || a[0].localeCompare(b[0]));
  by("devices").replaceChildren(...sorted.map(([kind, devices]) => {
    const notReady = notReadyOf(devices);
    const [style, mark] = !notReady.length ? ["all-ready", "●"]
      : notReady.every(isWaiting) ? ["all-ready waiting", "◌"] : ["not-ready", "✖"];
    const counts = { kind: kindText(kind), ready: devices.length - notReady.length, all: devices.length };
    const container = element("details", { open: notReady.length > 0 || opened.has(kind), className: style, dataset: { kind } },
      element("summary", { textContent: `${mark} ${t("device.count", counts)}` }),
      element("ul", {}, ...notReady.map(deviceItem), ...devices.filter((one) => !notReady.includes(one)).map(deviceItem)));
    container.addEventListener("toggle", () => container.open && readCounters());
    return element("li", {}, container);
  }));
}

function diskItem(disk, isMirrored) {
  const isUsed = disk.state === "in use";
  const details = [isUsed ? t("disk.in_use") : disk.state];
  if (isUsed && disk.exposures_left != null) details.push(t("disk.space", { n: disk.exposures_left }));
  if (disk.exposures_to_copy) details.push(t("disk.to_copy", { n: disk.exposures_to_copy }));
  if (disk.temperature_c != null) details.push(temperature(disk.temperature_c, 0));
  if (disk.wear_percent != null) details.push(t("disk.wear", { percent: disk.wear_percent }));
  if (disk.problems) details.push(...serverTexts(disk, "problems"));
  if (disk.sentence) details.push(serverText(disk));
  const item = element("li", { className: isUsed && disk.healthy !== false ? "ready" : "lost" },
    element("span", { textContent: isUsed ? "●" : "✖", ariaHidden: "true" }),
    element("span", { textContent: `${disk.disk} ${disk.path}` }),
    element("span", { className: "detail", textContent: details.join(", ") }));
  if (!isMirrored) return item;
  const name = isUsed ? "release-disk" : "accept-disk";
  const button = element("button", { type: "button", textContent: t(`command.${name}`) });
  button.addEventListener("click", () => confirmCommand(name, { disk: disk.disk }));
  item.append(button);
  return item;
}

export function start(_root, feed) {
  feed.subscribe((record, isFirstRecord) => {
    const { status = {} } = feed.flight.brief;
    if (isFirstRecord || !record || record.devices) drawDevices(feed.flight);
    const disks = status.disks || [];
    by("disks-panel").hidden = !disks.length;
    redraw(by("disks"), JSON.stringify(disks), () => disks.map((disk) => diskItem(disk, disks.length > 1)));
    by("temperatures").replaceChildren(...Object.entries(status.temperatures_c || {}).map(([probe, value]) => element("div", {},
      element("dt", { textContent: probe }),
      element("dd", { textContent: value == null ? t("temperatures.none") : temperature(value, 2) }))));
  });
}
