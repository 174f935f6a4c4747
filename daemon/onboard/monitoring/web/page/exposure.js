// Exposure settings: current values, control mode, and a form for manual or automatic control.

import { flight } from "./telemetry.js";
import { command } from "./commands.js";
import { knows, t } from "./i18n.js";
import { number } from "./format.js";

const form = document.getElementById("exposure");
const now = document.getElementById("exposure-now");
const control = document.getElementById("exposure-control");
let shownKey = "";

function drawExposure() {
  const current = flight.settings;
  const key = JSON.stringify(current || {});
  if (key === shownKey || !current?.settings) return;
  shownKey = key;
  const mode = knows(`exposure.control.${current.control}`) ? t(`exposure.control.${current.control}`) : current.control;
  const locked = current.locked_on ? `, ${t("exposure.locked", { line: current.locked_on })}` : "";
  control.textContent = `(${mode}${locked})`;
  const groups = Object.entries(current.settings);
  now.replaceChildren(...groups.map(([group, one]) => Object.assign(document.createElement("li"), {
    textContent: `${group}: ${number(one.exposure_time_us)} µs, ${number(one.gain_db, 1)} dB, ${one.tdi_shifts} TDI`,
  })));
  const selected = form.of.value;
  form.of.replaceChildren(new Option(t("exposure.all"), ""), ...groups.map(([group]) => new Option(group, group)));
  form.of.value = selected;
}

export function start(_root, feed) {
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const body = {};
    for (const name of ["exposure_time_us", "gain_db", "tdi_shifts"]) {
      if (form[name].value !== "") body[name] = Number(form[name].value);
    }
    if (form.of.value) body.of = form.of.value;
    command("exposure", body);
  });

  document.getElementById("automatic").addEventListener("click", () => command("exposure", { control: "automatic" }));
  feed.subscribe(drawExposure);
}
