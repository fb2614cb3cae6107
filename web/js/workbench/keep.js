// Keeping a model: a name, files that compensate, and a certificate that says which terms it has.

import { api, links } from "../api.js";
import { h, say } from "../dom.js";
import { t } from "../text.js";

/** ask() gives {recording, axis, effects} as they are now, after storing formulas of the student's own;
 * isSession: whether the recording may hold the six states that a certificate is made from. */
export function keepPanel(place, { ask, isSession }) {
  const name = h("input", { id: "model-name", required: true, maxlength: "100", autocomplete: "off" });
  const error = h("p", { class: "error", role: "alert" });
  const told = h("div", { class: "stack", "aria-live": "polite" });

  async function save(event) {
    event.preventDefault();
    say(error, null);
    told.replaceChildren();
    try {
      const model = await api.saveModel({ name: name.value.trim(), ...(await ask()) });
      told.replaceChildren(h("p", {}, t("workbench.keep.kept", { name: model.name })),
        h("div", { class: "row" },
          ["json", "h", "py"].map((kind) => h("a", { class: "button", href: links.model(model.id, kind), download: "" }, t(`workbench.keep.${kind}`))),
          isSession ? await certify(model) : null));
    } catch (problem) { say(error, problem); }
  }

  /** The button, and beside it the newest model of each other axis, which may go onto the same certificate. */
  async function certify(model) {
    const others = new Map();
    for (const one of (await api.models({ recording: model.recording })).items) if (one.axis !== model.axis && !others.has(one.axis)) others.set(one.axis, one);
    const also = [...others.values()].map((one) => {
      const box = h("input", { type: "checkbox", id: `also-${one.axis}`, value: one.id, checked: true });
      return [box, h("label", { class: "row check", for: box.id }, box, t("workbench.keep.also", one))];
    });
    const button = h("button", {
      type: "button",
      onclick: async () => {
        say(error, null);
        button.disabled = true;
        try {
          const models = [model.id, ...also.filter(([box]) => box.checked).map(([box]) => box.value)];
          const { number } = await api.certify({ recording: model.recording, models });
          button.replaceWith(h("a", { class: "button", href: links.document(number, "pdf"), download: "" }, t("certificates.certified", { number })));
        } catch (problem) { say(error, problem); button.disabled = false; }
      },
    }, t("workbench.keep.certify"));
    return [button, ...also.map(([, label]) => label)];
  }

  place.replaceChildren(h("h2", {}, t("workbench.keep.title")),
    h("form", { class: "stack", onsubmit: save }, h("div", {}, h("label", { for: "model-name" }, t("workbench.keep.name")), name),
      h("div", { class: "row" }, h("button", { type: "submit" }, t("workbench.keep.save")))), error, told);
}
