// A formula of the student's own, as an effect beside the library's.

import { h, say } from "../dom.js";
import { t } from "../text.js";

/** The form; add(own) fits it and may refuse with the server's sentence. */
export function formulaForm(add) {
  const field = (name, value, attributes = {}) => {
    const input = h("input", { id: `own-${name}`, name, value, autocomplete: "off", spellcheck: "false", required: true, ...attributes });
    return [input, h("div", {}, h("label", { for: input.id }, t(`workbench.own.${name}`)), input)];
  };
  const [formula, formulaBox] = field("formula", "", { placeholder: "abs(rate_dps) * (temperature_c - 25)", maxlength: "400" });
  const [name, nameBox] = field("name", "my_effect", { maxlength: "40" });
  const [parameter, parameterBox] = field("parameter", "k", { maxlength: "20" });
  const acts = h("select", { id: "own-acts" }, ["output", "rate", "angle"].map((one) => h("option", { value: one }, t(`workbench.own.acts_${one}`))));
  const error = h("p", { class: "error", role: "alert" });
  return h("details", { class: "panel own-formula" }, h("summary", {}, t("workbench.own.title")),
    h("form", {
      class: "stack", novalidate: true,
      onsubmit: async (event) => {
        event.preventDefault();
        say(error, null);
        try {
          await add({ name: name.value.trim(), formula: formula.value.trim(), parameter: parameter.value.trim(), unit: "", acts: acts.value });
        } catch (problem) { say(error, problem); }
      },
    }, h("p", { class: "small muted" }, t("workbench.own.help")), formulaBox,
    h("div", { class: "three" }, nameBox, parameterBox, h("div", {}, h("label", { for: "own-acts" }, t("workbench.own.acts")), acts)),
    error, h("div", { class: "row" }, h("button", { type: "submit" }, t("workbench.own.add")))));
}
