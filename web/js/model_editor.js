// A gyro model in a dialog: what the datasheet says of each axis, the output's limits, the ranges a test may use.

import { api } from "./api.js";
import { h, say } from "./dom.js";
import { t } from "./text.js";

const AXIS_FIELDS = [["bias_V", "V", 1], ["scale_factor_V_per_dps", "mV/(deg/s)", 1000], ["range_dps", "deg/s", 1]];
const RANGE_FIELDS = [["rate_dps", "deg/s", 1], ["position_deg", "deg", 1], ["sine_deg", "deg", 1]];

/** Opens the editor on a model; resolves to the saved model's id, "" when deleted, or null when closed. A preset is copied, never changed. */
export function editModel(model) {
  return new Promise((resolve) => {
    const inputs = [];
    const number = (read, write, factor, label) => {
      const value = read(model);
      const input = h("input", { type: "number", step: "any", required: true, "aria-label": label, value: value == null ? "" : Number((value * factor).toPrecision(9)) });
      inputs.push((target) => write(target, Number(input.value) / factor));
      return input;
    };
    const name = h("input", { id: "model-name", required: true, maxlength: 100, value: model.preset ? t("model.copy_of", { name: model.name }) : model.name });
    const line = (group, [key, unit, factor]) => [
      h("span", { class: "label" }, `${t(`model.${key}`)}, ${unit}`),
      ...["x", "z"].map((axis) => number((m) => m[group][axis]?.[key], (m, v) => { m[group][axis][key] = v; }, factor, `${axis} ${t(`model.${key}`)}`)),
    ];
    const error = h("p", { class: "error", role: "alert" });
    const close = (result) => { dialog.close(); dialog.remove(); resolve(result); };
    const form = h("form", { class: "stack" },
      h("h2", {}, t(model.preset ? "model.title_copy" : "model.title")),
      h("div", {}, h("label", { for: "model-name" }, t("model.name")), name),
      h("div", { class: "ranges" }, h("span", {}), h("span", { class: "label" }, "x"), h("span", { class: "label" }, "z"),
        ...AXIS_FIELDS.flatMap((field) => line("axes", field)), ...RANGE_FIELDS.flatMap((field) => line("ranges", field)),
        h("span", { class: "label" }, t("model.output_limits")),
        number((m) => m.output_min_V, (m, v) => { m.output_min_V = v; }, 1, t("model.output_min")),
        number((m) => m.output_max_V, (m, v) => { m.output_max_V = v; }, 1, t("model.output_max"))),
      error,
      h("div", { class: "row spread" },
        h("div", { class: "row" },
          h("button", { class: "main", type: "submit" }, t("model.save")),
          h("button", { type: "button", onclick: () => close(null) }, t("model.cancel"))),
        model.preset ? null : h("button", { type: "button", onclick: () => attempt(async () => { await api.removeGyroModel(model.id); return ""; }) }, t("model.delete"))));
    async function attempt(work) {
      try { close(await work()); } catch (problem) { say(error, problem); }
    }
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      const next = structuredClone(model);
      for (const write of inputs) write(next);
      next.name = name.value.trim();
      attempt(async () => {
        if (!model.preset) return (await api.changeGyroModel(next)).id;
        const { id: _, preset: __, ...fresh } = next;
        fresh.id = next.name.replace(/[^\w.-]+/g, "-").replace(/^-+|-+$/g, "").slice(0, 64) || `model-${Date.now().toString(36)}`;
        return (await api.createGyroModel(fresh)).id;
      });
    });
    const dialog = h("dialog", { "aria-label": t("model.title"), oncancel: () => close(null) }, form);
    document.body.append(dialog);
    dialog.showModal();
  });
}
