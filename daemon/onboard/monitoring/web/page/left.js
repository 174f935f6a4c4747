// What is left: disk, lines, light and time.

import { element, redraw } from "./dom.js";
import { t } from "./i18n.js";
import { number } from "./format.js";

export function start(root, feed) {
  feed.subscribe(() => {
    const exposures = feed.flight.brief.status?.exposures_left;
    redraw(root, String(exposures), () => [element("div", {}, element("dt", { textContent: t("left.disk") }),
      element("dd", { id: "left-exposures", textContent: exposures == null ? "–" : t("left.exposures", { n: exposures, count: number(exposures) }) }))]);
  });
}
