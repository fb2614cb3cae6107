// The boards of a batch beside one another: one dot a board, and the middle of them all.

import { chart } from "./chart.js";
import { KEYS } from "./batch_rows.js";
import { h } from "./dom.js";
import { figureAt, fullName } from "./figures.js";
import { t } from "./text.js";

const FEWEST = 3;

export function fleetPanel() {
  const place = h("div", { class: "fleet" });
  const node = h("section", { class: "panel stack", hidden: true }, h("h2", {}, t("batch.fleet")), place);
  let plots = null;

  const build = () => ["x", "z"].flatMap((axis) => KEYS.map((path) => {
    const { unit } = figureAt(path);
    const made = chart(place, {
      name: `${axis} ${fullName(figureAt(path))}`, group: "fleet", height: 180, waiting: t("batch.no_axis", { axis }),
      x: { label: t("batch.position"), digits: 0, pad: true }, y: { label: t(figureAt(path).text), unit, digits: 5 },
      series: [{ reads: t("batch.board"), role: "measured", draw: "points", digits: 5 }, { name: t("batch.median"), role: "model", draw: "dash", digits: 5 }],
    });
    return { axis, path, made };
  }));

  return {
    node,
    show(files) {
      const done = files.filter((file) => file.axes).sort((a, b) => a.position - b.position);
      node.hidden = done.length < FEWEST;
      if (node.hidden) return;
      plots ??= build();
      for (const { axis, path, made } of plots) {
        const { factor } = figureAt(path);
        const pairs = done.map((file) => [file.position, valueAt(file.axes[axis], path)]).filter(([, value]) => value != null);
        const values = pairs.map(([, value]) => value * factor);
        made.set([pairs.map(([n]) => n), values, Array(values.length).fill(median(values))]);
      }
    },
  };
}

function valueAt(axis, path) {
  const entry = path.reduce((node, key) => node?.[key], axis);
  return entry?.value ?? entry;
}

function median(values) {
  const sorted = [...values].sort((a, b) => a - b);
  const half = sorted.length >> 1;
  return sorted.length % 2 ? sorted[half] : (sorted[half - 1] + sorted[half]) / 2;
}
