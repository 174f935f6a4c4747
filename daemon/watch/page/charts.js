// Figures over the flight: sigma0, dC measured and estimated, time sigma.

import { flight } from "./state.js";

const charts = {};
const STROKES = ["#2a7fd4", "#d4572a", "#2a9a5b", "#8a5bd0", "#b58900"];
const DASHES = [null, [6, 4], [2, 3], [10, 3, 2, 3]];

function axes(unit) {
  const ink = getComputedStyle(document.documentElement).getPropertyValue("--soft").trim();
  const grid = { stroke: "#8884", width: 1 };
  return [
    { stroke: ink, grid, size: 26, incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000] },
    { stroke: ink, grid, size: 52, label: unit, labelSize: 14, labelGap: 0 },
  ];
}

function chart(id, title, unit, series) {
  const room = document.getElementById(id);
  return new uPlot({
    title,
    width: Math.max(room.clientWidth, 200),
    height: Math.max(room.clientHeight - 46, 80),
    scales: { x: { time: false } },
    axes: axes(unit),
    series: [{ label: "exposure" }, ...series.map(([label, stroke, dash]) => ({
      label, stroke, dash, width: 2, spanGaps: false, points: { size: 4 },
    }))],
  }, [[], ...series.map(() => [])], room);
}

export function drawCharts() {
  if (!charts.sigma0) {
    charts.sigma0 = chart("chart-sigma0", "σ0", "px", [["σ0 px", "#2a7fd4"]]);
    charts.dc = chart("chart-dc", "dC", "K",
      [["measured", "#d4572a"], ["estimated", "#8a5bd0", [6, 4]]]);
    charts.time = chart("chart-time", "time σ", "µs", [["σ µs", "#2a9a5b"]]);
  }
  const numbers = flight.history.map((one) => one.number);
  const of = (key, factor = 1) => flight.history.map((one) => one[key] == null ? null : one[key] * factor);
  drawTemperatures(numbers);
  charts.sigma0.setData([numbers, of("sigma0_px")]);
  charts.dc.setData([numbers, of("dc_k"), of("dc_estimated_k")]);
  charts.time.setData([numbers, of("time_sigma_ns", 1e-3)]);
}

// One line a probe, told apart by colour and dash; made anew when a probe comes.
function drawTemperatures(numbers) {
  const probes = [...new Set(flight.history.flatMap((one) => Object.keys(one.temperatures_c || {})))].sort();
  if (!probes.length) return;
  const key = probes.join();
  if (charts.temperature?.probes !== key) {
    charts.temperature?.destroy();
    charts.temperature = chart("chart-temperature", "temperatures", "°C", probes.map((probe, k) =>
      [probe, STROKES[k % STROKES.length], DASHES[Math.floor(k / STROKES.length) % DASHES.length]]));
    charts.temperature.probes = key;
  }
  charts.temperature.setData([numbers, ...probes.map((probe) =>
    flight.history.map((one) => one.temperatures_c?.[probe] ?? null))]);
}

export function fitCharts() {
  for (const [name, drawn] of Object.entries(charts)) {
    const room = document.getElementById(`chart-${name}`);
    drawn.setSize({ width: Math.max(room.clientWidth, 200), height: Math.max(room.clientHeight - 46, 80) });
  }
}
