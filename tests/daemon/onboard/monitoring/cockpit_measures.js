// What a test measures on the operator's page. The value of the script is an object of functions.
(() => {
  const isSeen = (one) => one.checkVisibility({ checkOpacity: true, checkVisibilityCSS: true }) && one.getClientRects().length > 0;
  const name = (one) => one.id || one.dataset.command || one.className || one.textContent.trim().slice(0, 30) || one.tagName;
  // Behind an open dialog nothing can be read or touched.
  const root = () => document.querySelector("dialog[open]") ?? document;
  const seen = (selector) => [...root().querySelectorAll(selector)].filter(isSeen);
  const box = (one) => one.getBoundingClientRect();
  const overlap = (a, b) => Math.min(Math.min(a.right, b.right) - Math.max(a.left, b.left), Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top));

  // The part of an element that its scrolling ancestors leave visible; null if there is none.
  function shown(one) {
    let area = box(one);
    for (let up = one.parentElement; up; up = up.parentElement) {
      if (getComputedStyle(up).overflow === "visible") continue;
      const by = box(up);
      area = { left: Math.max(area.left, by.left), right: Math.min(area.right, by.right), top: Math.max(area.top, by.top), bottom: Math.min(area.bottom, by.bottom) };
      if (area.left >= area.right || area.top >= area.bottom) return null;
    }
    return area;
  }

  function outside() {
    const primary = seen("#phase, #simulated, #verdict-chip, #theme, #phase-button, #phase-second, #open-commands, .lamp, #alarm-bar button, #tabs button, #verdict, #left div, #open-settings, .g-cell, .g-bar, #guidance .age, #map-tools > *, #map-legend, .leaflet-control");
    const dialogs = [...document.querySelectorAll("dialog[open], dialog[open] h2, dialog[open] > form > .commands button")];
    return [...primary, ...dialogs].filter((one) => {
      const { left, top, right, bottom } = box(one);
      return left < -0.5 || top < -0.5 || right > innerWidth + 0.5 || bottom > innerHeight + 0.5;
    }).map(name);
  }

  function overlapping() {
    const regions = seen("header, #alarm-bar, #connection-lost, #map-panel, #verdict-panel, .page, #tabs, #action-bar")
      .filter((one) => shown(one) && !(one.id === "verdict-panel" && document.querySelector("#pages").contains(one)));
    const controls = seen("button, input, select, summary, .files a, .leaflet-bar a, .leaflet-control-scale-line, #map-attribution, #map-measured, .g-cell")
      .filter((one) => shown(one));
    const found = [];
    for (const many of [regions, controls]) {
      many.forEach((one, k) => many.slice(k + 1).forEach((other) => {
        if (!one.contains(other) && !other.contains(one) && overlap(shown(one), shown(other)) > 1) found.push(`${name(one)} / ${name(other)}`);
      }));
    }
    return found;
  }

  const smallTexts = () => seen("body *").filter((one) => [...one.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim()))
    .filter((one) => parseFloat(getComputedStyle(one).fontSize) < 12).map(name);

  const smallTargets = () => seen("button, select, input, summary, .files a, #map-tools *, .leaflet-bar a").filter((one) => one.matches("button, select, input, summary, a"))
    .filter((one) => box(one).width < 47.5 || box(one).height < 47.5).map((one) => `${name(one)} ${box(one).width}x${box(one).height}`);

  const clipped = () => seen("dialog button, dialog label, dialog input, dialog select, #phase-button, #phase-second, #alarm-bar button:not(.what), .verdict .word, #tabs .label, .lamp .name, .lamp .value, .verdict .since, .g-label, .g-value, .g-cell, .thumb .t-mark")
    .filter((one) => one.scrollWidth > one.clientWidth + 1).map((one) => `${name(one)}: ${one.textContent}`);

  // What a scrolling or clipping ancestor hides, of what has to be whole.
  const cut = () => seen(".g-cell, .g-value, .g-bar, #guidance .age, #map-tools > *, #map-legend, #verdict *, .leaflet-control, .thumb .t-mark").filter((one) => {
    const [whole, part] = [box(one), shown(one)];
    const isCut = !part || part.bottom - part.top < whole.height - 1 || part.right - part.left < whole.width - 1;
    // The strip scrolls; what it shows of a thumbnail's height is whole.
    return isCut && !(one.matches("#strip *") && (!part || part.bottom - part.top >= whole.height - 1));
  }).map((one) => `${name(one)}: ${one.textContent.trim().slice(0, 30)}`);

  const channel = (value) => value / 255 <= 0.04045 ? value / 255 / 12.92 : ((value / 255 + 0.055) / 1.055) ** 2.4;
  const rgb = (text) => text.match(/[\d.]+/g).map(Number);
  const luminance = ([r, g, b]) => 0.2126 * channel(r) + 0.7152 * channel(g) + 0.0722 * channel(b);
  function ground(one) {
    for (let up = one; up; up = up.parentElement) {
      const found = rgb(getComputedStyle(up).backgroundColor);
      if (found.length < 4 || found[3] === 1) return found;
    }
    return [255, 255, 255];
  }
  function contrast(one) {
    const [a, b] = [luminance(rgb(getComputedStyle(one).color)), luminance(ground(one))].sort((x, y) => y - x);
    return (a + 0.05) / (b + 0.05);
  }
  const contrasts = () => Object.fromEntries(seen(".verdict .word, .verdict .which, .verdict .since, #verdict-chip, #alarm-bar .what *, .faults li *, .lamp .name, .lamp .value, .p-alarm, #aircraft li *, .g-label, .g-value, #guidance .age, #phase-button, #left dd, #left dt")
    .filter((one) => one.textContent.trim()).map((one) => [`${name(one)} ${one.textContent.slice(0, 20)}`, contrast(one)]).sort((a, b) => b[1] - a[1]));

  // Colours as [r, g, b, alpha], 0 to 255 and 0 to 1.
  const rgba = (text) => { const [r, g, b, a = 1] = rgb(text); return [r, g, b, a]; };
  function over([r, g, b, a], [r2, g2, b2, a2]) {
    const alpha = a + a2 * (1 - a);
    const mix = (x, y) => alpha ? (x * a + y * a2 * (1 - a)) / alpha : 0;
    return [mix(r, r2), mix(g, g2), mix(b, b2), alpha];
  }
  const gray = ([r, g, b, a]) => { const y = 0.2126 * r + 0.7152 * g + 0.0722 * b; return [y, y, y, a]; };

  // The contrast as it is painted: translucent grounds, opacity and the gray of a lost connection included.
  function paintedContrast(one) {
    let [ink, under] = [rgba(getComputedStyle(one).color), [0, 0, 0, 0]];
    for (let up = one; up; up = up.parentElement) {
      const style = getComputedStyle(up);
      [ink, under] = [ink, under].map((colour) => over(colour, rgba(style.backgroundColor)));
      if (style.filter.includes("grayscale")) [ink, under] = [gray(ink), gray(under)];
      [ink, under] = [ink, under].map(([r, g, b, a]) => [r, g, b, a * Number(style.opacity)]);
      if (up.matches("dialog")) break;
    }
    const [a, b] = [ink, under].map((colour) => luminance(over(colour, [255, 255, 255, 1]))).sort((x, y) => y - x);
    return (a + 0.05) / (b + 0.05);
  }
  // Every text and field with less than 4.5:1 (WCAG 2.2, 1.4.3), large ones too. Disabled controls are exempt.
  const weakTexts = () => seen("body *, dialog *").filter((one) => !one.closest(":disabled") && !one.closest("option, svg, .unseen")
    && (one.matches("select, input") || [...one.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim())))
    .map((one) => [one, paintedContrast(one)]).filter(([, value]) => !(value >= 4.5))
    .map(([one, value]) => `${name(one)} ${one.textContent.trim().slice(0, 20)} ${value.toFixed(2)}`);

  // The contrast of a text on a canvas with its surroundings, over the worst colour beneath the canvas: that of three quarters of
  // the pixels at a distance of two pixels from its ink, where its halo or its ground is. The others are parts of further strokes.
  const [RING_PX, RING_SHARE] = [2, 0.25];
  function canvasContrast(context, { left, top, width, height }, ink, shade = (colour) => colour) {
    const { data, width: w, height: h } = context.getImageData(Math.floor(left), Math.floor(top), Math.ceil(width) + 1, Math.ceil(height) + 1);
    const isInk = (x, y) => {
      const k = 4 * (y * w + x);
      return data[k + 3] === 255 && [0, 1, 2].every((c) => Math.abs(data[k + c] - ink[c]) <= 6);
    };
    const own = luminance(shade([...ink, 1]));
    const found = [];
    for (let y = RING_PX; y < h - RING_PX; y += 1) {
      for (let x = RING_PX; x < w - RING_PX; x += 1) {
        let distance = Infinity;
        for (let dy = -RING_PX; dy <= RING_PX; dy += 1) {
          for (let dx = -RING_PX; dx <= RING_PX; dx += 1) {
            if (isInk(x + dx, y + dy)) distance = Math.min(distance, Math.max(Math.abs(dx), Math.abs(dy)));
          }
        }
        if (distance !== RING_PX) continue;
        const k = 4 * (y * w + x);
        const beneath = luminance(shade(over([data[k], data[k + 1], data[k + 2], data[k + 3] / 255], [...ink, 1])));
        found.push((Math.max(own, beneath) + 0.05) / (Math.min(own, beneath) + 0.05));
      }
    }
    return found.sort((a, b) => a - b)[Math.floor(RING_SHARE * found.length)] ?? null;
  }
  const colourOf = (text) => {
    const pen = document.createElement("canvas").getContext("2d");
    pen.fillStyle = text;
    pen.fillRect(0, 0, 1, 1);
    return [...pen.getImageData(0, 0, 1, 1).data].slice(0, 3);
  };
  // Labels of the plan on the map with less than 4.5:1, and those that a control covers.
  async function weakLabels() {
    if (!document.querySelector("#map")) return [];
    const { planShown } = await import("/map.js");
    const canvas = document.querySelector(".leaflet-plan-pane canvas");
    if (!canvas || !isSeen(canvas)) return [];
    const [origin, context] = [box(canvas), canvas.getContext("2d", { willReadFrequently: true })];
    const shade = getComputedStyle(document.querySelector("main > *")).filter.includes("grayscale") ? gray : (colour) => colour;
    const controls = seen("#map-tools > *, #map-legend, #map-attribution, #map .leaflet-control").map(box);
    return planShown().labels.flatMap((one) => {
      const value = canvasContrast(context, one, colourOf(one.ink), shade);
      const place = { left: origin.left + one.left, right: origin.left + one.left + one.width, top: origin.top + one.top, bottom: origin.top + one.top + one.height };
      return [...(value >= 4.5 ? [] : [`${one.text} ${value?.toFixed(2)}`]), ...(controls.some((by) => overlap(place, by) > 1) ? [`${one.text} is covered`] : [])];
    });
  }

  const scrolls = () => document.documentElement.scrollHeight > innerHeight || document.documentElement.scrollWidth > innerWidth || scrollY !== 0;

  window.canvasContrast = canvasContrast;
  window.colourOf = colourOf;
  window.measures = async () => ({ weakLabels: await weakLabels(), outside: outside(), overlapping: overlapping(), smallTexts: smallTexts(), smallTargets: smallTargets(), clipped: clipped(), cut: cut(), weakTexts: weakTexts(),
    weakest: Object.entries(contrasts()).at(-1), scrolls: scrolls() });
  window.centre = (selector) => {
    const one = seen(selector)[0];
    if (!one) return null;
    one.scrollIntoView({ block: "nearest" });
    const { left, top, width, height } = box(one);
    const [x, y] = [left + width / 2, top + height / 2];
    const hit = document.elementFromPoint(x, y);
    return one === hit || one.contains(hit) ? [x, y] : null;
  };
  return true;
})()
