// Certificates: all of them, their documents, and whether their recordings still give the same numbers.

import { api, links } from "../api.js";
import { h } from "../dom.js";
import { empty, list } from "../list.js";
import { page } from "../shell.js";
import { t, when } from "../text.js";

page("certificates", async (main) => {
  const place = h("section", { class: "panel stack" });
  main.append(h("h1", {}, t("page.certificates")), place);
  await list(place, {
    load: (q) => api.certificates({ ...q, limit: 50 }),
    label: t("page.certificates"),
    head: ["number", "board", "verdict", "issued", "operator", "documents", "verify"].map((key) => t(`certificates.${key}`)),
    row: (c) => [c.number, h("a", { href: links.board(c.board) }, c.board), t(`verdict.${c.verdict}`), when(c.issued_at), c.operator ?? "",
      h("span", { class: "row" }, ["pdf", "csv", "json"].map((kind) => h("a", { href: links.document(c.number, kind), download: "" }, kind.toUpperCase()))),
      verifyButton(c.number)],
    empty: empty("certificates.empty", "/", "boards.first"),
  });
});

/** Computes the certificate again from its recording and says in one sentence what came of it. */
function verifyButton(number) {
  const told = h("output", { class: "small" });
  const button = h("button", {
    type: "button", "aria-label": t("certificates.verify_number", { number }),
    onclick: async () => {
      button.disabled = true;
      told.textContent = t("certificates.verifying");
      try {
        const { valid, differences } = await api.verify(number);
        told.textContent = valid ? t("certificates.valid") : t("certificates.not_valid", { differences: (differences ?? []).map((d) => d.name ?? d.path ?? d).join(", ") });
      } catch (problem) {
        told.textContent = problem.message;
      }
      button.disabled = false;
    },
  }, t("certificates.verify"));
  return h("span", { class: "row" }, button, told);
}
