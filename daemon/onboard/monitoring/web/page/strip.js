// The strip of the last thumbnails, each with its verdict and, where there is one, the manual verdict.

import { t } from "./i18n.js";
import { element } from "./dom.js";
import { clearThumbnails, thumbnailOf } from "./thumbnails.js";

const SHOWN = 24;
const MARKS = { good: "●", usable: "▲", refly: "■", lost: "✖" };
const MANUAL = { reject: "✖", accept: "✔" };
const shown = new Map();

export const verdictOf = (one) => one.verdict || (one.step === "lost" ? "lost" : "");

function labelOf(one) {
  const verdict = verdictOf(one);
  const manual = one.manual ? `, ${t(`image.${one.manual.kind}ed`, { by: one.manual.by })}` : "";
  return `${t("strip.exposure", { number: one.number })}: ${verdict ? t(`verdict.${verdict}`) : t("strip.waiting")}${manual}`;
}

function update(item, one, selected) {
  const verdict = verdictOf(one);
  const key = `${verdict} ${one.manual?.kind ?? ""} ${one.step} ${one.number === selected}`;
  if (item.dataset.key === key) return;
  item.dataset.key = key;
  item.className = `thumb ${verdict}${one.manual ? ` ${one.manual.kind}` : ""}`;
  item.setAttribute("aria-label", labelOf(one));
  item.setAttribute("aria-pressed", String(one.number === selected));
  item.querySelector(".t-mark").textContent =
    `${MARKS[verdict] || "○"} ${one.number}${one.manual ? ` ${MANUAL[one.manual.kind]}` : ""}`;
  const picture = item.querySelector("img");
  if (one.step === "processed" && !picture.src) {
    thumbnailOf(one.number).then((address) => {
      if (!address || !item.isConnected) return;
      picture.src = address;
      item.dataset.shownMs = Date.now();
    });
  }
}

export function start(root, feed) {
  root.setAttribute("role", "group");
  const draw = (isFirstRecord) => {
    if (isFirstRecord) {
      shown.clear();
      root.replaceChildren();
      clearThumbnails();
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
        item.addEventListener("click", () => {
          feed.select(one.number);
          feed.showTab("image");
        });
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
