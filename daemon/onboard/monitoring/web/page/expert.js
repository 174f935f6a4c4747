// Values for experts, each with one line of explanation, its limit and a colour; and charts over the flight.

import { by, element, redraw, text } from "./dom.js";
import { t } from "./i18n.js";
import { sigma, speed } from "./format.js";
import { presentPosition } from "./lamps.js";
import { drawCharts, fitCharts } from "./charts.js";

function values({ brief }) {
  const status = brief.status || {};
  return [
    { code: "clock_sigma", shown: sigma(status.clock_sigma_ns), id: "sigma" },
  ];
}

export function start(_root, feed) {
  feed.subscribe((record, isFirstRecord) => {
    const { status = {} } = feed.flight.brief;
    const position = presentPosition(feed.flight);
    const velocity = position?.velocity_ned_mps;
    text("satellites", position?.satellites);
    text("speed", velocity && speed(Math.hypot(velocity[0], velocity[1])));
    text("triggers", status.ledger?.triggers?.triggers);
    text("lost", status.ledger?.triggers?.lost);
    const rows = values(feed.flight);
    redraw(by("expert"), JSON.stringify(rows), () => rows.map(({ code, shown, id }) => element("div", {},
      element("dt", {}, element("span", { textContent: t(`expert.${code}`) }), element("span", { id: id || "", textContent: shown })),
      element("dd", { textContent: t(`expert.${code}.text`) }))));
    if (isFirstRecord || !record || record.history) drawCharts();
    if (!record) fitCharts();
  });
  new ResizeObserver(fitCharts).observe(by("page-expert"));
}
