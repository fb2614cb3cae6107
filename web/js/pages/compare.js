// Two boards side by side (thesis tables 5.19 to 5.21), from the newest certificate of each; or any two certificates.

import { api, links } from "../api.js";
import { h, say, table } from "../dom.js";
import { figures, loadFigures } from "../figures.js";
import { page } from "../shell.js";
import { t, when } from "../text.js";

page("compare", async (main) => {
  const asked = new URLSearchParams(location.search);
  const known = (await api.boards({ limit: 200 })).items;
  const certified = known.filter((board) => board.certificates);
  const [a, b] = ["a", "b"].map((name, i) => h("input", {
    id: name, name, list: "known", autocomplete: "off", spellcheck: "false", required: true, value: asked.get(name) || certified[i]?.id || "",
  }));
  const error = h("p", { class: "error", role: "alert" });
  const result = h("section", { class: "stack" });
  const form = h("form", { class: "panel row compare" },
    ...[a, b].map((input, i) => h("div", {}, h("label", { for: input.id }, t(`compare.board_${i + 1}`)), input)),
    h("datalist", { id: "known" }, known.map(({ id }) => h("option", { value: id }))),
    h("button", { class: "main", type: "submit" }, t("compare.compare")), error);
  main.append(h("h1", {}, t("page.compare")), form, result);

  async function show() {
    say(error, null);
    result.replaceChildren();
    try {
      const [first, second] = await Promise.all([a, b].map((input) => newest(input.value.trim())));
      history.replaceState(null, "", links.compare(a.value.trim(), b.value.trim()));
      result.replaceChildren(...tables(first, second));
    } catch (problem) {
      say(error, problem);
    }
  }
  form.addEventListener("submit", (event) => { event.preventDefault(); show(); });
  await loadFigures();
  if (certified.length < 2 && !asked.get("b")) result.append(h("p", { class: "empty" }, t("compare.empty")));
  else await show();
});

/** The newest certificate of a board, or the one with this number. */
async function newest(word) {
  const { items } = await api.certificates({ board: word, limit: 1 });
  if (items.length) return api.certificate(items[0].number);
  const found = await api.certificates({ q: word, limit: 1 });
  if (found.items[0]?.number !== word) throw new Error(t("compare.no_certificate", { board: word }));
  return api.certificate(word);
}

function tables(first, second) {
  const name = first.board === second.board ? "number" : "board";
  const head = [t("compare.figure"), ...[first, second].flatMap((c) => ["x", "z"].map((axis) => ({ n: `${c[name]} ${axis}` })))];
  const columns = [first, second].flatMap((c) => ["x", "z"].map((axis) => figures(c.axes[axis] ?? {})));
  const part = (key, isIn) => h("section", { class: "panel stack" }, h("h2", {}, t(`compare.${key}`)), table(head,
    columns[0].map((figure, i) => ({ figure, i })).filter(({ figure }) => isIn(figure.path[0]))
      .map(({ figure, i }) => [`${figure.name}, ${figure.unit}`, ...columns.map((column) => ({ n: column[i].text }))]), { cards: true, label: t(`compare.${key}`) }));
  return [
    h("p", { class: "muted" }, [first, second].map((c) => t("compare.from", { board: c.board, number: c.number, date: when(c.issued_at) })).join(" · ")),
    part("parameters", (key) => key !== "rate" && key !== "position"),
    part("rate", (key) => key === "rate"),
    part("position", (key) => key === "position"),
  ];
}
