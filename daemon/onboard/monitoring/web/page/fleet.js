// Several aircraft on one page: one row each, alarms merged. Commands are given on the page of the aircraft.

import { by, element, redraw } from "./dom.js";
import { fill, knows, serverLanguage, serverText, t } from "./i18n.js";
import { clock, number } from "./format.js";
import { fetchJson } from "./http.js";

const REFRESH_MS = 1000;
// A service that does not answer is as good as none.
const TIMEOUT_MS = 3000;
const MARKS = { good: "●", caution: "▲", warning: "✖" };
const STATE_OF_SEVERITY = { warning: "warning", caution: "caution" };

// The worst of the connection and of the active alarms.
function stateOf(aircraft, alarms) {
  if (!aircraft.is_linked) return "warning";
  const active = alarms.filter((one) => one.address === aircraft.address && one.stands && !one.acknowledged);
  return active.some((one) => one.severity === "warning") ? "warning"
    : active.some((one) => STATE_OF_SEVERITY[one.severity]) ? "caution" : "good";
}

function row(aircraft, alarms) {
  const state = stateOf(aircraft, alarms);
  const { good = 0, usable = 0, refly = 0 } = aircraft.verdicts;
  const phase = aircraft.phase && knows(`phase.${aircraft.phase}`) ? t(`phase.${aircraft.phase}`) : "–";
  const link = element("a", { href: aircraft.address, target: "_blank", rel: "noopener", textContent: `${MARKS[state]} ${aircraft.name}` });
  link.title = t("fleet.open", { name: aircraft.name });
  return element("li", { className: state, dataset: { aircraft: aircraft.address } }, link,
    element("span", { textContent: `${aircraft.simulated ? `${t("page.simulated")} · ` : ""}${phase}` }),
    element("span", { textContent: `● ${number(good)} ▲ ${number(usable)} ■ ${number(refly)} ✖ ${number(aircraft.lost ?? 0)}` }),
    element("span", { textContent: aircraft.exposures_left == null ? "–" : t("fleet.exposures", { n: number(aircraft.exposures_left) }) }),
    element("span", { className: "age", textContent: aircraft.is_linked ? t("fleet.age", { s: number(aircraft.age_s) }) : `✖ ${t("fleet.no_link")}` }),
    aircraft.problem ? element("span", { className: "problem", lang: "en", textContent: aircraft.problem }) : null);
}

function alarm(one) {
  const name = one.code && knows(`alarm.${one.code}`) ? t(`alarm.${one.code}`) : "";
  const label = one.stands ? `${one.severity === "caution" ? "▲" : "✖"} ${t(`severity.${one.severity}`)}` : `● ${t("alarm.cleared")}`;
  return element("li", { className: `${one.stands ? "active" : "cleared"} ${one.severity}` },
    element("div", {}, element("strong", { textContent: [label, one.aircraft, name, one.device].filter(Boolean).join(" · ") })),
    element("div", { lang: serverLanguage(one), textContent: serverText(one) }));
}

let unreachable = 0;
let lastSeen = "–";

async function update() {
  const fleet = await fetchJson("/api/v1/fleet", AbortSignal.timeout(TIMEOUT_MS));
  by("clock").textContent = `${clock(new Date())} UTC`;
  unreachable = fleet ? 0 : unreachable + 1;
  const isLost = unreachable > 1;
  document.body.classList.toggle("connection-lost", isLost);
  by("connection-lost").hidden = !isLost;
  if (isLost) by("connection-lost").textContent = t("link.lost", { time: lastSeen });
  if (!fleet) return;
  lastSeen = clock(new Date());
  redraw(by("aircraft"), JSON.stringify(fleet), () => fleet.aircraft.map((one) => row(one, fleet.alarms)));
  redraw(by("faults"), JSON.stringify(fleet.alarms), () => fleet.alarms.length ? fleet.alarms.map(alarm)
    : [element("li", { className: "none", textContent: t("alarm.none") })]);
}

fill();
document.body.dataset.ready = "";
document.documentElement.dataset.theme = localStorage.getItem("cabin") === "dark" ? "dark" : "";
for (;;) {
  await update();
  await new Promise((resolve) => setTimeout(resolve, REFRESH_MS));
}
