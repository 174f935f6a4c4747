// Keys of the page: single letters outside fields. The list is in the settings.

import { by, element } from "./dom.js";
import { t } from "./i18n.js";

const FIELDS = "input, select, textarea, dialog";

export function start(_root, feed) {
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || event.target.closest?.(FIELDS)) return;
    const found = feed.keys.get(event.key);
    if (!found) return;
    event.preventDefault();
    found.action();
  });
  feed.key("?", "keys.title", () => by("open-settings").click());
  by("open-settings").addEventListener("click", () => {
    by("keys-list").replaceChildren(...[...feed.keys].map(([key, { label }]) => element("div", {},
      element("dt", { textContent: t(label) }), element("dd", {}, element("kbd", { textContent: key })))));
    by("settings").showModal();
  });
}
