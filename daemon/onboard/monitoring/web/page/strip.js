// The strip of the last thumbnails, each with its verdict and, where there is one, the manual verdict.

import { t } from "./i18n.js";
import { element } from "./dom.js";
import { thumbnailOf } from "./thumbnails.js";
import { retakeExposures } from "./retakes.js";

const SHOWN = 24;
const MARKS = { good: "●", usable: "▲", refly: "■", lost: "✖" };
const MANUAL = { reject: "✖", accept: "✔" };
const LONG_PRESS_MS = 500;
const shown = new Map();

// Numbers that are marked to be retaken, and whether a touch marks instead of selecting.
const marked = new Set();
let isMarking = false;

export const verdictOf = (one) => one.verdict || (one.step === "lost" ? "lost" : "");

function labelOf(one) {
  const verdict = verdictOf(one);
  const manual = one.manual ? `, ${t(`image.${one.manual.kind}ed`, { by: one.manual.by })}` : "";
  const mark = marked.has(one.number) ? `, ${t("strip.marked")}` : "";
  return `${t("strip.exposure", { number: one.number })}: ${verdict ? t(`verdict.${verdict}`) : t("strip.waiting")}${manual}${mark}`;
}

function update(item, one, selected) {
  const verdict = verdictOf(one);
  const key = `${verdict} ${one.manual?.kind ?? ""} ${one.step} ${one.number === selected} ${marked.has(one.number)}`;
  if (item.dataset.key === key) return;
  item.dataset.key = key;
  item.className = `thumb ${verdict}${one.manual ? ` ${one.manual.kind}` : ""}${marked.has(one.number) ? " marked" : ""}`;
  item.setAttribute("aria-label", labelOf(one));
  item.setAttribute("aria-pressed", String(one.number === selected));
  item.querySelector(".t-mark").textContent =
    `${marked.has(one.number) ? "↻ " : ""}${MARKS[verdict] || "○"} ${one.number}${one.manual ? ` ${MANUAL[one.manual.kind]}` : ""}`;
  const picture = item.querySelector("img");
  if (one.step === "processed" && !picture.src) {
    thumbnailOf(one.number).then((address) => {
      if (!address || !item.isConnected) return;
      picture.src = address;
      item.dataset.shownMs = Date.now();
    });
  }
}

// `onTouch(isLong)` when an item is touched; a long touch is also a right click or a click with Shift or Ctrl.
function followTouches(item, onTouch) {
  let timer = null;
  let wasLong = false;
  const mark = () => { wasLong = true; onTouch(true); };
  item.addEventListener("pointerdown", (event) => {
    wasLong = false;
    clearTimeout(timer);
    if (event.button === 0) timer = setTimeout(mark, LONG_PRESS_MS);
  });
  for (const kind of ["pointerup", "pointercancel", "pointerleave"]) item.addEventListener(kind, () => clearTimeout(timer));
  item.addEventListener("contextmenu", (event) => {
    event.preventDefault();
    clearTimeout(timer);
    if (!wasLong) mark();
  });
  item.addEventListener("click", (event) => {
    if (!wasLong) onTouch(event.shiftKey || event.ctrlKey);
    wasLong = false;
  });
}

export function start(root, feed) {
  root.setAttribute("role", "group");
  const retake = document.getElementById("strip-retake");
  const setMarking = (wanted) => {
    isMarking = wanted;
    if (!isMarking) marked.clear();
    retake.setAttribute("aria-pressed", String(isMarking));
    retake.textContent = marked.size ? `↻ ${marked.size}` : "↻";
    retake.setAttribute("aria-label", marked.size ? t("strip.retake", { count: marked.size }) : t("strip.mark"));
    draw(false);
  };
  const touch = (number, isLong) => {
    if (isMarking || isLong) {
      if (!marked.delete(number)) marked.add(number);
      setMarking(true);
      return;
    }
    feed.select(number);
    feed.showTab("image");
  };
  // The first touch begins to mark; with marks it retakes them, without any it ends marking.
  retake.addEventListener("click", async () => {
    if (marked.size) await retakeExposures([...marked], feed.command);
    setMarking(!isMarking);
  });
  const draw = (isFirstRecord) => {
    if (isFirstRecord) {
      shown.clear();
      marked.clear();
      root.replaceChildren();
    }
    root.setAttribute("aria-label", t("strip.title"));
    const newest = [...feed.flight.exposures.values()].sort((a, b) => b.number - a.number).slice(0, SHOWN);
    const numbers = new Set(newest.map((one) => one.number));
    for (const [number, item] of shown) {
      if (!numbers.has(number)) {
        item.remove();
        shown.delete(number);
      }
    }
    for (const one of newest.reverse()) {
      let item = shown.get(one.number);
      if (!item) {
        item = element("button", { type: "button" },
          element("img", { alt: "" }), element("span", { className: "t-mark" }));
        followTouches(item, (isLong) => touch(one.number, isLong));
        shown.set(one.number, item);
        root.prepend(item);
      }
      update(item, one, feed.selected);
    }
  };
  feed.subscribe((record, isFirstRecord) => {
    if (!record) for (const item of shown.values()) delete item.dataset.key;
    if (!record || isFirstRecord || record.exposures) draw(isFirstRecord);
  });
  feed.onSelect(() => draw(false));
}
