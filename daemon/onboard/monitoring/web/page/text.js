// Whatever a library puts into the page as HTML becomes text, except what it draws itself.
// The browser asks this policy because of require-trusted-types-for in the content security policy.

const DRAWN = new Set([
  "<svg/>",
  '<v:shape adj="1"/>',
  '<span aria-hidden="true">+</span>',
  '<span aria-hidden="true">&#x2212;</span>',
  '<span aria-hidden="true">&#215;</span>',
]);

globalThis.trustedTypes?.createPolicy("default", {
  createHTML: (html) => DRAWN.has(html) ? html : html.replaceAll("&", "&amp;").replaceAll("<", "&lt;"),
});
