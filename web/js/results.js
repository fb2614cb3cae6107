// A state's result as a table, beside the datasheet where the datasheet says something.

import { h, table } from "./dom.js";
import { figures } from "./figures.js";
import { decimals, fixed, sentence, signed, t, withUncertainty } from "./text.js";

export const UNIT = { rate: "deg/s", position: "deg" };
export const split = (state) => state.split("_");
export const stateName = (state) => t(`state.${state}`);

/** The two parameters as they are certified, in the units they are read in. */
const PARAMETERS = [["bias_V", "figure.bias", "V", 1], ["scale_factor_V_per_dps", "figure.scale_factor", "mV/(deg/s)", 1000]];

/** How far the datasheet's value is from the measured one, in per cent of the datasheet's. */
const difference = (measured, datasheet) => (datasheet ? (100 * (measured - datasheet)) / datasheet : null);

function estimateRows(result) {
  return PARAMETERS.map(([key, name, unit, factor]) => {
    const { value, standard_uncertainty: u, expanded_uncertainty: expanded } = result[key];
    const printed = result.datasheet?.[key];
    const percent = difference(value, printed);
    return [
      `${t(name)}, ${unit}`,
      { n: withUncertainty(value * factor, u * factor) },
      { n: expanded == null ? "–" : `± ${fixed(expanded * factor, decimals(expanded * factor) ?? 4)}` },
      { n: result.adaptive ? fixed(result.adaptive[key] * factor, 4) : "–" },
      { n: printed == null ? "–" : fixed(printed * factor, 2) },
      { n: percent == null ? "–" : `${signed(percent, 1)} %` },
    ];
  });
}

/** The two parameters of an axis in three short lines, for beside the plots. */
export function estimateSummary(axis, result) {
  const [bias, scale] = estimateRows(result);
  return [
    [axis, h("span", {}, h("span", { class: "muted small" }, `${bias[0]} `), bias[1].n)],
    ["", h("span", {}, h("span", { class: "muted small" }, `${scale[0]} `), scale[1].n)],
    ["", h("span", { class: "muted small" }, t("result.datasheet_says", { value: scale[4].n, off: scale[5].n }))],
  ];
}

const ESTIMATE_HEAD = () => [t("result.parameter"), ...["certified", "expanded", "adaptive", "datasheet", "off"].map((key) => ({ n: t(`result.${key}`) }))];

export const warnings = (list) => (list ?? []).map((warning) => h("p", { class: "notice small" }, sentence(warning)));

function sampleSize(size, unit) {
  if (!size) return null;
  const key = size.enough ? "result.enough" : "result.not_enough";
  return h("p", { class: size.enough ? "small muted" : "notice small" },
    t(key, { used: size.used, needed: Math.ceil(size.needed), d: size.d ?? size.ci / 2, unit }));
}

/** The card of one state: its figures, what they mean, and the door to do it again. */
export function resultCard(state, result, { actions = [], level = "h2" } = {}) {
  const [kind] = split(state);
  const isEstimate = kind === "estimate";
  return h("section", { class: `panel stack ${isEstimate ? "wide" : "test"}`, id: `result-${state}` },
    h("div", { class: "row spread" }, h(level, {}, stateName(state)), ...actions),
    isEstimate
      ? table(ESTIMATE_HEAD(), estimateRows(result), { label: stateName(state), cards: true })
      : table([t("result.figure"), { n: t("result.value") }],
        figures({ [kind]: result }, kind).map((row) => [`${row.name}, ${row.unit}`, { n: row.text }]), { compact: true, label: stateName(state) }),
    isEstimate ? null : sampleSize(result.sample_size, UNIT[kind]),
    ...warnings(result.warnings));
}

/** Thesis 5.3 to 5.6 and 5.11 to 5.14: the line, set-point by set-point. */
export function linearityTable(rows, kind) {
  return table([t("table.set_point"), ...["encoder", "mean", "fit", "residual"].map((key) => ({ n: t(`table.${key}`) }))].map(withUnit(kind)),
    rows.map((row) => [{ n: signed(row.set_point, 0) }, ...[row.reference, row.mean, row.fit, row.residual].map((value) => ({ n: fixed(value, 4) }))]),
    { compact: true, label: t("table.linearity") });
}

/** Thesis 5.7 to 5.10 and 5.15 to 5.18; readings that were dropped as extremes are struck through. */
export function repeatTable(rows, kind) {
  const keys = ["encoder", "mean", "standard_deviation", "bias_error", "random_error"];
  return table([t("table.set_point"), ...keys.map((key) => ({ n: t(`table.${key}`) }))].map(withUnit(kind)),
    rows.map((row) => [{ n: signed(row.set_point, 0) }, ...[row.reference, row.mean, row.standard_deviation, row.bias_error, row.random_error].map((value) => ({ n: fixed(value, 4) }))]),
    { compact: true, label: t("table.repeat") });
}

const withUnit = (kind) => (head) => (head.n ? { n: `${head.n}, ${UNIT[kind]}` } : `${head}, ${UNIT[kind]}`);
