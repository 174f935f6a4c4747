// A flight that the page replays to itself: its connections and requests are answered here, after the page's files came from
// the service. Before it runs, `replay` holds { plan, thumbnail, quicklook }, the pictures as base64.
(() => {
  const LINE = 50;
  const HEARTBEAT_MS = 1000;
  const bytesOf = (text) => Uint8Array.from(atob(text), (one) => one.charCodeAt(0));
  const [thumbnail, quicklook] = [bytesOf(replay.thumbnail), bytesOf(replay.quicklook)];
  // Of the gaps the replay holds bytes outside the heap of JavaScript, in which the page is measured.
  const segments = [];
  const encoder = new TextEncoder();
  let [number, sequence, telemetry, latest] = [0, 0, null, {}];

  window.WebSocket = class {
    constructor(address) {
      if (!String(address).includes("/telemetry")) return;
      telemetry = this;
      setTimeout(() => this.onopen?.(), 0);
    }
    send() {}
    close() {}
  };

  const json = (value) => new Response(JSON.stringify(value));
  const ANSWERS = [
    [/thumbnail\.jpg$/, () => new Response(thumbnail)],
    [/quicklook\.jpg$/, () => new Response(quicklook)],
    [/histogram\.json$/, () => json({ SU00: [0, 5, 9, 5], R: [0, 1, 2, 3] })],
    [/residuals\.json$/, () => json({ width_px: 900, height_px: 600, overlaps: [], vectors: [] })],
    [/\/plan$/, () => json({ ...replay.plan, retakes: [] })],
    [/\/advice$/, () => new Response(new Blob(['{"planned_m": 1e5, "covered_m": 5e4, "hole_m2": 1e3, "notes": [], "segments": [',
      ...segments.flatMap((one, k) => k ? [",", one] : [one]), "]}"]))],
    [/\/advice\//, () => new Response("x".repeat(200 * segments.length))],
    [/\/maps$/, () => json([])],
    [/\/limits$/, () => json({})],
  ];
  window.fetch = async (address) => {
    await new Promise((resolve) => setTimeout(resolve, 20));
    const [, answer] = ANSWERS.find(([pattern]) => pattern.test(address)) ?? [];
    return answer?.() ?? new Response("", { status: 404 });
  };

  // One in a hundred has to be flown again, one in ten is usable. Lines go to and fro.
  function exposure() {
    number += 1;
    sequence += 1;
    const [line, index] = [Math.floor((number - 1) / LINE), (number - 1) % LINE];
    const along = line % 2 ? LINE - 1 - index : index;
    const [y, x] = [47.07 + 6e-4 * along, 15.43 + 0.003 * line];
    const square = [[y - 3e-4, x - 0.0015], [y - 3e-4, x + 0.0015], [y + 3e-4, x + 0.0015], [y + 3e-4, x - 0.0015]];
    const verdict = number % 100 === 99 ? "refly" : number % 10 === 9 ? "usable" : "good";
    if (verdict === "refly") {
      segments.push(encoder.encode(JSON.stringify({ line: `A${line}`, strip: `S${line}`, kind: "hole", from_m: 66 * along, to_m: 66 * along + 66,
        at: [[y, x], [y + 6e-4, x]], reasons: [`exposure ${number}: refly (SIGMA0)`],
        holes: [{ area_m2: 5000, images: 1, needed: 2, bands: [], rings: [square] }] })));
    }
    return { number, sequence, step: "processed", verdict, line: `A${line}`, frames: 13, mark_sigma_ns: 25, duration_s: 0.5,
      missing: [], footprint: square, place: { latitude_deg: y, longitude_deg: x, height_m: 1395, leap_seconds: 18 },
      figures: { sigma0_px: 0.01, dc_k: 11.8, tie_points_pp: 900, tilt_deg: 1 }, valid_area: { share: 0.99, rings: [] },
      findings: [{ flag: "SIGMA0", sentence: "Look.", verdict }] };
  }

  function send(exposures) {
    const places = exposures.map(({ sequence: of, place }) => ({ sequence: of, at: [place.latitude_deg, place.longitude_deg] }));
    const history = exposures.map((one) => ({ sequence: one.sequence, number: one.number, sigma0_px: 0.01, dc_k: 11.8,
      time_sigma_ns: 25, temperatures_c: { a: 32.1 } }));
    if (exposures.length) {
      const { place, line } = exposures.at(-1);
      latest = { position: { ...place, age_s: 0.1 }, lines: { flown: [], current: line, next: `A${Number(line.slice(1)) + 1}` } };
    }
    sequence += 1;
    telemetry.onmessage({ data: JSON.stringify({ version: 1, sequence, software: "replay", phase: "flying", simulated: true,
      mission: { id: "replay", path: "/replay", rig: "small" }, faults: [], last_number: number,
      verdicts: { good: number, usable: 0, refly: 0 }, exposures, track: places, history,
      status: { phase: "flying", mono_ns: String(1e9 * sequence), temperatures_c: { a: 32.1 }, clock_sigma_ns: 25, queue: 0,
        ledger: { triggers: { triggers: number, lost: 0 } }, exposures_left: 9999, ...latest } }) });
  }

  // Without records the page would take the connection for lost.
  setInterval(() => telemetry?.onmessage && send([]), HEARTBEAT_MS);

  // Replay up to an exposure, some in each record; the number that was reached.
  window.replayTo = async (wanted, perRecord) => {
    while (number < wanted) {
      send(Array.from({ length: Math.min(perRecord, wanted - number) }, exposure));
      await new Promise((resolve) => setTimeout(resolve, 15));
    }
    return number;
  };
})();
