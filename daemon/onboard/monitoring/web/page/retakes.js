// Retakes of exposures, as segments of their lines.

import { fetchJson } from "./http.js";
import { t } from "./i18n.js";
import { showAnswer } from "./commands.js";

// Segments of the stations of exposures: consecutive exposures of a line are one segment.
export function segmentsOf(stations) {
  const segments = [];
  for (const one of [...stations].sort((a, b) => a.number - b.number)) {
    const last = segments.at(-1);
    if (last && last.line === one.line && last.number + last.count === one.number) {
      last.from_m = Math.min(last.from_m, one.at_m);
      last.to_m = Math.max(last.to_m, one.at_m);
      last.count += 1;
    } else segments.push({ line: one.line, number: one.number, from_m: one.at_m, to_m: one.at_m, count: 1 });
  }
  return segments;
}

// Retake exposures. Nothing is sent if one of them has no place on a line; the answer names it. Whether all was accepted.
export async function retakeExposures(numbers, command) {
  const stations = [];
  for (const number of numbers) {
    const station = await fetchJson(`/api/v1/plan/stations/${number}`);
    if (!station) {
      showAnswer(t("image.no_station", { number }), true);
      return false;
    }
    stations.push({ number, line: station.line, at_m: station.at_m });
  }
  for (const { line, number, from_m, to_m } of segmentsOf(stations)) {
    if (!await command("retake", { number, line, from_m, to_m })) return false;
  }
  return true;
}
