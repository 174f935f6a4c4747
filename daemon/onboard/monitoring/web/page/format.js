// Values with their units, in the units and the language of the operator. Input is in SI units.

import { locale } from "./i18n.js";

export const CHOICES = { height: ["m", "ft"], speed: ["kn", "km/h", "m/s"], distance: ["km", "NM"] };
const FACTORS = { m: 1, ft: 1 / 0.3048, kn: 3600 / 1852, "km/h": 3.6, "m/s": 1, km: 1e-3, NM: 1 / 1852 };
const UNKNOWN = "–";

function stored() {
  try {
    return JSON.parse(localStorage.getItem("units")) || {};
  } catch {
    return {};
  }
}

export const units = Object.fromEntries(Object.entries(CHOICES).map(([kind, choices]) =>
  [kind, choices.includes(stored()[kind]) ? stored()[kind] : choices[0]]));

export function setUnit(kind, unit) {
  units[kind] = unit;
  localStorage.setItem("units", JSON.stringify(units));
}

const isKnown = (value) => typeof value === "number" && Number.isFinite(value);

export function number(value, digits = 0) {
  return isKnown(value)
    ? value.toLocaleString(locale, { minimumFractionDigits: digits, maximumFractionDigits: digits, useGrouping: "min2" }) : UNKNOWN;
}

function withUnit(value, unit, digits) {
  return isKnown(value) ? `${number(value * FACTORS[unit], digits)} ${unit}` : UNKNOWN;
}

export const height = (m) => withUnit(m, units.height, 0);
export const length = (m, digits = 0) => withUnit(m, units.height, digits);
// Hundreds of kilometres need no tenths.
export const distance = (m, digits = Math.abs(m) < 1e5 ? 1 : 0) => withUnit(m, units.distance, digits);
export const speed = (mps) => withUnit(mps, units.speed, units.speed === "m/s" ? 1 : 0);
export const angle = (deg, digits = 0) => isKnown(deg) ? `${number(deg, digits)}°` : UNKNOWN;
export const percent = (share, digits = 0) => isKnown(share) ? `${number(100 * share, digits)} %` : UNKNOWN;
export const temperature = (celsius, digits = 1) => isKnown(celsius) ? `${number(celsius, digits)} °C` : UNKNOWN;

export function bytes(nbytes) {
  if (!isKnown(nbytes)) return UNKNOWN;
  const unit = nbytes >= 1e12 ? [1e12, "TB"] : nbytes >= 1e9 ? [1e9, "GB"] : [1e6, "MB"];
  return `${number(nbytes / unit[0], nbytes / unit[0] < 100 ? 1 : 0)} ${unit[1]}`;
}

// h:mm:ss, or m:ss below one hour.
export function duration(s) {
  if (!isKnown(s)) return UNKNOWN;
  const whole = Math.max(0, Math.round(s));
  const two = (value) => String(value).padStart(2, "0");
  const [h, m] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60];
  return h ? `${h}:${two(m)}:${two(whole % 60)}` : `${m}:${two(whole % 60)}`;
}

// Hours and minutes, for what lasts long: 2 h 10, 42 min.
export function span(s) {
  if (!isKnown(s)) return UNKNOWN;
  const minutes = Math.max(0, Math.floor(s / 60));
  return minutes >= 60 ? `${Math.floor(minutes / 60)} h ${String(minutes % 60).padStart(2, "0")}` : `${minutes} min`;
}

// An age: seconds while they count, then hours and minutes.
export const ageText = (s) => s < 100 ? `${number(s)} s` : span(s);

// A standard deviation of time with a readable prefix.
export function sigma(ns) {
  if (!isKnown(ns)) return UNKNOWN;
  if (ns < 1e3) return `${number(ns)} ns`;
  if (ns < 1e6) return `${number(ns / 1e3, 1)} µs`;
  if (ns < 1e9) return `${number(ns / 1e6, 1)} ms`;
  return ns < 1e14 ? `${number(ns / 1e9, 1)} s` : UNKNOWN;
}

// Time of day in UTC.
export function clock(date, hasSeconds = true) {
  return date instanceof Date && !Number.isNaN(date.getTime()) ? date.toISOString().slice(11, hasSeconds ? 19 : 16) : UNKNOWN;
}
