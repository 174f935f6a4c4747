// Asking the service over HTTP, with the token where one was given.

export function headers() {
  const token = sessionStorage.getItem("token");
  return token ? { Authorization: `Bearer ${token}` } : {};
}

// The answer; null where there is none or it is a refusal.
export async function asked(address) {
  try {
    const response = await fetch(address, { headers: headers() });
    return response.ok ? response : null;
  } catch {
    return null;
  }
}

export async function askedJson(address) {
  return (await asked(address))?.json() ?? null;
}

// A link to a file that is not for everybody: a browser follows links without a token.
document.addEventListener("click", async (event) => {
  const link = event.target.closest?.(".files a");
  if (!link || !sessionStorage.getItem("token") || link.href.startsWith("blob:")) return;
  event.preventDefault();
  const response = await asked(link.href);
  if (!response) return;
  const own = document.createElement("a");
  own.href = URL.createObjectURL(await response.blob());
  if (link.hasAttribute("download")) own.download = link.pathname.split("/").at(-1);
  else own.target = "_blank";
  own.click();
  setTimeout(() => URL.revokeObjectURL(own.href), 60000);
});
