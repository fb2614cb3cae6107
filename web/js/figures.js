// The certified figures of an axis: the server's one list of them (name, unit, digits), written for tables.

import { api } from "./api.js";
import { decimals as decimalsOf, fixed, t, withUncertainty } from "./text.js";

let fields = null;
export const loadFigures = async () => { fields ??= (await api.fields()).items; };

/** The figure that a limit's path (`["rate", "nonlinearity_pct_fs"]`) is about. */
export const figureAt = (path) => fields.find((field) => field.path.every((key, i) => key === path[i]));

/** Its name with the test that it is from. */
export const fullName = ({ path, text }) => (["rate", "position"].includes(path[0]) ? `${t(`certificate.${path[0]}`)}: ${t(text)}` : t(text));

const at = (axis, path) => path.reduce((node, key) => node?.[key], axis);

/** [{path, name, unit, text, value}] of one axis (CONTRACT 3 `axes`), or of one state's part of it with `under`. */
export function figures(axis, under = null) {
  return fields.filter(({ path }) => !under || path[0] === under).map(({ path, text, unit, factor, decimals, uncertainty }) => {
    const entry = at(axis, path);
    const measured = decimals == null && !uncertainty;
    const value = measured ? entry?.value : entry;
    return {
      path, unit, value: value == null ? null : value * factor, name: t(text),
      text: value == null ? "–" : measured ? withUncertainty(value * factor, entry.standard_uncertainty * factor) : fixed(value * factor, decimals ?? decimalsOf(value * factor) ?? 0),
    };
  });
}
