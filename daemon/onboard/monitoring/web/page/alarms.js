// Alarms: faults of the service and alarms of the page, by severity; acknowledged, shelved, silenced.

import { by, button, element, redraw } from "./dom.js";
import { knows, locale, serverLanguage, serverText, t } from "./i18n.js";
import { clock, span } from "./format.js";
import { setBadge } from "./tabs.js";
import { timeOfDay } from "./time_of_day.js";
import { isSoundOn, setSound, soundFor, unlockSound } from "./alarm_sound.js";

const MARKS = { warning: "✖", caution: "▲", info: "ℹ" };
const RANK = { warning: 0, caution: 1, info: 2 };
const SHELVE_MINUTES = [5, 15, 60];
const STORE = "shelved";
const LINK = "page page.link";

// Id of a shelved alarm, and until when, in ms of the wall clock. Kept over a reload of the page.
const shelved = new Map(readShelved());
// Id of each silenced alarm, and its severity then. An alarm whose cause is gone is forgotten.
const silenced = new Map();

function readShelved() {
  try {
    return JSON.parse(sessionStorage.getItem(STORE)) || [];
  } catch {
    return [];
  }
}

function shelve(alarm, minutes) {
  if (minutes) shelved.set(alarm.id, Date.now() + 60e3 * minutes);
  else shelved.delete(alarm.id);
  sessionStorage.setItem(STORE, JSON.stringify([...shelved]));
}

// One that would last longer than any shelving is of a clock that was set back since.
function dropExpired() {
  const nowMs = Date.now();
  const latestMs = nowMs + 60e3 * Math.max(...SHELVE_MINUTES);
  for (const [id, untilMs] of shelved) if (untilMs <= nowMs || untilMs > latestMs) shelve({ id }, 0);
}

const secondsSince = (nowNs, thenNs) => nowNs == null || thenNs == null ? null : (Number(nowNs) - Number(thenNs)) * 1e-9;

function ofFault(fault, nowNs) {
  return {
    id: fault.id, code: fault.code || "", severity: fault.severity || "warning", device: fault.device, isService: true,
    isActive: fault.stands, isAcknowledged: fault.acknowledged, by: fault.acknowledged_by || "", count: fault.count,
    isPrevious: fault.previous, detail: serverText(fault), detailLanguage: serverLanguage(fault), ageS: secondsSince(nowNs, fault.raised_mono_ns),
    clearedS: secondsSince(nowNs, fault.cleared_mono_ns), untilMs: shelved.get(fault.id) ?? null, aircraft: fault.aircraft || "",
  };
}

function ofPage(alarm) {
  return {
    id: `page ${alarm.code}`, code: alarm.code, severity: alarm.severity, device: "", isService: false, isActive: true,
    isAcknowledged: alarm.isAcknowledged, by: "", count: 1, isPrevious: false, detail: t(`alarm.${alarm.code}.text`, alarm.params), detailLanguage: locale,
    ageS: (performance.now() - alarm.sinceMs) / 1000, clearedS: null, untilMs: shelved.get(`page ${alarm.code}`) ?? null, aircraft: "",
  };
}

// All alarms: the active before the cleared, the severe before the mild, shelved ones last.
export function listAlarms(feed) {
  const brief = feed.flight.brief;
  const nowNs = brief?.status?.mono_ns;
  const all = [...(brief?.faults || []).map((one) => ofFault(one, nowNs)), ...[...feed.pageAlarms.values()].map(ofPage)];
  // An alarm of the page comes first: all others may be old.
  const rank = (one) => [one.untilMs ? 1 : 0, one.isService ? 1 : 0, one.isActive ? 0 : 1, one.isAcknowledged ? 1 : 0, RANK[one.severity] ?? 0];
  return all.map((one) => [rank(one), one])
    .sort(([a], [b]) => a[0] - b[0] || a[1] - b[1] || a[2] - b[2] || a[3] - b[3] || a[4] - b[4]).map(([, one]) => one);
}

// Names of devices are names; parts of the service have none that the name of the alarm does not say.
const PARTS = new Set(["service", "disk", "power", "exposures", "guidance", "triangulation"]);
const deviceText = (name) => PARTS.has(name) ? "" : name.replace(/^disk (.+)$/, (_, disk) => t("disk.name", { disk }));

const titleOf = (alarm) => {
  const name = knows(`alarm.${alarm.code}`) ? t(`alarm.${alarm.code}`) : "";
  const where = [alarm.aircraft, deviceText(alarm.device)].filter(Boolean).join(" ");
  return [name, where].filter(Boolean).join(": ") || alarm.id;
};

function stateText(alarm) {
  const parts = [];
  if (alarm.isActive && alarm.ageS != null) parts.push(t("alarm.since", { span: agoText(alarm.ageS) }));
  if (!alarm.isActive && !alarm.isPrevious) {
    parts.push(alarm.clearedS == null ? t("alarm.cause_gone") : t("alarm.cause_gone_since", { span: agoText(alarm.clearedS) }));
  }
  if (alarm.count > 1) parts.push(t("alarm.count", { n: alarm.count }));
  if (alarm.isAcknowledged) parts.push(alarm.by ? t("alarm.acknowledged_by", { name: alarm.by }) : t("alarm.acknowledged"));
  if (alarm.untilMs) parts.push(t("alarm.shelved_until", { time: clock(timeOfDay(alarm.untilMs)) }));
  return parts.join(" · ");
}

const agoText = (s) => s < 60 ? `${Math.max(0, Math.floor(s))} s` : span(s);

function labelOf(alarm) {
  if (alarm.isPrevious) return `▲ ${t("alarm.previous")}`;
  if (!alarm.isActive) return `● ${t("alarm.cleared")}`;
  return `${MARKS[alarm.severity]} ${t(`severity.${alarm.severity}`)}`;
}

function acknowledge(alarm, feed) {
  if (alarm.isService) return feed.acknowledge(alarm.id);
  const own = feed.pageAlarms.get(alarm.code);
  if (own) own.isAcknowledged = true;
  return feed.refresh();
}

function shelfButtons(alarm, feed) {
  if (alarm.untilMs) {
    return [button(t("alarm.unshelve"), () => { shelve(alarm, 0); feed.refresh(); })];
  }
  if (!alarm.isActive) return [];
  return [element("span", { className: "shelve-for" }, t("alarm.shelve_for"), ...SHELVE_MINUTES.map((minutes) =>
    button(t("alarm.minutes", { minutes }), () => { shelve(alarm, minutes); feed.refresh(); },
      { className: "shelve", ariaLabel: t("alarm.shelve", { minutes }) })))];
}

// Cause and action of the code, in the language of the page, and the code itself, as `syntopic explain` takes it.
function explanation(alarm) {
  const known = ["cause", "action"].filter((part) => knows(`alarm.${alarm.code}.${part}`)).map((part) =>
    element("div", { className: part }, element("span", { className: "part", textContent: t(`alarm.${part}`) }), " ",
      t(`alarm.${alarm.code}.${part}`)));
  return alarm.isService && alarm.code ? [...known, element("div", {}, element("code", { textContent: alarm.code, translate: false }))] : known;
}

function item(alarm, feed) {
  const created = element("li", { className: `${alarm.isActive ? "active" : "cleared"} ${alarm.severity}`, dataset: { fault: alarm.id } },
    element("div", {}, element("strong", { textContent: `${labelOf(alarm)} · ${titleOf(alarm)}` }),
      element("span", { className: "about", textContent: stateText(alarm) })),
    element("div", { lang: alarm.detailLanguage, textContent: alarm.detail }));
  created.append(...explanation(alarm));
  const buttons = shelfButtons(alarm, feed);
  if (!alarm.isAcknowledged) {
    buttons.unshift(button(t("alarm.acknowledge"), () => acknowledge(alarm, feed), { className: "acknowledge" }));
  }
  if (buttons.length) created.append(element("div", { className: "buttons" }, ...buttons));
  return created;
}

// What changes every second is left out of the key; it is drawn with the next change or every ten seconds.
function keyOf(alarms) {
  const tens = Math.floor(performance.now() / 10e3);
  return JSON.stringify([tens, alarms.map((one) => ({ ...one, ageS: 0, clearedS: one.clearedS == null ? null : 0 }))]);
}

function drawList(alarms, feed) {
  const focused = document.activeElement?.closest?.("#faults li")?.dataset.fault;
  const style = document.activeElement?.className;
  redraw(by("faults"), keyOf(alarms), () => alarms.length ? alarms.map((one) => item(one, feed))
    : [element("li", { className: "none", textContent: t("alarm.none") })]);
  if (focused && !by("faults").contains(document.activeElement)) {
    const same = [...by("faults").children].find((one) => one.dataset.fault === focused);
    (same?.querySelector(style ? `.${style.split(" ")[0]}` : "button") || same?.querySelector("button"))?.focus();
  }
}

function drawBar(alarms, feed) {
  const bar = by("alarm-bar");
  // The lost link has a bar of its own; once it is acknowledged, this one has room for the other alarms.
  const due = alarms.filter((one) => !one.untilMs && (one.isActive || !one.isAcknowledged) && !(one.isPrevious && one.isAcknowledged)
    && !(one.id === LINK && one.isAcknowledged));
  const [first] = due;
  // After an orderly end the alarms are part of the summary.
  const hasEnded = !feed.isLinked && feed.flight.brief?.phase === "landed";
  bar.hidden = !first || hasEnded;
  if (bar.hidden) return;
  const isSounding = soundingOf(alarms).length > 0;
  const [active, cleared] = [true, false].map((wanted) => due.filter((one) => one !== first && one.isActive === wanted).length);
  redraw(bar, JSON.stringify([first.id, first.severity, first.isActive, first.isAcknowledged, first.detail, active, cleared, isSounding]), () => {
    bar.className = first.isActive ? first.severity : "info";
    const what = button("", () => feed.showTab("alarms"), { className: "what" });
    what.append(element("strong", { textContent: `${labelOf(first)} · ${titleOf(first)}` }),
      element("span", { textContent: first.isActive ? first.detail : stateText(first) }));
    const counts = [active && t("alarm.further", { n: active }), cleared && t("alarm.further_cleared", { n: cleared })].filter(Boolean);
    const further = counts.length ? button(counts.join(" · "), () => feed.showTab("alarms"), { className: "further" }) : null;
    const silence = isSounding ? button(t("alarm.silence"), () => silenceAll(feed), { id: "silence" }) : null;
    const seen = first.isAcknowledged ? null
      : button(t("alarm.acknowledge"), () => acknowledge(first, feed), { className: "acknowledge" });
    return [what, further, silence, seen].filter(Boolean);
  });
}

function soundingOf(alarms) {
  return alarms.filter((one) => one.isActive && !one.isAcknowledged && !one.untilMs && one.severity !== "info"
    && silenced.get(one.id) !== one.severity);
}

// Silence what sounds now. Reports of the same cause stay silent; a new alarm sounds, as does one that becomes more
// severe or comes back after its cause was gone.
function silenceAll(feed) {
  for (const one of listAlarms(feed)) if (one.isActive) silenced.set(one.id, one.severity);
  feed.refresh();
  draw(feed);
}

function draw(feed) {
  dropExpired();
  const alarms = listAlarms(feed);
  const active = new Set(alarms.filter((one) => one.isActive).map((one) => one.id));
  for (const id of silenced.keys()) if (!active.has(id)) silenced.delete(id);
  drawList(alarms, feed);
  drawBar(alarms, feed);
  // Seen while another tab of the browser is in front.
  const worst = alarms.find((one) => one.isActive && !one.isAcknowledged && !one.untilMs && one.severity !== "info");
  document.title = `${worst ? `${MARKS[worst.severity]} ` : ""}${document.title.replace(/^[✖▲] /, "")}`;
  setBadge("alarms", alarms.filter((one) => one.isActive && !one.untilMs).length);
  const hasLanded = feed.flight.brief?.phase === "landed";
  soundFor((hasLanded ? [] : soundingOf(alarms)).map((one) => one.severity));
}

export function start(_root, feed) {
  const sound = button("", () => { setSound(!isSoundOn()); showSound(); }, { id: "sound" });
  const showSound = () => {
    sound.textContent = t(isSoundOn() ? "alarm.sound_on" : "alarm.sound_off");
    sound.setAttribute("aria-pressed", String(isSoundOn()));
  };
  showSound();
  by("alarm-tools").replaceChildren(sound,
    button(t("alarm.test"), () => { unlockSound(); soundFor(["caution"], true); }),
    button(t("alarm.silence"), () => silenceAll(feed)));
  feed.key("s", "alarm.silence", () => silenceAll(feed));
  feed.subscribe(() => draw(feed));
  feed.drawAlarms = () => draw(feed);
  setInterval(() => draw(feed), 5000);
}
