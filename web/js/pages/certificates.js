// Certificates: all of them, their documents, and whether their recordings still give the same numbers.

import { api, links } from "../api.js";
import { h, say } from "../dom.js";
import { empty, list, toWorkbench } from "../list.js";
import { page } from "../shell.js";
import { t, when } from "../text.js";

page("certificates", async (main) => {
  const place = h("section", { class: "panel stack" });
  main.append(h("h1", {}, t("page.certificates")), place, certifyCard());
  await list(place, {
    load: (q) => api.certificates({ ...q, limit: 50 }),
    label: t("page.certificates"),
    head: ["number", "board", "verdict", "issued", "operator", "documents", "workbench", "verify"].map((key) => t(key === "workbench" ? "page.workbench" : `certificates.${key}`)),
    row: (c) => [c.number, h("a", { href: links.board(c.board) }, c.board), t(`verdict.${c.verdict}`), when(c.issued_at), c.operator ?? "",
      h("span", { class: "row" }, ["pdf", "csv", "json"].map((kind) => h("a", { href: links.document(c.number, kind), download: "" }, kind.toUpperCase()))),
      toWorkbench(c.recording, c.number), verifyButton(c.number)],
    empty: empty("certificates.empty", "/", "boards.first"),
  });
});

/** A recording from a file becomes a certificate, or a sentence that says what is wrong with it. */
function certifyCard() {
  const file = h("input", { id: "file", type: "file", accept: ".csv,.gz,.parquet" });
  const error = h("p", { class: "error", role: "alert" });
  const told = h("output", {});
  file.addEventListener("change", async () => {
    if (!file.files.length) return;
    say(error, null);
    told.textContent = t("certificates.certifying");
    file.disabled = true;
    try {
      const recording = await api.upload(file.files[0]);
      const { number } = await api.certify({ recording: recording.id });
      told.replaceChildren(h("a", { href: links.document(number, "pdf"), download: "" }, t("certificates.certified", { number })));
    } catch (problem) {
      told.textContent = "";
      say(error, problem);
    }
    file.disabled = false;
    file.value = "";
  });
  return h("section", { class: "panel stack" }, h("h2", {}, t("certificates.from_file")),
    h("div", {}, h("label", { for: "file" }, t("certificates.file")), file), error, told);
}

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
