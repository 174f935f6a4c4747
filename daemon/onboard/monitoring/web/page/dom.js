// Elements of the page. Text is set as text; no HTML is parsed.

export const by = (id) => document.getElementById(id);

// An element with properties, and children or strings.
export function element(name, properties = {}, ...children) {
  const { dataset = {}, ...rest } = properties;
  const created = Object.assign(document.createElement(name), rest);
  Object.assign(created.dataset, dataset);
  created.append(...children.filter((one) => one != null));
  return created;
}

export function button(label, action, properties = {}) {
  const created = element("button", { type: "button", textContent: label, ...properties });
  created.addEventListener("click", action);
  return created;
}

// Set a text; unknown values are a dash. Unchanged text is left alone, so that readers are not interrupted.
export function text(id, value) {
  const shown = value == null ? "–" : String(value);
  if (by(id).textContent !== shown) by(id).textContent = shown;
}

// Redraw `container` with `draw()` only if `key` changed.
export function redraw(container, key, draw) {
  if (container.dataset.shown === key) return;
  container.dataset.shown = key;
  container.replaceChildren(...draw());
}
