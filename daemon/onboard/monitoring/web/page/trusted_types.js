// Trusted Types policy: HTML from a library becomes text, except the fixed elements below.
// The content security policy enables it (require-trusted-types-for).

const DRAWN = new Set([
  "<svg/>",
  '<v:shape adj="1"/>',
  '<span aria-hidden="true">+</span>',
  '<span aria-hidden="true">&#x2212;</span>',
  '<span aria-hidden="true">&#215;</span>',
]);

globalThis.trustedTypes?.createPolicy("default", {
  createHTML: (html) => DRAWN.has(html) ? html : html.replaceAll("&", "&amp;").replaceAll("<", "&lt;"),
  // The one script that is named by an address: the service worker.
  createScriptURL: (address) => {
    if (address === "worker.js") return address;
    throw new TypeError(`no script ${address}`);
  },
});
