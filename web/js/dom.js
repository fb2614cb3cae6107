// Making elements. Values never become markup: text is text.

export const $ = (selector, root = document) => root.querySelector(selector);

/** h("td", {class: "n"}, "5.9"): an element with attributes, on… handlers and children (null is left out). */
export function h(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (value === true) node.setAttribute(name, "");
    else if (value !== false && value != null) node.setAttribute(name, value);
  }
  node.append(...children.flat().filter((child) => child != null));
  return node;
}

/** A table from head cells and rows; a cell is text, a node or {n: text} for a number set right. `label` names it; `cards` makes each row a list on a phone. */
export function table(head, rows, { label, compact = false, cards = false } = {}) {
  const names = head.map((content) => content?.n ?? content);
  const cell = (tag, content, attributes) => {
    const isNumber = content?.n !== undefined;
    return h(tag, { class: [isNumber && "n", content?.class].filter(Boolean).join(" ") || null, ...attributes }, isNumber ? content.n : content);
  };
  return h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": label },
    h("table", { class: [compact && "compact", cards && "cards"].filter(Boolean).join(" ") || null },
      h("thead", {}, h("tr", {}, head.map((content) => cell("th", content, { scope: "col" })))),
      h("tbody", {}, rows.map(([first, ...rest]) =>
        h("tr", {}, cell("th", first, { scope: "row" }), rest.map((content, i) => cell("td", content, { "data-label": names[i + 1] })))))));
}

/** Names and values; what has no value is left out. `wide` sets them in columns. */
export const facts = (pairs, wide = false) =>
  h("dl", { class: wide ? "facts wide" : "facts" }, pairs.filter(([, value]) => value != null && value !== "").map(
    ([name, value]) => h("div", {}, h("dt", {}, name), h("dd", {}, value))));

/** Puts the sentence of a problem near what caused it (and empties it again). */
export function say(place, problem) {
  place.textContent = problem ? problem.message : "";
}

/** A paragraph (or another element) that says since when it waits, until it is taken out: long work must not look dead.
 * ask() may give what is being done now, in words. */
export function waiting(text, ask = null, tag = "p") {
  const what = h("span", { role: "status" }, text);
  const seconds = h("span", { "aria-hidden": "true" });
  const node = h(tag, { class: "muted" }, what, seconds);
  const began = performance.now();
  const timer = setInterval(async () => {
    if (!node.isConnected) { clearInterval(timer); return; }
    seconds.textContent = ` ${Math.round((performance.now() - began) / 1000)} s`;
    const now = await ask?.().catch(() => null);
    if (now && what.textContent !== now) what.textContent = now;
  }, 1000);
  return node;
}
