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

// Rows of `body`, one for each of `items` with a number, in their order. A row whose key is the same stays: a table of hundreds
// would else be made again with each record.
export function updateRows(body, items, keyOf, rowOf) {
  const present = new Map([...body.children].map((one) => [one.dataset.number, one]));
  const wanted = new Set(items.map((one) => String(one.number)));
  for (const [number, row] of present) if (!wanted.has(number)) row.remove();
  let next = body.firstElementChild;
  for (const one of items) {
    const key = keyOf(one);
    const found = present.get(String(one.number));
    let row = found;
    if (!found || found.dataset.key !== key) {
      row = rowOf(one);
      Object.assign(row.dataset, { number: one.number, key });
      if (found && found === next) next = found.nextElementSibling;
      found?.remove();
    }
    if (row === next) next = row.nextElementSibling;
    else body.insertBefore(row, next);
  }
}
