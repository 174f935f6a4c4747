// Guidance as values with labels, for the strip of the page and the view of the pilot.

import { t } from "./i18n.js";
import { angle, distance, duration, height, length, number, span, speed } from "./format.js";
import { element } from "./dom.js";
import { ageOf } from "./guidance_link.js";

export const STALE_S = 1.5;
export const LOST_S = 5;
const LONG_S = 100;
const FAR_M = 2000;

const way = (m) => Math.abs(m) >= FAR_M ? distance(m) : length(m);
const arrowOf = (m) => Math.abs(m) < 0.5 ? "" : m > 0 ? " ▶" : " ◀";
const sideOf = (m) => m > 0 ? "right" : "left";

// The label of the height with the limits that there are: below and above the planned height.
function heightLabel({ below_m: below, above_m: above }) {
  // The unit once: the label is narrow.
  if (below != null && above != null) return t("guidance.height_both", { below: height(below).split(" ")[0], above: height(above) });
  if (below != null) return t("guidance.height_below", { limit: height(below) });
  return above == null ? t("guidance.height") : t("guidance.height_above", { limit: height(above) });
}

export function ageState(ageS) {
  return ageS > LOST_S ? "lost" : ageS > STALE_S ? "stale" : "fresh";
}

// The cells of guidance: key, label, value and, where a limit applies, its state.
export function cellsOf(frame) {
  const isOut = (name) => frame.exceeded.includes(name) ? "exceeded" : "";
  const before = frame.stage === "approach";
  const cells = [
    { key: "line", label: t(frame.is_captured ? "guidance.line" : "guidance.next_line"),
      value: `${frame.line}${frame.is_reversed ? " ⇄" : ""}`, describe: frame.line },
    frame.is_captured
      ? { key: "across", label: t("guidance.across", { limit: length(frame.limits.across_m) }),
        value: `${length(Math.abs(frame.across_m))}${arrowOf(frame.across_m)}`,
        describe: t(`guidance.${sideOf(frame.across_m)}`), state: isOut("across") }
      : { key: "bearing", label: t("guidance.bearing"), value: `${angle(frame.bearing_deg)} · ${way(frame.start_distance_m)}` },
    { key: "height", label: heightLabel(frame.limits),
      value: frame.height_deviation_m == null ? "–"
        : `${frame.height_deviation_m >= 0 ? "+" : "−"}${height(Math.abs(frame.height_deviation_m))}`,
      state: isOut("height") },
    before
      ? { key: "start", label: t("guidance.to_start"), value: `${way(frame.to_start_m)} · ${duration(frame.to_start_s)}` }
      : { key: "end", label: t("guidance.to_end"), value: `${way(frame.to_end_m)} · ${duration(frame.to_end_s)}` },
    { key: "countdown", label: t("guidance.countdown", { left: frame.exposures_left }),
      value: frame.next_exposure_s == null ? "–" : `${number(frame.next_exposure_s, 1)} s` },
  ];
  if (frame.turn) {
    cells.push({ key: "turn", label: t("guidance.turn", { line: frame.turn.line }),
      value: `${frame.turn.side === "right" ? "↱" : "↰"} ${angle(frame.turn.angle_deg)} · ${way(frame.turn.to_start_m)}`,
      describe: t(`guidance.turn_${frame.turn.side}`) });
  }
  cells.push(
    { key: "course", label: t("guidance.course"),
      value: `${angle(frame.heading_deg)} / ${angle(frame.track_deg)} · ${angle(frame.crab_deg, 1)}` },
    { key: "speed", label: t("guidance.speed"), value: speed(frame.speed_mps) });
  return cells;
}

// The parts of a value, between which the pilot's view may break the line.
const partsOf = (value) => value.split(" · ").flatMap((part, k) =>
  [...(k ? [" · "] : []), element("span", { className: "g-part", textContent: part })]);

// Update or create the cells in `container`. Elements are reused: this runs at the rate of the receiver.
export function drawCells(container, frame) {
  const wanted = cellsOf(frame);
  const known = new Map([...container.querySelectorAll(":scope > [data-key]")].map((one) => [one.dataset.key, one]));
  for (const cell of wanted) {
    let box = known.get(cell.key);
    known.delete(cell.key);
    if (!box) {
      box = element("div", { className: "g-cell", dataset: { key: cell.key } },
        element("span", { className: "g-label" }), element("span", { className: "g-value" }));
      container.append(box);
    }
    const [label, value] = box.children;
    if (label.textContent !== cell.label) label.textContent = cell.label;
    if (value.textContent !== cell.value) value.replaceChildren(...partsOf(cell.value));
    if (cell.describe) value.title = cell.describe;
    box.classList.toggle("exceeded", cell.state === "exceeded");
  }
  for (const box of known.values()) box.remove();
}

// Show the age of the last frame, and gray the values when it is old.
export function drawAge(container, label, frame) {
  const ageS = frame ? ageOf(frame) : Infinity;
  const state = ageState(ageS);
  container.classList.toggle("stale", state !== "fresh");
  container.classList.toggle("lost", state === "lost");
  // Tenths of a second say nothing of what is minutes old.
  const text = !frame ? t("guidance.none") : ageS < LONG_S ? t("guidance.age", { age: number(ageS, 1) }) : t("guidance.age_long", { span: span(ageS) });
  if (label.textContent !== text) label.textContent = text;
  return state;
}

// A bar with the deviation from the line: the aircraft relative to the limits, which lie at 60 % of each half.
export function drawBar(bar, frame) {
  const share = Math.max(-1, Math.min(1, 0.6 * frame.across_m / (frame.limits.across_m || 1)));
  const ahead = Math.max(-1, Math.min(1, 0.6 * frame.across_ahead_m / (frame.limits.across_m || 1)));
  bar.style.setProperty("--at", `${50 + 50 * share}%`);
  bar.style.setProperty("--ahead", `${50 + 50 * ahead}%`);
  bar.classList.toggle("exceeded", frame.exceeded.includes("across"));
  bar.hidden = !frame.is_captured;
}
