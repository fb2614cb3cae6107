// The thesis' tables, computed again from its own readings, beside what it printed.

import { api } from "../api.js";
import { h, table } from "../dom.js";
import { page } from "../shell.js";
import { fixed, has, minus, plain, sentence, t } from "../text.js";

page("thesis", async (main) => {
  const waiting = h("p", { class: "muted" }, t("thesis.computing"));
  main.append(waiting);
  const report = await api.thesis();
  waiting.replaceWith(
    h("header", { class: "stack" },
      h("h1", {}, t("thesis.headline", report.statistics)),
      h("p", {}, `${t("thesis.lines", report.lines)} ${t("thesis.purpose")}`)),
    h("section", { class: "panel stack" },
      h("h2", {}, t("thesis.disagreements", { count: report.disagreements.length })),
      h("ol", { class: "findings" }, report.disagreements.map(({ code, values }) => h("li", {}, sentence({ code, values: { ...values, table: words("place", values.table) } }))))),
    h("section", { class: "stack" },
      h("h2", {}, t("thesis.tables")), h("p", { class: "muted" }, t("thesis.how")),
      h("div", { class: "columns" }, report.tables.map(oneTable))),
  );
});

/** Rows as the thesis has them (board, axis, set-point), a column for each quantity. */
function oneTable({ table: number, title, rows }) {
  const quantities = [...new Map(rows.map((row) => [row.quantity, row])).values()];
  const lines = new Map();
  for (const row of rows) {
    const name = [row.board && `${row.board} ${row.axis}`, words("row", row.row)].filter(Boolean).join(" · ");
    if (!lines.has(name)) lines.set(name, {});
    lines.get(name)[row.quantity] = row;
  }
  // One test's table says its board and axis in the title already.
  const isOneTest = new Set(rows.map((row) => row.board + row.axis)).size === 1;
  // A unit that a column shares stands in its head, any other beside its value.
  const units = new Map(quantities.map(({ quantity }) => [quantity, new Set(rows.filter((row) => row.quantity === quantity).map((row) => row.unit))]));
  const unitOf = (name) => (units.get(name).size === 1 ? shownUnit([...units.get(name)][0]) : "");
  const own = (row) => (row && units.get(row.quantity).size > 1 ? shownUnit(row.unit) : "");
  return h("details", { class: "panel" },
    h("summary", {}, `${words("place", number)} ${sentence(title)}`, rows.some((row) => row.same === false) ? h("span", { class: "differs" }, " ≠") : null),
    table(["", ...quantities.map(({ quantity }) => ({ n: [quantityName(quantity), unitOf(quantity)].filter(Boolean).join(", ") }))],
      [...lines].map(([name, cells]) => [isOneTest ? name.split(" · ").at(-1) : name, ...quantities.map(({ quantity }) => cell(cells[quantity], own(cells[quantity])))]),
      { compact: true, label: sentence(title) }));
}

const quantityName = (quantity) => (has(`thesis_quantity.${quantity}`) ? t(`thesis_quantity.${quantity}`) : quantity);
const number = (value, decimals) => (typeof value === "number" ? (decimals == null ? plain(value) : fixed(value, decimals)) : words("row", String(value ?? "–")));
const shownUnit = (unit) => (unit === "1" ? "" : unit);

/** What the thesis' tables call a row or a place, in the reader's language; a number is its own name. */
function words(kind, name) {
  const key = `thesis_${kind}.${name.toLowerCase().replace(/[^a-z0-9]+/g, "_")}`;
  return has(key) ? t(key) : minus(name);
}

function cell(row, unit) {
  if (!row) return "";
  const written = (value) => [number(value, row.decimals), unit].filter(Boolean).join(" ");
  if (row.same !== false) return { n: written(row.printed ?? row.recomputed) };
  return { n: `${number(row.printed, row.decimals)} ≠ ${written(row.recomputed)}`, class: "differs" };
}
