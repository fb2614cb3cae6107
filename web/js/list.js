// A searchable list that grows by pages.

import { links } from "./api.js";
import { $, h, table } from "./dom.js";
import { has, t } from "./text.js";

const TYPING_MS = 200;

/** load({q, cursor}) -> {items, next}; row(item) -> cells. Shows `empty` (a sentence that says what will be here) when there is nothing. */
export async function list(place, { load, head, row, label, empty }) {
  const search = h("input", { type: "search", id: "search", "aria-label": t("list.search"), placeholder: t("list.search"), autocomplete: "off" });
  const body = h("div", {});
  const more = h("button", { type: "button", hidden: true }, t("list.more"));
  place.replaceChildren(h("div", { class: "search" }, search), body, more);
  let items = [];
  let next = null;
  let asked = 0;

  async function fetchPage(isFirst) {
    const mine = ++asked;
    const answer = await load({ q: search.value.trim(), cursor: isFirst ? null : next });
    if (mine !== asked) return;
    items = isFirst ? answer.items : [...items, ...answer.items];
    next = answer.next;
    more.hidden = next == null;
    body.replaceChildren(items.length ? table(head, items.map(row), { label, cards: true })
      : search.value ? h("p", { class: "empty" }, t("list.nothing", { q: search.value })) : empty());
  }
  let timer;
  search.addEventListener("input", () => { clearTimeout(timer); timer = setTimeout(() => fetchPage(true), TYPING_MS); });
  more.addEventListener("click", () => fetchPage(false));
  await fetchPage(true);
}

/** The sentence of an empty list and the button that fills it. */
export const empty = (key, href, button) => () =>
  h("div", { class: "empty stack" }, h("p", {}, t(key)), h("p", {}, h("a", { class: "button main", href }, t(button))));

/** What a recording is called; an example has its title in the reader's language. */
export const recordingName = (row) =>
  (row.source === "example" && has(`example.${row.name}.title`) ? t(`example.${row.name}.title`) : row.name || row.board || row.id);

/** A row's way into the workbench; a dash where nothing was recorded. */
export const toWorkbench = (recording, name) =>
  (recording ? h("a", { href: links.workbench(recording), "aria-label": t("workbench.open_named", { name }) }, t("workbench.open")) : "–");
