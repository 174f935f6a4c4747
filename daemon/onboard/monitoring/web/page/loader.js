// Loads the page again if a file of it did not come, for example because the network changed meanwhile.
// No module: it must run when modules fail. A page is complete when its body has `data-ready`.

(() => {
  const STORE = "reloads";
  const FIRST_WAIT_MS = 1000;
  const WAIT_MAX_MS = 15000;
  // Without a further file. At 27 kB/s the largest takes 6 s.
  const STALL_MS = 45000;
  const PROBE_TIMEOUT_MS = 10000;
  let lastFileMs = performance.now();
  let isBroken = false;

  const isReady = () => document.body?.dataset.ready !== undefined;
  const sleep = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

  // Reload only when the service answers: the error page of a browser does not try again.
  async function recover() {
    if (isBroken) return;
    isBroken = true;
    const count = Number(sessionStorage.getItem(STORE)) || 0;
    const link = document.getElementById("link");
    if (link) link.textContent = "↻";
    for (let waitMs = Math.min(WAIT_MAX_MS, FIRST_WAIT_MS * 2 ** count); ; waitMs = Math.min(WAIT_MAX_MS, 2 * waitMs)) {
      await sleep(waitMs);
      try {
        const answer = await fetch(location.pathname, { cache: "no-store", signal: AbortSignal.timeout(PROBE_TIMEOUT_MS) });
        if (answer.ok) break;
      } catch {
        // The service does not answer yet.
      }
    }
    sessionStorage.setItem(STORE, String(Math.min(count + 1, 10)));
    location.reload();
  }

  // A file that does not come reports at its element; one that a module imports, at the element of the first module.
  addEventListener("error", (event) => {
    if ((!isReady() || document.readyState !== "complete") && ["SCRIPT", "LINK"].includes(event.target?.tagName)) recover();
  }, true);
  const files = new PerformanceObserver(() => { lastFileMs = performance.now(); });
  files.observe({ type: "resource" });
  const watching = setInterval(() => {
    if (isReady()) {
      clearInterval(watching);
      files.disconnect();
      sessionStorage.removeItem(STORE);
    } else if (performance.now() - lastFileMs > STALL_MS) recover();
  }, 500);
})();
