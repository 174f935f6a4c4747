// Charts over the flight: sigma0, dC measured and estimated, time sigma, temperatures.

import { flight } from "./telemetry.js";
import { t } from "./i18n.js";

const charts = {};
const STROKES = ["#2a7fd4", "#d4572a", "#2a9a5b", "#8a5bd0", "#b58900"];
const DASHES = [null, [6, 4], [2, 3], [10, 3, 2, 3]];
const HEIGHT_PX = 118;
const emptyNote = document.getElementById("no-charts");

function ink() {
  return getComputedStyle(document.documentElement).getPropertyValue("--soft").trim();
}

function axes(unit) {
  const grid = { stroke: "#8884", width: 1 };
  return [
    { stroke: ink, grid, size: 26, incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000] },
    { stroke: ink, grid, size: 60, space: 22, label: unit, labelSize: 14, labelGap: 0,
      values: (_, ticks) => ticks.map((value) => `${Number(value.toPrecision(5))}`) },
  ];
}

// The axis of a sigma begins at zero. A temperature axis spans at least 0.5 K, so that noise stays small.
const fromZero = (_, __, maximum) => [0, maximum ? 1.2 * maximum : 1];
const atLeastHalfKelvin = (_, minimum, maximum) => {
  const half = Math.max(0.25, 0.6 * (maximum - minimum));
  return minimum == null ? [0, 1] : [(minimum + maximum) / 2 - half, (minimum + maximum) / 2 + half];
};

function chart(id, title, unit, range, series) {
  const container = document.getElementById(id);
  const created = new uPlot({
    title,
    width: Math.max(container.clientWidth, 200),
    height: HEIGHT_PX,
    scales: { x: { time: false }, y: { range } },
    axes: axes(unit),
    cursor: { show: false },
    legend: {
      show: series.length > 1 || range === atLeastHalfKelvin, live: false,
      markers: { dash: (_, k) => series[k - 1]?.[2] ? (series[k - 1][2][0] < 4 ? "dotted" : "dashed") : "solid" },
    },
    series: [{ label: t("charts.exposure") }, ...series.map(([label, stroke, dash]) => ({
      label, stroke, dash, width: 2, spanGaps: false, points: { size: 4 },
    }))],
  }, [[], ...series.map(() => [])], container);
  // Its legend is drawn by a table that has no data cells.
  created.root.querySelector(".u-legend")?.setAttribute("role", "presentation");
  return created;
}

export function drawCharts() {
  const history = [...flight.history].sort((a, b) => a.number - b.number);
  emptyNote.hidden = history.length > 0;
  if (!charts.sigma0) {
    if (!history.length) return;
    charts.sigma0 = chart("chart-sigma0", "σ0", "px", fromZero, [["σ0", STROKES[0]]]);
    charts.dc = chart("chart-dc", "dC", "K", atLeastHalfKelvin, [[t("charts.measured"), STROKES[1]], [t("charts.estimated"), STROKES[3], [6, 4]]]);
    charts.time = chart("chart-time", t("charts.time_sigma"), "µs", fromZero, [[t("charts.time_sigma"), STROKES[2]]]);
  }
  const numbers = history.map((one) => one.number);
  const of = (key, factor = 1) => history.map((one) => one[key] == null ? null : one[key] * factor);
  charts.sigma0.setData([numbers, of("sigma0_px")]);
  charts.dc.setData([numbers, of("dc_k"), of("dc_estimated_k")]);
  charts.time.setData([numbers, of("time_sigma_ns", 1e-3)]);
  drawTemperatures(history, numbers);
}

// One line per probe, with its own colour and dash. A new probe rebuilds the chart.
function drawTemperatures(history, numbers) {
  const probes = [...new Set(history.flatMap((one) => Object.keys(one.temperatures_c || {})))].sort();
  const key = probes.join();
  if (!key) {
    charts.temperature?.destroy();
    delete charts.temperature;
    return;
  }
  if (charts.temperature?.probes !== key) {
    charts.temperature?.destroy();
    charts.temperature = chart("chart-temperature", t("temperatures.title"), "°C", atLeastHalfKelvin, probes.map((probe, k) =>
      [probe, STROKES[k % STROKES.length], DASHES[Math.floor(k / STROKES.length) % DASHES.length]]));
    charts.temperature.probes = key;
  }
  charts.temperature.setData([numbers, ...probes.map((probe) =>
    history.map((one) => one.temperatures_c?.[probe] ?? null))]);
}

// Resize the charts to their containers and redraw them in the colours of the theme.
export function fitCharts() {
  for (const [name, drawn] of Object.entries(charts)) {
    const container = document.getElementById(`chart-${name}`);
    drawn.setSize({ width: Math.max(container.clientWidth, 200), height: HEIGHT_PX });
    drawn.redraw(false, true);
  }
}
