// Answers, marks and the truth in words, for students and for the teacher.

import { h } from "./dom.js";
import { plain, t } from "./text.js";

const either = (names, words) => names.map((name) => words[name] ?? name).join(` ${t("lab.or")} `);

/** What a student's recording is called: the runs that are in it. */
export const runName = ({ numbers }) => t("lab.run_name", { numbers: numbers.join(" + ") });

/** "lag of the sensor or delay …; hysteresis", or that nothing is hidden. */
export const answerWords = ({ findings }, words) => (findings.length ? findings.map((names) => either(names, words)).join("; ") : t("lab.nothing_hidden"));

const unitOf = (effects, name, parameter) => effects.find((effect) => effect.name === name)?.parameters.find((p) => p.name === parameter)?.unit.replace("{out}", "V") ?? "";

/** What is hidden, with its parameters in physical units where `effects` (of /effects) is given. */
export function truthList(truth, words, effects = []) {
  if (!truth.effects.length) return h("p", {}, t("lab.truth_none"));
  return h("ul", { class: "plain" }, truth.effects.map(({ effect, strength, parameters }) => h("li", {},
    h("strong", {}, words[effect] ?? effect), strength ? h("span", { class: "muted" }, ` · ${t("lab.of_strength", { strength: Number(strength.toFixed(2)) })}`) : null,
    h("p", { class: "small muted" }, Object.entries(parameters).map(([name, value]) => `${name} = ${plain(Number(value.toPrecision(4)))} ${unitOf(effects, effect, name)}`.trim()).join(" · ")))));
}

/** Every finding with its mark, then what was missed, then the score. */
export function verdictList(grade, answer, words) {
  const marks = grade.marks.map(({ mark, names, told_apart, tied_with }) => h("li", { class: `mark ${mark}` },
    h("span", { class: "word" }, t(`lab.mark_${mark}`)), ` ${either(names, words)}`,
    told_apart.length ? h("p", { class: "small" }, t("lab.told_apart", { names: told_apart.map((name) => words[name] ?? name) })) : null,
    tied_with ? h("p", { class: "small" }, t("lab.tied_truth", { name: words[tied_with] ?? tied_with })) : null));
  if (!answer.findings.length) marks.push(h("li", { class: `mark ${grade.missing.length ? "wrong" : "right"}` }, h("span", { class: "word" }, t(`lab.mark_${grade.missing.length ? "wrong" : "right"}`)), ` ${t("lab.nothing_hidden")}`));
  for (const name of grade.missing) marks.push(h("li", { class: "mark missing" }, h("span", { class: "word" }, t("lab.mark_missing")), ` ${words[name] ?? name}`));
  return h("div", { class: "stack" }, h("ul", { class: "plain" }, marks), h("p", { class: "score" }, t("lab.score", { score: Math.round(100 * grade.score), confidence: answer.confidence })));
}
