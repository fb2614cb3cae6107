// A state's result as a table, beside the datasheet where the datasheet says something.

import { facts, h, table } from "./dom.js";
import { figureAt, figures, fullName } from "./figures.js";
import { UNIT, split, stateName } from "./states.js";
import { decimals, fixed, minus, plain, sentence, signed, t, withUncertainty } from "./text.js";

/** The two parameters as they are certified, in the units they are read in. */
const PARAMETERS = [["bias_V", "figure.bias", "V", 1], ["scale_factor_V_per_dps", "figure.scale_factor", "mV/(deg/s)", 1000]];

/** How far the datasheet's value is from the measured one, in per cent of the datasheet's. */
const difference = (measured, datasheet) => (datasheet ? (100 * (measured - datasheet)) / datasheet : null);

/** What stands beside the certified values: the adaptive estimate, or in profile thesis, where that is certified, the fit. */
const isThesis = (result) => result.adaptive.form === "thesis";
const beside = (result) => (isThesis(result) ? result.integral_fit : result.adaptive);

function estimateRows(result) {
  return PARAMETERS.map(([key, name, unit, factor]) => {
    const { value, standard_uncertainty: u, expanded_uncertainty: expanded } = result[key];
    const printed = result.datasheet?.[key];
    const percent = difference(value, printed);
    return [
      `${t(name)}, ${unit}`,
      { n: withUncertainty(value * factor, u * factor) },
      { n: expanded == null ? "–" : `± ${fixed(expanded * factor, decimals(expanded * factor) ?? 4)}` },
      { n: fixed(beside(result)[key] * factor, 4) },
      { n: printed == null ? "–" : fixed(printed * factor, 2) },
      { n: percent == null ? "–" : `${signed(percent, 1)}\u00a0%` },
    ];
  });
}

/** The two parameters of an axis in three short lines, for beside the plots. */
export function estimateSummary(axis, result) {
  const [bias, scale] = estimateRows(result);
  return [
    [axis, h("span", {}, h("span", { class: "muted small" }, `${bias[0]} `), bias[1].n)],
    ["", h("span", {}, h("span", { class: "muted small" }, `${scale[0]} `), scale[1].n)],
    ["", h("span", { class: "muted small" }, t("result.datasheet_says", { value: `${scale[4].n} mV/(deg/s)`, off: scale[5].n }))],
  ];
}

const estimateHead = (result) => [t("result.parameter"),
  ...["certified", "expanded", isThesis(result) ? "integral" : "adaptive", "datasheet", "off"].map((key) => ({ n: t(`result.${key}`) }))];

/** What else the estimate state found: the motion's delay, the filter in use and whether it suits, the rig's step. */
function conditions({ delay_s: delay, noise, still, kalman, step_check: step }) {
  const ms = (value) => value * 1e3;
  return facts([
    [t("figure.delay"), delay?.value == null ? null : `${withUncertainty(ms(delay.value), ms(delay.standard_uncertainty))} ms`],
    [t("result.noise"), noise ? `${fixed(noise.white_dps, 3)} deg/s` : null],
    [t("result.random_walk"), still?.angle_random_walk_deg_per_sqrt_h == null ? null : `${withUncertainty(still.angle_random_walk_deg_per_sqrt_h, still.angle_random_walk_standard_uncertainty)} deg/√h`],
    [t("result.gain"), kalman ? `K₁ ${fixed(kalman.k1, 1)} s⁻², K₂ ${fixed(kalman.k2, 2)} s⁻¹` : null],
    [t("result.noise_ratio"), kalman?.noise_ratio == null ? null : fixed(kalman.noise_ratio, 2)],
    [t("result.whiteness"), kalman?.whiteness_p == null ? null : kalman.whiteness_p < 0.001 ? "p < 0.001" : `p = ${fixed(kalman.whiteness_p, 3)}`],
    [t("result.filterpy"), kalman?.filterpy_difference == null ? null : `${minus(kalman.filterpy_difference.toExponential(1))} V`],
    [t("figure.step_rate_error"), step ? `${fixed(step.rate_error_pct, 2)} %` : null],
    [t("figure.step_position_error"), step ? `${fixed(step.position_error_pct, 2)} %` : null],
  ], true);
}

/** Where the uncertainty of the two parameters comes from, and what is not in it. */
export function budgetTable(budget) {
  const rows = Object.entries(budget).flatMap(([key, lines]) => lines.map((line) => [
    `${t(`figure.${key}`)}: ${t(`budget.${line.name}`)}`, line.kind ?? "",
    { n: line.excluded ? t("result.excluded") : (key === "bias" ? `${fixed(line.standard_uncertainty * 1e6, 2)} µV` : `${fixed(line.standard_uncertainty * 1e6, 3)} µV/(deg/s)`) },
    { n: line.excluded ? "" : line.dof == null ? "∞" : fixed(line.dof, 0) },
  ]));
  return table([t("result.source"), t("result.type"), { n: t("result.standard_uncertainty") }, { n: t("result.dof") }], rows, { compact: true, cards: true, label: t("result.budget") });
}

/** Each limit of a specification and whether it is met; nothing without a specification. */
export function limitsCard(certificate) {
  if (!certificate?.judgement?.length) return null;
  const row = ({ axis, path, min, max, value, ok }) => {
    const figure = figureAt(path);
    const number = (x) => ({ n: x == null ? "" : plain(x * figure.factor) });
    return [`${axis} ${fullName(figure)}, ${figure.unit}`, number(value), number(min), number(max), ok ? t("certificate.limits.ok") : h("strong", { class: "failed" }, t("certificate.limits.not_ok"))];
  };
  return h("section", { class: "panel stack wide" },
    h("h2", {}, t("certificate.spec", { name: certificate.spec.name ?? "" })),
    table([t("certificate.limits.figure"), { n: t("certificate.limits.value") }, { n: t("result.lowest") }, { n: t("result.highest") }, t("certificate.limits.outcome")],
      certificate.judgement.map(row), { compact: true, cards: true, label: t("certificate.spec", { name: certificate.spec.name ?? "" }) }));
}

export const warnings = (list) => (list ?? []).map((warning) => h("p", { class: "notice small" }, sentence(warning)));

/** The card of one state: its figures, what they mean, and the door to do it again. */
export function resultCard(state, result, { actions = [], level = "h2" } = {}) {
  const [kind] = split(state);
  const isEstimate = kind === "estimate";
  return h("section", { class: `panel stack ${isEstimate ? "wide" : "test"}`, id: `result-${state}` },
    h("div", { class: "row spread" }, h(level, {}, stateName(state)), ...actions),
    isEstimate
      ? table(estimateHead(result), estimateRows(result), { label: stateName(state), cards: true })
      : table([t("result.figure"), { n: t("result.value") }],
        figures({ [kind]: result }, kind).map((row) => [`${row.name}, ${row.unit}`, { n: row.text }]), { compact: true, label: stateName(state) }),
    isEstimate ? conditions(result) : null,
    // Too few readings are among the warnings.
    result.sample_size?.enough ? h("p", { class: "small muted" }, sentence(result.sample_size)) : null,
    ...warnings(result.warnings));
}

/** As many as the certificate has: a mean of 20 readings is good to some 0.005 deg/s, and to 0.02 deg. */
const DECIMALS = { rate: 4, position: 3 };

/** Thesis 5.3 to 5.6 and 5.11 to 5.14: the line, set-point by set-point. */
export function linearityTable(rows, kind) {
  return table([t("table.set_point"), ...["encoder", "mean", "fit", "residual"].map((key) => ({ n: t(`table.${key}`) }))].map(withUnit(kind)),
    rows.map((row) => [{ n: signed(row.set_point, 0) }, ...[row.reference, row.mean, row.fit, row.residual].map((value) => ({ n: fixed(value, DECIMALS[kind]) }))]),
    { compact: true, label: t("table.linearity") });
}

/** Thesis 5.7 to 5.10 and 5.15 to 5.18; readings that were dropped as extremes are struck through. */
export function repeatTable(rows, kind) {
  const keys = ["encoder", "mean", "standard_deviation", "bias_error", "random_error"];
  const readings = (row) => h("span", { class: "readings" }, row.readings.flatMap((value, i) => [h(row.used[i] ? "span" : "s", {}, fixed(value, 3)), " "]));
  return table([...[t("table.set_point"), ...keys.map((key) => ({ n: t(`table.${key}`) }))].map(withUnit(kind)), t("table.readings")],
    rows.map((row) => [{ n: signed(row.set_point, 0) }, ...[row.reference, row.mean, row.standard_deviation, row.bias_error, row.random_error].map((value) => ({ n: fixed(value, DECIMALS[kind]) })), readings(row)]),
    { compact: true, label: t("table.repeat") });
}

const withUnit = (kind) => (head) => (head.n ? { n: `${head.n}, ${UNIT[kind]}` } : `${head}, ${UNIT[kind]}`);
