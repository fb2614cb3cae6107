// The thesis' tables, computed again from its own readings, beside what it printed.

import { api } from "../api.js";
import { h, table } from "../dom.js";
import { page } from "../shell.js";
import { fixed, has, plain, sentence, t } from "../text.js";

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
      h("ol", { class: "findings" }, report.disagreements.map((found) => h("li", {}, sentence(found))))),
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
    const name = [row.board && `${row.board} ${row.axis}`, row.row].filter(Boolean).join(" · ");
    if (!lines.has(name)) lines.set(name, {});
    lines.get(name)[row.quantity] = row;
  }
  // One test's table says its board and axis in the title already.
  const isOneTest = new Set(rows.map((row) => row.board + row.axis)).size === 1;
  return h("details", { class: "panel" },
    h("summary", {}, `${number} ${sentence(title)}`, rows.some((row) => row.same === false) ? h("span", { class: "differs" }, " ≠") : null),
    table(["", ...quantities.map(({ quantity, unit }) => ({ n: [quantityName(quantity), unit !== "1" && unit].filter(Boolean).join(", ") }))],
      [...lines].map(([name, cells]) => [isOneTest ? name.split(" · ").at(-1) : name, ...quantities.map(({ quantity }) => cell(cells[quantity]))]),
      { compact: true, label: sentence(title) }));
}

const quantityName = (quantity) => (has(`thesis_quantity.${quantity}`) ? t(`thesis_quantity.${quantity}`) : quantity);
const number = (value, decimals) => (typeof value === "number" ? (decimals == null ? plain(value) : fixed(value, decimals)) : String(value ?? "–"));

function cell(row) {
  if (!row) return "";
  const printed = number(row.printed, row.decimals);
  if (row.same !== false) return { n: row.printed == null ? number(row.recomputed, row.decimals) : printed };
  return { n: `${printed} ≠ ${number(row.recomputed, row.decimals)}`, class: "differs" };
}
