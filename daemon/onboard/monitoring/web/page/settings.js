// Theme, units and language of this device.

import { by, element } from "./dom.js";
import { LANGUAGES, language, setLanguage, t } from "./i18n.js";
import { CHOICES, setUnit, units } from "./format.js";

function field(label, choices, chosen, onChange) {
  const select = element("select", {}, ...choices.map(([value, text]) => new Option(text, value)));
  select.value = chosen;
  select.addEventListener("change", () => onChange(select.value));
  return element("label", {}, element("span", { textContent: label }), select);
}

function setTheme(feed, isDark) {
  document.documentElement.dataset.theme = isDark ? "dark" : "";
  by("theme").setAttribute("aria-pressed", String(isDark));
  localStorage.setItem("cabin", isDark ? "dark" : "");
  feed.refresh();
}

export function start(_root, feed) {
  const isDark = () => document.documentElement.dataset.theme === "dark";
  by("theme").addEventListener("click", () => setTheme(feed, !isDark()));
  feed.key("t", "page.theme", () => setTheme(feed, !isDark()));
  setTheme(feed, localStorage.getItem("cabin") === "dark");
  by("settings-fields").replaceChildren(
    field(t("settings.language"), Object.entries(LANGUAGES), language, setLanguage),
    ...Object.entries(CHOICES).map(([kind, choices]) =>
      field(t(`settings.${kind}`), choices.map((unit) => [unit, unit]), units[kind], (unit) => {
        setUnit(kind, unit);
        feed.refresh();
      })));
}
