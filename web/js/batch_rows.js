// A row per board: verdict, key figures, or why there is no certificate.

import { links } from "./api.js";
import { $, h, table } from "./dom.js";
import { figureAt, figures } from "./figures.js";
import { t } from "./text.js";

const STEP = 200;
export const KEYS = [["bias_V"], ["scale_factor_V_per_dps"], ["rate", "nonlinearity_pct_fs"], ["position", "nonlinearity_pct_fs"]];
const same = (a, b) => a.join() === b.join();

/** {take(files), total(shown batch)}: keeps what it was given, shows the first ones, and more when asked. */
export function rowsPanel() {
  const files = new Map();
  let failedOnly = false;
  let most = STEP;
  const columns = ["x", "z"].flatMap((axis) => KEYS.map((path) => ({ axis, path })));
  const head = [{ n: "#" }, t("batch.file"), t("certificates.board"), t("certificates.verdict"),
    ...columns.map(({ axis, path }) => ({ n: `${axis} ${t(`batch.${path.at(-2) ?? ""}${path.at(-1)}`)}, ${figureAt(path).unit}` })), t("certificates.documents")];
  const place = h("div", { class: "of-batch" }, table(head, [], { label: t("batch.rows"), compact: true, cards: true }));
  const body = $("tbody", place);
  const more = h("button", { type: "button", hidden: true, onclick: () => { most += STEP; draw(); } }, t("list.more"));
  const all = h("button", { type: "button", "aria-pressed": "true", onclick: () => choose(false) });
  const failed = h("button", { type: "button", "aria-pressed": "false", onclick: () => choose(true) });

  function choose(only) {
    failedOnly = only;
    most = STEP;
    all.setAttribute("aria-pressed", String(!only));
    failed.setAttribute("aria-pressed", String(only));
    draw();
  }

  const wanted = (file) => !failedOnly || file.status === "failed" || file.verdict === "fail";

  function draw() {
    const shown = [...files.values()].filter(wanted).sort((a, b) => a.position - b.position);
    more.hidden = shown.length <= most;
    body.replaceChildren(...shown.slice(0, most).map((file) => (file.row ??= rowOf(file))));
  }

  function rowOf(file) {
    const first = [{ n: String(file.position) }, file.name, file.board ? h("a", { href: links.board(file.board) }, file.board) : "–"];
    const word = t(`batch.status_${file.status === "done" ? file.verdict : file.status}`);
    if (!file.axes) {
      const row = rowFrom([...first, h("span", { class: file.status === "failed" ? "failed" : "muted" }, word), file.error?.sentence ?? ""]);
      row.lastChild.colSpan = columns.length + 1;
      row.lastChild.classList.add("reason");
      return row;
    }
    const found = { x: figures(file.axes.x ?? {}), z: figures(file.axes.z ?? {}) };
    const numbers = columns.map(({ axis, path }) => ({ n: found[axis].find((figure) => same(figure.path, path))?.text ?? "–" }));
    const documents = h("span", { class: "row nowrap" }, ["pdf", "csv", "json"].map((kind) => h("a", { href: links.document(file.certificate, kind), download: "" }, kind.toUpperCase())));
    return rowFrom([...first, file.verdict === "fail" ? h("strong", { class: "failed" }, word) : word, ...numbers, documents]);
  }

  const rowFrom = (cells) => {
    const names = head.slice(0, cells.length);
    return $("tbody tr", table(names, [cells], { cards: true }));
  };

  return {
    node: h("section", { class: "panel stack" },
      h("div", { class: "row spread" }, h("h2", {}, t("batch.rows")), h("div", { class: "toggle", role: "group", "aria-label": t("batch.show") }, all, failed)), place, more),
    /** Files that are new or have changed. */
    take(changed) {
      for (const file of changed) files.set(file.position, file);
      if (changed.length) draw();
    },
    total(batch) {
      all.textContent = t("batch.all", { n: batch.files });
      failed.textContent = t("batch.failed", { n: batch.failed + (batch.verdicts.fail ?? 0) });
    },
    files: () => [...files.values()],
  };
}
