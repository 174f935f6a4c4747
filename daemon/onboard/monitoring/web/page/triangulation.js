// The live triangulation: accuracy, drifts against the calibration, lines that do not tie, findings with cures.

import { by, element, redraw } from "./dom.js";
import { serverText, t } from "./i18n.js";
import { length, number } from "./format.js";
import { fetchJson } from "./http.js";

const REFRESH_MS = 5000;
const TIED_SHARE = 0.15;
const TRIED_MIN = 12;

let state = null;

const known = (value, shown) => value == null ? "–" : shown(value);

function figures({ latest, block }) {
  const accuracy = block?.accuracy;
  const both = (median, upper) => `${length(median, 3)} (95 %: ${length(upper, 3)})`;
  return [
    ["sigma0", known(block?.sigma0, (value) => number(value, 2))],
    ["plan", accuracy ? both(accuracy.plan_m, accuracy.plan_95_m) : "–"],
    ["height", accuracy ? both(accuracy.height_m, accuracy.height_95_m) : "–"],
    ["points", known(accuracy?.points, number)],
    ["adjusted", block ? t("triangulation.of", { adjusted: number(block.adjusted), all: number(block.exposures) }) : "–"],
    ["latest", latest ? t(latest.source ? `triangulation.source.${latest.source}` : "triangulation.source.none", { number: latest.number }) : "–"],
    ["behind", known(latest?.behind, number)],
  ];
}

// The quantity of a drift in the language of the page: "boresight about the camera's x" is boresight and x.
function quantity(name) {
  const axis = name.match(/camera's ([xyz])$/)?.[1] ?? name.match(/\b([xyz])\b/)?.[1];
  const kind = ["boresight", "lever arm", "time offset", "attitude"].find((one) => name.startsWith(one) || name.includes(one));
  return kind ? `${t(`triangulation.drift.${kind.replace(" ", "_")}`)}${axis ? ` ${axis}` : ""}` : name;
}

function driftRow({ name, unit, value, sigma, determined }) {
  return element("tr", {},
    element("td", { textContent: quantity(name) }),
    element("td", { textContent: determined && value != null
      ? `${[value, sigma].map((one) => number(one, unit === "m" ? 3 : 1)).join(" ± ")} ${unit}` : t("triangulation.not_determined") }));
}

function tieRow({ lines, tried, found }) {
  const isTied = tried < TRIED_MIN || found >= TIED_SHARE * tried;
  return element("tr", { className: isTied ? "" : "warning" },
    element("td", { textContent: `${isTied ? "" : "■ "}${lines.join(" – ")}` }),
    element("td", { textContent: t("triangulation.of", { adjusted: number(found), all: number(tried) }) }),
    element("td", { textContent: isTied ? t("triangulation.tied") : t("triangulation.not_tied") }));
}

function table(label, rows) {
  if (!rows.length) return null;
  const body = element("tbody", {}, ...rows);
  const box = element("div", { className: "scroll low", tabIndex: 0, ariaLabel: label }, element("table", {}, body));
  box.setAttribute("role", "region");
  return [element("h3", { textContent: label }), box];
}

function findingsList({ findings = [] }) {
  if (!findings.length) return [element("p", { className: "note", textContent: `● ${t("triangulation.nothing_wrong")}` })];
  return [element("ul", { className: "findings" }, ...findings.map((one) => element("li", { className: "caution" },
    element("strong", { textContent: `▲ ${one.name} ` }), element("span", { textContent: serverText(one) }))))];
}

function draw(root) {
  if (!state || !Object.keys(state).length) {
    redraw(root, "off", () => [element("p", { className: "note", textContent: t("triangulation.off") })]);
    return;
  }
  const { block } = state;
  redraw(root, JSON.stringify(state), () => [
    element("p", { className: "note", textContent: block && !block.is_preliminary ? `● ${t("triangulation.landed")}` : `▲ ${t("triangulation.preliminary")}` }),
    element("dl", { className: "figures wide" }, ...figures(state).map(([code, shown]) => element("div", {},
      element("dt", { textContent: t(`triangulation.${code}`) }), element("dd", { id: `triangulation-${code}`, textContent: shown })))),
    ...(block ? [
      ...findingsList(block),
      ...(table(t("triangulation.drifts"), (block.drifts || []).map(driftRow)) || []),
      ...(table(t("triangulation.ties"), (block.line_ties || []).map(tieRow)) || []),
      element("p", { className: "files" }, element("a", { href: "/api/v1/triangulation/report", target: "_blank", rel: "noopener",
        textContent: t("triangulation.report") })),
    ] : []),
  ]);
}

export function start(root, feed) {
  let mission = null;
  const update = async () => {
    if (!feed.flight.brief || !feed.isLinked) return;
    const { id } = feed.flight.brief.mission || {};
    const found = await fetchJson("/api/v1/triangulation");
    if (found) {
      state = found;
      mission = id;
    }
    draw(root);
  };
  feed.subscribe((_record, isFirstRecord) => {
    if (feed.flight.brief.mission?.id !== mission) state = null;
    if (isFirstRecord) setTimeout(update, 300);
    else draw(root);
  });
  // Only while it is seen: the link is thin.
  setInterval(() => { if (!by("page-expert").hidden) update(); }, REFRESH_MS);
  new IntersectionObserver((seen) => { if (seen.some((one) => one.isIntersecting)) update(); }).observe(root);
}
