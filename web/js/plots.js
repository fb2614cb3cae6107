// The pictures of a run: live signals, the two adaptive parameters, and a test's points on their line.

import { chart } from "./chart.js";
import { soFar as pointsSoFar, twoSigma } from "./line.js";
import { UNIT, split } from "./states.js";
import { t } from "./text.js";

const WINDOW_S = 60;
const TIME = () => ({ label: t("chart.time"), unit: "s", digits: 2 });
const withNulls = (values, scale = 1) => Array.from(values, (v) => (Number.isNaN(v) ? null : v * scale));


/** Scatter with line, and residual stems with their ±2σ band, for one rate or position test. */
export function testCharts(place, kind) {
  const x = { label: t("chart.encoder"), unit: UNIT[kind], digits: 2, pad: true };
  const height = 220;
  const fitted = chart(place, {
    name: t(`chart.${kind}_points`), x, y: { label: t("chart.gyro"), unit: UNIT[kind], zero: true, digits: 3 }, height, waiting: t("chart.no_points"),
    series: [
      { name: t("chart.measured"), role: "measured", draw: "points" },
      { name: t("chart.line"), role: "model", draw: "dash" },
    ],
  });
  const residual = chart(place, {
    name: t("chart.residual_name"), x, y: { label: t("chart.residual"), unit: UNIT[kind], zero: true, digits: 3 }, height, waiting: t("chart.no_points"),
    series: [
      { name: t("chart.mean"), role: "residual", draw: "stems" },
      { name: t("chart.each"), role: "measured", draw: "faint" },
    ],
  });

  function linearity(rows) {
    const xs = rows.map((row) => row.reference);
    fitted.set([xs, rows.map((row) => row.mean), rows.map((row) => row.fit)]);
    const flat = rows.flatMap((row) => (row.fit == null ? [] : [
      [row.reference, row.residual, null], ...row.readings.map((value) => [row.reference, null, value - row.fit]),
    ]));
    const band = twoSigma(rows);
    residual.rename(band ? t("chart.residual_band", { value: band, unit: UNIT[kind] }) : t("chart.residual_name"), t("chart.residual"));
    residual.set(columns(flat, 3), { band });
  }

  function repeat(rows) {
    // A dot beside the other: the readings of one set-point stand in the order they were taken.
    const width = Math.max(...rows.map((row) => Math.abs(row.reference))) * 0.06;
    const flat = rows.flatMap((row) => [
      [row.reference, row.mean - row.reference, null],
      ...row.readings.map((value, i) => [row.reference + width * (i / row.readings.length - 0.5), null, value - row.reference]),
    ]).sort((a, b) => a[0] - b[0]);
    residual.rename(t("chart.repeat_name"), t("chart.error"));
    residual.set(columns(flat, 3));
  }

  return {
    /** {linearity, repeat}; the second picture shows the repeats as soon as there are any, unless `which` says otherwise. */
    show(points, which) {
      linearity(points.linearity);
      if (which !== "linearity" && points.repeat.length) repeat(points.repeat);
    },
    destroy() { fitted.destroy(); residual.destroy(); },
  };
}

const columns = (rows, n) => Array.from({ length: n }, (_, i) => rows.map((row) => row[i]));

function adaptiveCharts(place, model, axis) {
  const one = (key, unit, digits, least) => chart(place, {
    name: t(`chart.adaptive_${key}`), group: "live", height: 220, waiting: t("chart.waiting"),
    x: TIME(), y: { label: t(`chart.${key}`), unit, digits, least },
    series: [{ name: t("chart.estimate"), role: "model", draw: "line" }, { name: t("chart.datasheet"), role: "measured", draw: "dots" }],
  });
  const bias = one("bias", "V", 4, 0.002);
  const scale = one("scale", "mV/(deg/s)", 4, 0.01);
  const datasheet = model?.axes?.[axis];
  return {
    show(run) {
      const time = run.column(`${axis}.trace_time_s`);
      const put = (plot, values, factor, known) => plot.set([time, withNulls(values, factor), Array(time.length).fill(known ?? null)]);
      put(bias, run.column(`${axis}.adaptive_bias_V`), 1, datasheet?.bias_V);
      put(scale, run.column(`${axis}.adaptive_scale_factor`), 1000, datasheet && datasheet.scale_factor_V_per_dps * 1000);
    },
    destroy() { bias.destroy(); scale.destroy(); },
  };
}

/** Everything that moves while a run goes on. show(run) redraws from a RunSoFar. */
export function livePlots(place, model) {
  const rate = chart(place, {
    name: t("chart.rate_name"), wide: true, group: "live", height: 200, waiting: t("chart.waiting"),
    x: TIME(), y: { label: t("chart.rate"), unit: "deg/s", zero: true, digits: 2 },
    series: [{ name: t("chart.encoder"), role: "measured", draw: "line" }, { name: t("chart.gyro"), role: "model", draw: "dash" }],
  });
  let evidence = null;
  let shown = null;
  const evidencePlace = document.createElement("div");
  evidencePlace.className = "charts wide";
  place.append(evidencePlace);
  const signal = chart(place, {
    name: t("chart.signal_name"), wide: true, group: "live", height: 150, waiting: t("chart.waiting"),
    x: TIME(), y: { label: t("chart.output"), unit: "V", digits: 4, least: 0.005 },
    series: [{ name: t("chart.output"), role: "measured", draw: "line" }, { name: t("chart.filtered"), role: "model", draw: "dash" }],
  });

  return {
    show(run) {
      if (!run.state) return;
      const [kind, axis] = split(run.state);
      if (shown !== run.state) {
        evidence?.destroy();
        evidence = kind === "estimate" ? adaptiveCharts(evidencePlace, model, axis) : testCharts(evidencePlace, kind);
        shown = run.state;
      }
      const time = run.column(`${axis}.time_s`);
      const last = time[time.length - 1];
      const from = time.findLastIndex((value) => value < last - WINDOW_S) + 1;
      const xs = time.subarray(from);
      const part = (name) => withNulls(run.column(`${axis}.${name}`).subarray(from));
      const range = xs.length ? { from: last - WINDOW_S, to: last } : {};
      rate.set([xs, part("encoder_rate_dps"), part("gyro_rate_dps")], range);
      signal.set([xs, part("gyro_V"), part("filtered_V")], range);
      if (kind === "estimate") evidence.show(run);
      else evidence.show(pointsSoFar(run.points.filter((point) => point.state === run.state)));
    },
    destroy() {
      rate.destroy();
      signal.destroy();
      evidence?.destroy();
      evidencePlace.remove();
    },
  };
}
