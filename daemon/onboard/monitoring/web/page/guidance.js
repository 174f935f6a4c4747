// The strip of guidance above the map.

import { t } from "./i18n.js";
import { element } from "./dom.js";
import { followGuidance } from "./guidance_link.js";
import { drawAge, drawBar, drawCells } from "./guidance_view.js";

const AGE_MS = 250;
const listeners = new Set();
let last = null;

// `listener(frame)` for each frame of guidance.
export function onGuidance(listener) {
  listeners.add(listener);
}

export function start(root, feed) {
  const cells = element("div", { className: "g-cells" });
  const bar = element("div", { className: "g-bar", ariaHidden: "true" },
    element("i", { className: "g-ahead" }), element("i", { className: "g-at" }));
  const age = element("span", { className: "age" });
  let isConnected = false;
  let due = null;
  const draw = () => {
    due = null;
    if (!root.firstChild) root.append(bar, cells, age);
    drawCells(cells, last);
    drawBar(bar, last);
    drawAge(root, age, last);
    for (const listener of listeners) listener(last);
  };
  setInterval(() => { if (root.firstChild) drawAge(root, age, last); }, AGE_MS);
  feed.subscribe((record) => {
    root.hidden = feed.flight.brief.phase === "landed";
    if (!record && last) draw();
    if (isConnected || !feed.flight.brief?.status?.lines) return;
    isConnected = true;
    root.setAttribute("role", "region");
    root.setAttribute("aria-label", t("guidance.title"));
    followGuidance((frame) => {
      last = frame;
      due ??= requestAnimationFrame(draw);
    });
  });
}
