// The verdict of the last exposure, with its findings; and the table of exposures.

import { by, element } from "./dom.js";
import { knows, serverText, t } from "./i18n.js";
import { ageText } from "./format.js";
import { lastWhere } from "./feed.js";
import { VisibleRows } from "./visible_rows.js";
import { onWake } from "./wake.js";

export const MARKS = { good: "●", usable: "▲", refly: "■", lost: "✖" };
const CHIP_CLASS = { good: "good", usable: "caution", refly: "warning", lost: "warning" };
const AGE_MS = 1000;
// The monotonic time of the service at the last status, s; when it came, by the clock of this page; and of the verdict shown.
const ages = { serviceS: null, receivedMs: 0, verdictS: null };
const SEVERITY_ORDER = { refly: 0, usable: 1, good: 2 };

export const verdictText = (word) => knows(`verdict.${word}`) ? t(`verdict.${word}`) : knows(`step.${word}`) ? t(`step.${word}`) : word;

// The sentence of the service, after the translated name of its flag.
function findingText(finding) {
  const name = knows(`flag.${finding.flag}`) ? `${t(`flag.${finding.flag}`)}: ` : "";
  return `${MARKS[finding.verdict] || ""} ${name}${serverText(finding)}`;
}

const secondsOf = (ns) => ns == null ? null : Number(ns) * 1e-9;

function noteClock(status) {
  const nowS = secondsOf(status?.mono_ns);
  if (nowS == null || nowS === ages.serviceS) return;
  Object.assign(ages, { serviceS: nowS, receivedMs: performance.now() });
}

// Age of the verdict that is shown. Without a time, or with one of another start of the computer, there is none.
function drawAge() {
  const { serviceS, receivedMs, verdictS } = ages;
  const ageS = serviceS == null || verdictS == null ? -1 : serviceS - verdictS + (performance.now() - receivedMs) / 1000;
  // A status that is older than the verdict by less than its interval.
  const shown = ageS < -AGE_MS / 1000 ? "" : t("verdict.age", { age: ageText(Math.max(0, Math.floor(ageS))) });
  const label = by("verdict").querySelector(".since");
  if (label.textContent !== shown) label.textContent = shown;
}

function drawVerdict() {
  const latest = lastWhere((one) => one.verdict || one.step === "lost");
  ages.verdictS = secondsOf(latest?.verdict_mono_ns);
  drawAge();
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
  setInterval(drawAge, AGE_MS);
  onWake((sleptMs) => { ages.receivedMs -= sleptMs; });
  feed.subscribe((record, isFirstRecord) => {
    if (record) noteClock(record.status);
    drawVerdict();
    if (isFirstRecord || !record || record.exposures) drawRows(rows, feed);
  });
  feed.onSelect(() => drawRows(rows, feed));
}
