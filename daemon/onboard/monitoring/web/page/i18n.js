// Strings of the page, from catalogs by language. The module is ready when its catalogs are loaded.

export const LANGUAGES = { en: "English", de: "Deutsch", fr: "Français", es: "Español", zh: "中文" };
const PSEUDO = "qps";
const CATALOGS = ["page", "map", "alarm", "landing"];
// Sentences of the service. Their English is in every record; only other languages need the catalog.
const SERVER_CATALOG = "server";
const PSEUDO_LETTERS = { a: "å", e: "é", i: "î", o: "ö", u: "ü", A: "Å", E: "É", I: "Î", O: "Ö", U: "Ü", n: "ñ", c: "ç" };

function preferred() {
  const asked = new URLSearchParams(location.search).get("lang");
  if (asked === PSEUDO || asked in LANGUAGES) return asked;
  const stored = localStorage.getItem("language");
  if (stored in LANGUAGES) return stored;
  return navigator.languages.map((one) => one.slice(0, 2)).find((one) => one in LANGUAGES) || "en";
}

export const language = preferred();
const isPseudo = language === PSEUDO;
const plurals = new Intl.PluralRules(isPseudo ? "en" : language);
export const locale = isPseudo ? "en" : language;

const RETRY_MS = 1000;

// A page without its texts would show codes: tried until the catalog comes.
async function load(name) {
  for (;;) {
    try {
      const response = await fetch(`messages/${locale}/${name}.json`);
      if (response.ok) return await response.json();
      if (response.status === 404) return {};
    } catch {
      // The network changed or is down.
    }
    await new Promise((resolve) => setTimeout(resolve, RETRY_MS));
  }
}

const isServerTranslated = isPseudo || locale !== "en";
const messages = Object.assign({}, ...await Promise.all([...CATALOGS, ...(isServerTranslated ? [SERVER_CATALOG] : [])].map(load)));

// Accented and a third longer, so that untranslated and clipped texts are seen. Placeholders are kept.
function pseudo(text) {
  const accented = text.replace(/\{\w+\}|[A-Za-z]/g, (part) => PSEUDO_LETTERS[part] || part);
  return `[${accented}${"·".repeat(Math.ceil(text.length * 0.3))}]`;
}

export const knows = (code) => code in messages;

function template(code, parameters) {
  if (code in messages) return messages[code];
  if (typeof parameters?.n === "number") {
    return messages[`${code}.${plurals.select(parameters.n)}`] ?? messages[`${code}.other`];
  }
  return undefined;
}

// The text of a code. `{name}` is replaced by the parameter of that name; a text with `n` may have plural forms.
export function t(code, parameters = {}) {
  const found = template(code, parameters);
  if (found === undefined) return code;
  return (isPseudo ? pseudo(found) : found)
    .replace(/\{(\w+)\}/g, (whole, name) => name in parameters ? String(parameters[name]) : whole);
}

// The text of a message of the service; a parameter is a text, a message or a list of both. Undefined if its code is unknown.
function messageText(message) {
  if (typeof message === "string") return message;
  if (Array.isArray(message)) return message.map(messageText).join("; ");
  if (!knows(`server.${message.code}`)) return undefined;
  const parameters = Object.entries(message.parameters).map(([name, value]) => [name, messageText(value) ?? ""]);
  return t(`server.${message.code}`, Object.fromEntries(parameters));
}

const isTranslated = (record) => isServerTranslated && Boolean(record?.message) && knows(`server.${record.message.code}`);

// The text of a record of the service: translated if it has a message, else its English sentence.
export const serverText = (record, sentence = record?.sentence) => isTranslated(record) ? messageText(record.message) : sentence ?? "";

// Texts of a list of the service, such as `missing`.
export const serverTexts = (record, key) => (isServerTranslated && record[`${key}_messages`]?.map((one) => messageText(one))) || record[key] || [];

// The language of the text of a record.
export const serverLanguage = (record) => isTranslated(record) ? locale : "en";

// Fill the elements of a document that name a code.
export function fill(root = document) {
  for (const one of root.querySelectorAll("[data-t]")) one.textContent = t(one.dataset.t);
  for (const one of root.querySelectorAll("[data-t-label]")) one.setAttribute("aria-label", t(one.dataset.tLabel));
  for (const one of root.querySelectorAll("[data-t-title]")) one.title = t(one.dataset.tTitle);
}

export function setLanguage(chosen) {
  localStorage.setItem("language", chosen);
  const address = new URL(location.href);
  address.searchParams.delete("lang");
  location.replace(address);
}

document.documentElement.lang = locale;
