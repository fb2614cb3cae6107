// Every text a person reads, and every number as it is written.

const LANGUAGES = ["en", "th"];
let texts = {};
export let language = "en";

const lookup = (tree, key) => key.split(".").reduce((node, part) => node?.[part], tree);

export function chooseLanguage(code) {
  localStorage.setItem("gyrobench.language", code);
  location.reload();
}

export async function loadTexts() {
  const kept = localStorage.getItem("gyrobench.language");
  const wished = kept ?? navigator.language.slice(0, 2);
  language = LANGUAGES.includes(wished) ? wished : "en";
  document.documentElement.lang = language;
  const answer = await fetch(`/i18n/${language}.json`);
  texts = await answer.json();
}

/** The text of a key; {name} and {name:3} (decimals) are filled from values. A missing key shows itself. */
export function t(key, values = {}) {
  const text = lookup(texts, key);
  if (typeof text !== "string") return key;
  return text.replace(/\{(\w+)(?::(\d+))?\}/g, (whole, name, digits) => (name in values ? word(values[name], digits) : whole));
}

function word(value, digits) {
  if (Array.isArray(value)) return value.map((item) => word(item, digits)).join(", ");
  if (value?.code) return sentence(value);
  // A number that a document printed stays as it was printed, but for its sign.
  if (typeof value !== "number") return String(value).replace(/^-(?=\d)/, "−");
  return digits === undefined ? plain(value) : fixed(value, Number(digits));
}

/** What the server says as {code, values}: a whole key, or one under `error` or `warning`. */
export function sentence({ code, values, sentence: said }) {
  const key = [code, `warning.${code}`, `error.${code}`].find(has);
  return key ? t(key, values) : (said ?? `${code} ${JSON.stringify(values ?? {})}`);
}

export const has = (key) => typeof lookup(texts, key) === "string";

/** Below root: the key in data-t becomes the text, those in data-t-placeholder, data-t-aria-label … the attributes. */
export function translate(root = document) {
  for (const node of root.querySelectorAll("[data-t]")) node.textContent = t(node.dataset.t);
  for (const attribute of ["placeholder", "aria-label", "title", "content"]) {
    for (const node of root.querySelectorAll(`[data-t-${attribute}]`)) {
      node.setAttribute(attribute, t(node.getAttribute(`data-t-${attribute}`)));
    }
  }
}

export const minus = (text) => text.replace("-", "−");

export const fixed = (value, digits) =>
  value == null || !Number.isFinite(value) ? "–" : minus(value.toFixed(digits)).replace(/^−(0(\.0*)?)$/, "$1");

export const plain = (value) =>
  Number.isInteger(value) ? minus(String(value)) : minus(String(Number(value.toPrecision(6))));

/** Decimals that show an uncertainty with two figures. */
export function decimals(uncertainty) {
  if (!(uncertainty > 0)) return null;
  // 0.00996 rounds to 0.010, one decimal fewer: ask the rounded figure, not the raw one.
  const exponent = Number(uncertainty.toExponential(1).split("e")[1]);
  return Math.max(0, 1 - exponent);
}

/** 5.9482(31): the value with its standard uncertainty in units of the last digits. */
export function withUncertainty(value, uncertainty, fallback = 4) {
  const digits = decimals(uncertainty);
  if (value == null) return "–";
  if (digits === null) return fixed(value, fallback);
  const shown = uncertainty.toFixed(digits);
  return `${fixed(value, digits)}(${Number(shown) < 1 ? shown.replace(/^0\.0*/, "") : shown})`;
}

export const signed = (value, digits) => (value > 0 ? "+" : "") + fixed(value, digits);

export function duration(seconds) {
  const whole = Math.max(0, Math.round(seconds));
  return whole < 60
    ? t("time.seconds", { s: whole })
    : t("time.minutes", { min: Math.floor(whole / 60), s: whole % 60 });
}

/** An RFC 3339 time as local date and time, the same figures in both languages. */
export function when(iso) {
  if (!iso) return "–";
  const d = new Date(iso);
  const two = (n) => String(n).padStart(2, "0");
  return `${d.getFullYear()}-${two(d.getMonth() + 1)}-${two(d.getDate())} ${two(d.getHours())}:${two(d.getMinutes())}`;
}

export const clock = (date = new Date()) => date.toTimeString().slice(0, 8);
