// The teacher's form: what is hidden, how strongly, in what noise.

import { api, links } from "./api.js";
import { h, say } from "./dom.js";
import { remember } from "./lab_student.js";
import { plain, t } from "./text.js";

const field = (id, control, key, hint = null) => h("div", {}, h("label", { for: id }, t(key)), control, hint ? h("p", { class: "small muted" }, hint) : null);
const select = (id, options, chosen) => h("select", { id, name: id }, options.map(([value, text]) => h("option", { value, selected: value === chosen }, text)));
const number = (id, attributes) => h("input", { id, name: id, type: "number", inputmode: "decimal", step: "any", ...attributes });

export async function setupForm() {
  const [known, { items }] = await Promise.all([api.hideable(), api.effects()]);
  const effects = known.effects.map((name) => items.find((item) => item.name === name));
  effects.sort((a, b) => a.title.localeCompare(b.title));
  const rows = h("div", { class: "stack" });
  const error = h("p", { class: "error", role: "alert" });
  const make = h("button", { class: "main", type: "submit" }, t("lab.make"));
  const difficulty = select("difficulty", known.difficulties.map((word) => [word, t(`lab.difficulty_${word}`)]), "medium");
  const ways = {
    surprise: h("div", { class: "stack inset" }, field("difficulty", difficulty, "lab.difficulty"), h("p", { class: "small muted" }, t("lab.surprise_about"))),
    chosen: h("div", { class: "stack inset" }, rows, h("div", { class: "row" }, h("button", { type: "button", onclick: () => addRow() }, t("lab.add_effect")))),
    none: h("p", { class: "small muted inset" }, t("lab.none_about")),
  };
  const radio = (way) => h("div", { class: "stack" }, h("label", { class: "choice" },
    h("input", { type: "radio", name: "way", value: way, checked: way === "surprise", onchange: show }), t(`lab.way_${way}`)), ways[way]);

  function show() {
    const way = form.way.value;
    for (const [name, part] of Object.entries(ways)) part.hidden = name !== way;
    if (way === "chosen" && !rows.children.length) addRow();
  }

  let serial = 0;
  /** One hidden effect: by METHOD's strength, or by its own parameters with their units. */
  function addRow() {
    const id = `hidden-${serial++}`;
    const choice = select(id, effects.map((effect) => [effect.name, effect.title]));
    const by = select(`${id}-by`, [["strength", t("lab.by_strength")], ["parameters", t("lab.by_parameters")]]);
    const inputs = h("div", { class: "pair" });
    const how = h("div", {}, h("label", { for: `${id}-by` }, t("lab.given_by")), by);
    const fill = () => {
      const effect = effects.find(({ name }) => name === choice.value);
      const given = by.value === "strength"
        ? [number(`${id}-strength`, { min: 0.05, max: known.strongest, value: 1 })].map((input) => field(input.id, input, "lab.strength", t("lab.strength_about")))
        : effect.parameters.map((p) => h("div", {}, h("label", { for: `${id}-${p.name}` }, `${p.name}, ${p.unit.replace("{out}", "V")}`),
          number(`${id}-${p.name}`, { "data-parameter": p.name, placeholder: plain(p.typical) })));
      inputs.replaceChildren(...given);
    };
    choice.addEventListener("change", fill);
    by.addEventListener("change", fill);
    fill();
    const row = h("fieldset", { class: "stack hidden-effect" }, h("legend", { class: "unseen" }, t("lab.effect")),
      field(id, choice, "lab.effect"), how, inputs,
      h("div", { class: "row" }, h("button", { type: "button", onclick: () => row.remove() }, t("lab.remove"))));
    row.read = () => {
      if (by.value === "strength") return { effect: choice.value, strength: Number(inputs.querySelector("input").value) };
      const filled = [...inputs.querySelectorAll("input")].filter((input) => input.value !== "");
      return { effect: choice.value, parameters: Object.fromEntries(filled.map((input) => [input.dataset.parameter, Number(input.value)])) };
    };
    rows.append(row);
  }

  function body() {
    const value = (name) => (form[name].value === "" ? undefined : Number(form[name].value));
    const way = form.way.value;
    return {
      title: form.title.value.trim(), axis: form.axis.value, starter: form.starter.value || null, seed: value("seed"),
      difficulty: way === "surprise" ? form.difficulty.value : null,
      effects: way === "chosen" ? [...rows.children].map((row) => row.read()) : [],
      noise: { white_mV: value("white"), correlated_mV: value("correlated"), correlation_time_s: value("correlation") },
    };
  }

  const form = h("form", {
    class: "stack", novalidate: true,
    onsubmit: async (event) => {
      event.preventDefault();
      say(error, null);
      make.disabled = true;
      try {
        const { code, key, title } = await api.createExercise(body());
        remember(code, { key, title });
        location.href = links.lab(code);
      } catch (problem) {
        say(error, problem);
        make.disabled = false;
      }
    },
  },
  field("title", h("input", { id: "title", name: "title", maxlength: 200, autocomplete: "off", placeholder: t("lab.title_example") }), "lab.title"),
  h("fieldset", { class: "stack" }, h("legend", { class: "label" }, t("lab.hidden_what")), radio("surprise"), radio("chosen"), radio("none")),
  h("details", {}, h("summary", {}, t("lab.more")), h("div", { class: "stack" },
    h("div", { class: "pair" },
      field("axis", select("axis", [["x", "x"], ["z", "z"]], "x"), "lab.axis"),
      field("starter", select("starter", [["", t("lab.starter_none")], ["sine", t("lab.starter_sine")], ["mixed", t("lab.starter_mixed")]], ""), "lab.starter")),
    h("div", { class: "pair" },
      field("white", number("white", { min: 0, max: 20, placeholder: "1.2" }), "lab.white"),
      field("seed", number("seed", { min: 0, step: 1, placeholder: t("lab.seed_any") }), "lab.seed", t("lab.seed_about"))),
    h("div", { class: "pair" },
      field("correlated", number("correlated", { min: 0, max: 20, placeholder: "0" }), "lab.correlated"),
      field("correlation", number("correlation", { min: 0.02, max: 60, placeholder: "0.5" }), "lab.correlation")))),
  error, h("div", { class: "row" }, make));
  show();
  return form;
}
