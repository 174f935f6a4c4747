// Tables that hold only the rows that are seen, and some before and after them. A table of any length has as many nodes as the
// screen has room for. `aria-rowcount` and `aria-rowindex` say how many rows there are and which these are.

import { element, updateRows } from "./dom.js";

// Rows before and after those that are seen, so that the Tab key and a screen reader find the next one.
const MARGIN = 8;
// Rows of a table that is not seen now.
const UNSEEN = 30;
const ROW_PX = 30;

// Top and bottom of the part of an element that its scrolling ancestors show.
function seenPart(one) {
  let { top, bottom } = one.getBoundingClientRect();
  for (let up = one.parentElement; up; up = up.parentElement) {
    if (getComputedStyle(up).overflowY === "visible") continue;
    const by = up.getBoundingClientRect();
    [top, bottom] = [Math.max(top, by.top), Math.min(bottom, by.bottom)];
  }
  return [top, bottom];
}

// Rows of `body`. `numberOf(item)` identifies a row, `keyOf(item)` is what it shows, `rowOf(item)` makes it.
export class VisibleRows {
  constructor(body, keyOf, rowOf) {
    Object.assign(this, { body, keyOf, rowOf, items: [], heights: new Map(), frame: 0 });
    this.table = body.closest("table");
    const columns = this.table.querySelectorAll("thead th").length || 1;
    [this.before, this.after] = ["before", "after"].map((name) => element("tbody", { className: `spacer ${name}`, ariaHidden: "true" },
      element("tr", {}, element("td", { colSpan: columns }))));
    body.before(this.before);
    body.after(this.after);
    this.table.querySelector("thead tr")?.setAttribute("aria-rowindex", "1");
    document.addEventListener("scroll", (event) => { if (event.target.contains?.(this.table)) this.later(); }, { capture: true, passive: true });
    new ResizeObserver(() => this.later()).observe(this.table.parentElement);
  }

  set(items) {
    this.items = items;
    this.table.setAttribute("aria-rowcount", String(items.length + 1));
    this.draw();
  }

  later() {
    if (!this.frame) this.frame = requestAnimationFrame(() => { this.frame = 0; this.draw(); });
  }

  // Height of a row; before it was drawn, that of the other rows.
  heightOf(item) {
    return this.heights.get(String(item.number)) ?? this.usualPx ?? ROW_PX;
  }

  // First row that is drawn, and the one after the last.
  range() {
    const { items } = this;
    if (!this.table.getClientRects().length) return [0, Math.min(UNSEEN, items.length)];
    const [top, bottom] = seenPart(this.table);
    let [first, last] = [0, 0];
    let y = (this.before.hidden ? this.body : this.before).getBoundingClientRect().top;
    for (const [at, item] of items.entries()) {
      if (y >= bottom) break;
      y += this.heightOf(item);
      if (y <= top) first = at + 1;
      last = at + 1;
    }
    return [Math.max(0, Math.min(first, items.length) - MARGIN), Math.min(items.length, Math.max(last, first) + MARGIN)];
  }

  measure() {
    let sum = 0;
    for (const row of this.body.children) {
      const { height } = row.getBoundingClientRect();
      if (!height) return;
      this.heights.set(row.dataset.number, height);
      sum += height;
    }
    if (sum) this.usualPx = sum / this.body.children.length;
  }

  draw() {
    const [first, last] = this.range();
    const focused = document.activeElement?.closest?.("tr");
    const focusedNumber = focused && this.body.contains(focused) ? focused.dataset.number : null;
    const seen = this.items.slice(first, last);
    updateRows(this.body, seen, this.keyOf, this.rowOf);
    for (const [at, row] of [...this.body.children].entries()) row.setAttribute("aria-rowindex", String(first + at + 2));
    this.measure();
    if (this.heights.size > 2 * this.items.length + UNSEEN) this.heights.clear();
    for (const [spacer, hidden] of [[this.before, this.items.slice(0, first)], [this.after, this.items.slice(last)]]) {
      const heightPx = hidden.reduce((sum, item) => sum + this.heightOf(item), 0);
      spacer.hidden = !hidden.length;
      spacer.querySelector("td").style.height = `${heightPx}px`;
    }
    if (focusedNumber !== null) this.refocus(focusedNumber);
  }

  // A row that was made again keeps the focus; one that scrolled away gives it to its table.
  refocus(number) {
    if (this.body.contains(document.activeElement)) return;
    const row = [...this.body.children].find((one) => one.dataset.number === number);
    const target = row?.querySelector("button") ?? this.table.closest("[tabindex]");
    target?.focus({ preventScroll: true });
  }
}
