// The pages next to the map. On a phone they cover it.

import { by, element } from "./dom.js";
import { t } from "./i18n.js";

// Name, its page, glyph, and where its tab is shown.
const TABS = [
  ["map", null, "◈", "phone"], ["flight", "page-flight", "▤", ""], ["alarms", "page-alarms", "▲", ""],
  ["image", "image-panel", "▣", ""], ["exposures", "exposures", "≡", "wide"], ["lines", "reflights", "∥", "wide"],
  ["devices", "page-devices", "⚙", "wide"], ["expert", "page-expert", "σ", "wide"], ["more", "page-more", "⋯", "phone"],
];
const PHONE = matchMedia("(max-width: 44rem)");
const WIDE = matchMedia("(min-width: 106rem)");

let current = "flight";

function isShown(name) {
  return PHONE.matches ? true : name !== "map" && name !== "more" && !(WIDE.matches && name === "image");
}

function show(name) {
  current = name === "map" || isShown(name) ? name : "flight";
  // Where there is room for both, the map is always seen; its page is that of the flight.
  const page = current === "map" && !PHONE.matches ? "flight" : current;
  document.body.dataset.tab = current;
  for (const [tab, id] of TABS) {
    if (id) by(id).hidden = tab !== page;
    const button = by(`tab-${tab}`);
    const isSelected = tab === page || (tab === "more" && PHONE.matches && TABS.find(([one]) => one === page)[3] === "wide");
    button.setAttribute("aria-selected", String(isSelected));
    button.tabIndex = isSelected ? 0 : -1;
  }
}

// Arrow keys move along the tabs, as in any list of tabs.
function onKey(event) {
  const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
  if (!step) return;
  const seen = [...by("tabs").children].filter((one) => one.offsetParent !== null);
  const next = seen[(seen.indexOf(document.activeElement) + step + seen.length) % seen.length];
  next.focus();
  next.click();
  event.preventDefault();
}

export function start(root, feed) {
  for (const [name, id, glyph, where] of TABS) {
    const tab = element("button", { type: "button", id: `tab-${name}`, className: where, role: "tab", dataset: { tab: name } },
      element("span", { className: "glyph", ariaHidden: "true", textContent: glyph }),
      element("span", { className: "label", textContent: t(`tab.${name}`) }),
      element("span", { className: "badge" }));
    tab.setAttribute("role", "tab");
    if (id) tab.setAttribute("aria-controls", id);
    else tab.setAttribute("aria-controls", "map-panel");
    tab.addEventListener("click", () => show(name));
    root.append(tab);
    if (where === "wide") {
      const other = element("button", { type: "button", textContent: t(`tab.${name}`) });
      other.addEventListener("click", () => show(name));
      by("more-tabs").append(other);
    }
  }
  root.addEventListener("keydown", onKey);
  feed.showTab = show;
  for (const [key, name] of Object.entries({ m: "map", c: "flight", a: "alarms", i: "image", e: "exposures", l: "lines", d: "devices", x: "expert" })) {
    feed.key(key, `tab.${name}`, () => {
      show(name);
      if (name === "map") by("map").focus();
      else by(`tab-${name}`).focus();
    });
  }
  for (const query of [PHONE, WIDE]) query.addEventListener("change", () => show(PHONE.matches ? "map" : "flight"));
  show(PHONE.matches ? "map" : "flight");
}

export function setBadge(name, count) {
  by(`tab-${name}`).querySelector(".badge").textContent = count ? String(count) : "";
}
