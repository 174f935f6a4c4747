// The verdict of the last exposure, with its findings; and the table of exposures.

import { by, element } from "./dom.js";
import { knows, serverText, t } from "./i18n.js";
import { lastWhere } from "./feed.js";
import { VisibleRows } from "./visible_rows.js";

export const MARKS = { good: "●", usable: "▲", refly: "■", lost: "✖" };
const CHIP_CLASS = { good: "good", usable: "caution", refly: "warning", lost: "warning" };
const SEVERITY_ORDER = { refly: 0, usable: 1, good: 2 };

export const verdictText = (word) => knows(`verdict.${word}`) ? t(`verdict.${word}`) : knows(`step.${word}`) ? t(`step.${word}`) : word;

// The sentence of the service, after the translated name of its flag.
function findingText(finding) {
  const name = knows(`flag.${finding.flag}`) ? `${t(`flag.${finding.flag}`)}: ` : "";
  return `${MARKS[finding.verdict] || ""} ${name}${serverText(finding)}`;
}

function drawVerdict() {
  const latest = lastWhere((one) => one.verdict || one.step === "lost");
  const word = latest ? latest.verdict || "lost" : "waiting";
  const container = by("verdict");
  const which = latest ? t("verdict.exposure", { number: latest.number }) : "";
  const lost = { verdict: "lost", message: latest?.message, sentence: latest?.sentence || t("verdict.lost_text") };
  const findings = word === "lost" ? [lost] : latest?.findings || [];
  const key = JSON.stringify([which, word, findings]);
  if (container.dataset.shown === key) return;
  container.dataset.shown = key;
  container.className = `verdict ${word}`;
  container.querySelector(".mark").textContent = MARKS[word] || "·";
  container.querySelector(".word").textContent = verdictText(word);
  container.querySelector(".which").textContent = which;
  // On a phone the other pages cover the verdict.
  const chip = by("verdict-chip");
  chip.hidden = !latest;
  chip.className = `chip ${CHIP_CLASS[word] || ""}`;
  chip.replaceChildren(`${MARKS[word] || "·"} ${latest?.number ?? ""}`, element("span", { className: "unseen", textContent: ` ${verdictText(word)}` }));
  const sorted = [...findings].sort((a, b) => SEVERITY_ORDER[a.verdict] - SEVERITY_ORDER[b.verdict]);
  by("findings").replaceChildren(...sorted.map((finding) =>
    element("li", { textContent: findingText(finding), className: finding.verdict })));
}

function row(one, feed) {
  const word = one.verdict || one.step;
  const cells = [
    [element("button", { type: "button", textContent: one.number })],
    [`${MARKS[word] || ""} ${verdictText(word)}`, one.verdict || (one.step === "lost" ? "lost" : "")],
    [one.line || ""],
    [one.frames == null ? "" : `${one.frames}`],
  ];
  const created = element("tr", {}, ...cells.map(([content, style]) => element("td", { className: style || "" }, content)));
  created.addEventListener("click", () => feed.select(one.number));
  created.setAttribute("aria-selected", String(one.number === feed.selected));
  return created;
}

function drawRows(rows, feed) {
  rows.set([...feed.flight.exposures.values()].sort((a, b) => b.number - a.number));
}

export function start(_root, feed) {
  const keyOf = (one) => JSON.stringify([one.verdict, one.step, one.line, one.frames, one.number === feed.selected]);
  const rows = new VisibleRows(by("rows"), keyOf, (one) => row(one, feed));
  by("verdict").querySelector(".word").textContent = t("verdict.waiting");
  feed.subscribe((record, isFirstRecord) => {
    drawVerdict();
    if (isFirstRecord || !record || record.exposures) drawRows(rows, feed);
  });
  feed.onSelect(() => drawRows(rows, feed));
}
