// The number that leads: the error on data not seen; below it what each term bought, and any two models side by side.

import { h, table } from "../dom.js";
import { decimals, fixed, plain, t, withUncertainty } from "../text.js";

/** Less than this share of the error is the windows' own scatter, not a gain. */
const TOLERATED = 0.003;

const digits = (error) => decimals(error.floor) ?? 3;

/** Puts the error and its history into `place`; undo() and compare(index or null) are what its buttons do. */
export function ledger(place, { undo, compare }) {
  const value = h("output", { class: "leads", id: "held-out" }, "–");
  const floor = h("p", { class: "muted", id: "floor" });
  const says = h("p", { class: "small", id: "bought", "aria-live": "polite" });
  const steps = h("ol", { class: "steps-bought" });
  const back = h("button", { type: "button", id: "undo", disabled: true, onclick: undo }, t("workbench.undo"));
  const other = h("select", { id: "other", onchange: () => compare(other.value === "" ? null : Number(other.value)) });
  const beside = h("div", { class: "small" });
  const parameters = h("div", {});
  place.replaceChildren(
    h("section", { class: "panel stack lead-number" }, h("h2", {}, t("workbench.error")), h("div", {}, value, floor), steps, says, h("div", { class: "row" }, back)),
    h("section", { class: "panel stack" }, h("h2", {}, t("workbench.parameters")), parameters,
      h("div", {}, h("label", { for: "other" }, t("workbench.compare_with")), other), beside));

  return {
    /** history: every model tried, the one at `at` shown; titles: effect -> its name. */
    show(history, at, titles, ms) {
      const { error, steps: errors, effects, parameters: now } = history[at];
      const d = digits(error);
      value.textContent = `${fixed(error.held_out, d)} ${error.unit}`;
      value.dataset.ms = ms ?? "";
      floor.textContent = t("workbench.floor", { floor: fixed(error.floor, d), unit: error.unit });
      const largest = Math.max(...errors, error.floor);
      steps.style.setProperty("--floor", `${(100 * error.floor) / largest}%`);
      steps.replaceChildren(...errors.map((each, k) => {
        const gain = k ? errors[k - 1] - each : null;
        const isNothing = gain !== null && gain < TOLERATED * errors[k - 1];
        const bar = h("span", { class: "gauge", "aria-hidden": "true" });
        bar.style.setProperty("--w", `${(100 * each) / largest}%`);
        bar.style.setProperty("--was", `${(100 * (k ? errors[k - 1] : each)) / largest}%`);
        return h("li", { class: isNothing ? "nothing" : null },
          h("span", { class: "what" }, k ? `+ ${titles(effects[k - 1])}` : t("workbench.base")), bar, h("span", { class: "n" }, fixed(each, d)),
          k ? h("span", { class: "small muted bought" }, isNothing ? t("workbench.buys_nothing") : t("workbench.buys", { gain: fixed(gain, d), unit: error.unit })) : null);
      }));
      const last = errors.length - 1;
      says.textContent = !last ? t("workbench.base_only")
        : errors[last - 1] - errors[last] < TOLERATED * errors[last - 1] ? t("workbench.last_nothing", { effect: titles(effects[last - 1]) })
          : t("workbench.last_bought", { effect: titles(effects[last - 1]), before: fixed(errors[last - 1], d), after: fixed(errors[last], d), unit: error.unit });
      back.disabled = !effects.length;
      parameters.replaceChildren(parameterTable(now, titles));
    },
    /** The models that can be put beside the one shown. */
    others(history, at, titles, chosen) {
      other.replaceChildren(h("option", { value: "" }, t("workbench.compare_none")),
        ...history.map((model, k) => [model, k]).filter(([, k]) => k !== at).map(([model, k]) => h("option", { value: k }, modelName(model, titles))));
      other.disabled = history.length < 2;
      other.value = chosen ?? "";
      beside.replaceChildren();
      if (chosen == null) return;
      const [a, b] = [history[at], history[chosen]];
      const d = digits(a.error);
      const names = [...new Set([...a.parameters, ...b.parameters].map((p) => p.name))];
      const cell = (model, name) => ({ n: written(model.parameters.find((p) => p.name === name)) });
      beside.replaceChildren(table(["", { n: t("workbench.this") }, { n: t("workbench.that") }], [
        [t("workbench.error"), { n: fixed(a.error.held_out, d) }, { n: fixed(b.error.held_out, d) }],
        ...names.map((name) => [parameterName(name, titles), cell(a, name), cell(b, name)]),
      ], { compact: true, label: t("workbench.compare_with") }));
    },
  };
}

export const modelName = ({ effects }, titles) => (effects.length ? [t("workbench.base"), ...effects.map(titles)].join(" + ") : t("workbench.base"));

/** In the units that people read: mV/(deg/s) for a scale factor in volts. */
const factor = ({ unit }) => (unit === "V/(deg/s)" ? [1000, "mV/(deg/s)"] : [1, unit === "1" ? "" : unit.replace("degC", "°C").replace("^2", "²").replace("^3", "³")]);

function written(parameter) {
  if (!parameter) return "–";
  const [times, unit] = factor(parameter);
  const u = parameter.standard_uncertainty;
  const size = parameter.value * times;
  if (u == null && Number.isInteger(size)) return `${plain(size)} ${unit}`.trim();
  const small = Math.abs(size) > 0 && Math.abs(size) < 1e-3;
  if (small) {
    const power = Math.floor(Math.log10(Math.abs(size)));
    const scaled = u == null ? fixed(size / 10 ** power, 2) : withUncertainty(size / 10 ** power, (u * times) / 10 ** power);
    return `${scaled}·10${superscript(power)} ${unit}`.trim();
  }
  return `${u == null ? fixed(size, 2) : withUncertainty(size, u * times)} ${unit}`.trim();
}

const superscript = (power) => String(power).replace(/[-\d]/g, (c) => (c === "-" ? "⁻" : "⁰¹²³⁴⁵⁶⁷⁸⁹"[c]));

function parameterName(name, titles) {
  const [effect, own] = name.split(".");
  if (own) return `${titles(effect)}: ${own}`;
  return name.startsWith("bias") ? t("figure.bias") : t("figure.scale_factor");
}

const parameterTable = (parameters, titles) => table([t("result.parameter"), { n: t("result.value") }],
  parameters.filter(({ name }) => !name.endsWith(".degree")).map((p) => [parameterName(p.name, titles), { n: written(p) }]), { compact: true, label: t("workbench.parameters") });
