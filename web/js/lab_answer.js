// What a student hands in: nothing, or effects, each with what it could not be told from; confidence and reasons.

import { h, say } from "./dom.js";
import { runName } from "./lab_results.js";
import { t } from "./text.js";

/** answerForm({code, effects, answer, runs, onSubmit}) -> node; `effects` as /effects gives them, `answer` what was
 *  handed in before. What was begun is kept in this tab: thinking goes on in the workbench. */
export function answerForm({ code, effects, answer: handed, runs, onSubmit }) {
  const draft = `gyrobench.lab.${code}`;
  const begun = JSON.parse(sessionStorage.getItem(draft) ?? "null");
  const answer = begun ?? handed;
  const titles = [...effects].sort((a, b) => a.title.localeCompare(b.title));
  const rows = h("div", { class: "stack" });
  const error = h("p", { class: "error", role: "alert" });
  const send = h("button", { class: "main", type: "submit" }, t("lab.submit"));
  const found = h("div", { class: "stack inset" }, rows, h("div", { class: "row" }, h("button", { type: "button", onclick: () => addRow([""]) }, t("lab.another"))));
  const sure = h("p", { class: "small muted inset" }, t("lab.before_none"));
  const radio = (value, checked) => h("label", { class: "choice" }, h("input", { type: "radio", name: "claim", value, checked, onchange: show }), t(`lab.claim_${value}`));
  const confidence = h("input", { id: "confidence", type: "range", min: 0, max: 100, step: 5, value: answer?.confidence ?? 50, oninput: tell });
  const shown = h("output", { for: "confidence" });
  const reasoning = h("textarea", { id: "reasoning", rows: 5, maxlength: 4000 }, answer?.reasoning ?? "");
  const basis = h("select", { id: "basis" }, [...runs].reverse().map((run) => h("option", { value: run.recording, selected: run.recording === handed?.recording }, runName(run))), h("option", { value: "", selected: handed && !handed.recording }, t("lab.basis_none")));

  function tell() { shown.textContent = `${confidence.value} %`; }
  function show() {
    found.hidden = form.claim.value !== "found";
    sure.hidden = form.claim.value !== "none";
    if (!found.hidden && !rows.children.length) addRow([""]);
  }

  let serial = 0;
  const choice = (label, chosen) => h("select", { "aria-label": label }, h("option", { value: "" }, t("lab.choose")), titles.map(({ name, title }) => h("option", { value: name, selected: name === chosen }, title)));
  /** One finding: an effect, and behind it those it cannot be told from. */
  function addRow(names) {
    const number = ++serial;
    const ties = h("div", { class: "stack" });
    const addTie = (chosen = "") => {
      const tie = h("div", { class: "row nowrap" }, choice(t("lab.tied_with"), chosen), h("button", { type: "button", onclick: () => tie.remove() }, t("lab.remove")));
      ties.append(tie);
    };
    const row = h("fieldset", { class: "stack finding" }, h("legend", { class: "label" }, t("lab.finding")),
      h("div", { class: "row nowrap" }, choice(t("lab.finding"), names[0]), h("button", { type: "button", "aria-label": t("lab.remove_finding", { number }), onclick: () => row.remove() }, t("lab.remove"))),
      h("p", { class: "small muted tie-word" }, t("lab.tied_with")), ties,
      h("div", { class: "row" }, h("button", { type: "button", onclick: () => addTie() }, t("lab.add_tie"))));
    names.slice(1).forEach(addTie);
    rows.append(row);
  }

  const findings = () => (form.claim.value === "found"
    ? [...rows.children].map((row) => [...new Set([...row.querySelectorAll("select")].map(({ value }) => value).filter(Boolean))]).filter((names) => names.length)
    : []);
  const form = h("form", {
    class: "stack", novalidate: true,
    oninput: () => sessionStorage.setItem(draft, JSON.stringify({ claim: form.claim.value, findings: findings(), confidence: Number(confidence.value), reasoning: reasoning.value })),
    onsubmit: async (event) => {
      event.preventDefault();
      say(error, null);
      const claim = form.claim.value;
      const names = findings();
      if (!claim || (claim === "found" && !names.length)) { say(error, { message: t("lab.no_claim") }); return; }
      send.disabled = true;
      send.textContent = t("lab.submitting");
      sessionStorage.removeItem(draft);
      try {
        await onSubmit({ findings: names, confidence: Number(confidence.value), reasoning: reasoning.value.trim(), recording: basis.value || null });
      } catch (problem) {
        say(error, problem);
      }
      send.disabled = false;
      send.textContent = t("lab.submit");
    },
  },
  h("fieldset", { class: "stack" }, h("legend", { class: "label" }, t("lab.claim")),
    radio("found", begun ? begun.claim === "found" : Boolean(answer?.findings.length)), found, radio("none", begun ? begun.claim === "none" : Boolean(answer && !answer.findings.length)), sure),
  h("div", {}, h("label", { for: "reasoning" }, t("lab.reasoning")), reasoning),
  h("div", {}, h("div", { class: "row spread" }, h("label", { for: "confidence" }, t("lab.confidence")), shown), confidence),
  h("div", {}, h("label", { for: "basis" }, t("lab.basis")), basis),
  error, h("div", { class: "row" }, send));
  for (const names of answer?.findings ?? []) addRow(names);
  tell();
  show();
  return form;
}
