// HTTP requests to the service, with the access token if there is one.

export function headers() {
  const token = sessionStorage.getItem("token");
  return token ? { Authorization: `Bearer ${token}` } : {};
}

const REFUSAL_TIMEOUT_MS = 5000;

// A body that nobody reads keeps its request in memory until the page is closed.
const discard = (response) => response.body?.cancel().catch(() => {});

// Whether reading requires another token than the present one.
export async function isRefused() {
  try {
    const response = await fetch("/api/v1/brief", { headers: headers(), signal: AbortSignal.timeout(REFUSAL_TIMEOUT_MS) });
    discard(response);
    return response.status === 401;
  } catch {
    return false;
  }
}

// The response; null if the request fails, is refused, or is given up by `signal`.
export async function fetchOk(address, signal = null) {
  try {
    const response = await fetch(address, { headers: headers(), signal });
    if (response.ok) return response;
    discard(response);
    return null;
  } catch {
    return null;
  }
}

export async function fetchJson(address, signal = null) {
  try {
    return await (await fetchOk(address, signal))?.json() ?? null;
  } catch {
    // The link was lost, or it was given up, within the answer.
    return null;
  }
}

const AGAIN_MS = 3000;

// What is read once: tried again until it comes or `isWanted()` is false, since the link may be lost for a moment.
export async function fetchPatiently(address, isWanted = () => true) {
  for (;;) {
    const found = await fetchJson(address);
    if (found || !isWanted()) return found;
    await new Promise((resolve) => setTimeout(resolve, AGAIN_MS));
    if (!isWanted()) return null;
  }
}

// A browser follows a link without a token. A file that requires one is fetched here.
document.addEventListener("click", async (event) => {
  const link = event.target.closest?.(".files a");
  if (!link || !sessionStorage.getItem("token") || link.href.startsWith("blob:")) return;
  event.preventDefault();
  const response = await fetchOk(link.href);
  if (!response) return;
  const download = document.createElement("a");
  download.href = URL.createObjectURL(await response.blob());
  if (link.hasAttribute("download")) download.download = link.pathname.split("/").at(-1);
  else download.target = "_blank";
  download.click();
  setTimeout(() => URL.revokeObjectURL(download.href), 60000);
});
