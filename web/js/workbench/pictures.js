// What is looked at: the signal with its model, the residual in time, along whatever it may depend on, and its spectrum.

import { chart } from "../chart.js";
import { h, waiting } from "../dom.js";
import { t } from "../text.js";

const GROUP = "workbench";
const UNIT = { rate: "deg/s", position: "deg", acceleration: "deg/s²", temperature: "°C", time: "s", supply: "V", other_rate: "deg/s", duration: "s", set_point: "" };
const STEADY = 3;
const DETAIL_MS = 120;

export const alongName = ({ kind, axis, covariate }) => t(`diagnosis.along.${kind}`, { axis, covariate });

/** The pictures of one recording, or of readings ("rate" or "position" in `points`) against their reference. detail([from, to]) gives a fit of a stretch in full; pointed(along) hears a guess. */
export function pictures(place, { unit, points, detail, pointed }) {
  const sentence = h("h1", { class: "says" }, h("span", { class: "limits" }, waiting(t("workbench.fitting"), null, "span")));
  const traces = h("div", { class: "stack traces" });
  const grid = h("div", { class: "multiples" });
  place.replaceChildren(sentence, traces,
    h("p", { class: "small muted no-print" }, t("chart.hint")),
    h("h2", { id: "against" }, t("workbench.against")), grid);
  const time = points ? { label: t("chart.encoder"), unit, digits: 2, pad: true } : { label: t("chart.time"), unit: "s", digits: 2 };
  const left = points ? unit : "deg/s";
  let shown = null;
  let base = 0;
  let asking = 0;
  let compared = null;
  let isHiding = false;
  let judged = null;

  const overlay = chart(traces, {
    name: t("workbench.overlay"), group: GROUP, height: 200, x: time, y: { label: t(points ? "chart.gyro" : "chart.output"), unit, digits: points ? 3 : 4 },
    waiting: t("workbench.loading"), onZoom,
    series: [
      { name: t("chart.measured"), role: "measured", draw: points ? "points" : "line" },
      { name: t("workbench.modelled"), role: "model", draw: "dash" },
    ],
  });
  const residual = chart(traces, {
    name: t(points ? "workbench.residual_points" : "workbench.residual"), group: GROUP, height: 150, x: time, y: { label: t("chart.residual"), unit: left, zero: true, digits: 3 },
    waiting: t("workbench.fitting"),
    series: [
      { name: t("chart.residual"), role: "residual", draw: points ? "dust" : "line" },
      { name: t("workbench.other"), role: "model", draw: points ? "faint" : "dots" },
    ],
  });
  const multiples = new Map();

  function onZoom(range) {
    clearTimeout(asking);
    if (!shown || shown.whole) return;
    asking = setTimeout(async () => {
      const of = shown;
      const part = range ? await detail(range) : of;
      if (shown === of) drawSignal(part);
    }, DETAIL_MS);
  }
  const drawSignal = ({ columns: c }) => overlay.set([c.time_s, ...broken(c.time_s, c.measured, c.modelled)]);

  function multiple(along) {
    const name = along.kind === "time" ? t("workbench.along_time") : alongName(along);
    const figure = h("div", { class: "multiple", "data-along": along.covariate });
    const plot = chart(figure, {
      name, height: 150, tight: true, waiting: t("workbench.fitting"),
      x: { label: name, unit: UNIT[along.kind] ?? "", digits: 2, pad: true, bare: true }, y: { label: t("chart.residual"), unit: left, zero: true, digits: 3, bare: true },
      series: [
        { reads: t("chart.residual"), role: "residual", draw: "dust" },
        { reads: t("chart.mean"), role: "residual", draw: "line", joined: true, digits: 3 },
      ],
    });
    const says = h("p", { class: "small fails" });
    const here = h("button", { type: "button", class: "point", "aria-pressed": "false", onclick: () => pointed(along) }, t("workbench.guess.here"));
    figure.append(says, here);
    grid.append(figure);
    return { plot, says, here, figure };
  }

  const spectrumPlace = h("div", { class: "multiple" });
  const spectrum = chart(spectrumPlace, {
    name: t("workbench.spectrum"), height: 150, tight: true, waiting: t("workbench.fitting"),
    x: { label: t("workbench.frequency"), unit: "Hz", digits: 2, log: true, bare: true }, y: { label: t("workbench.density"), unit: "deg/s/√Hz", digits: 4, log: true, bare: true },
    series: [{ reads: t("chart.residual"), role: "residual", draw: "line" }, { reads: t("workbench.white"), role: "model", draw: "dots" }],
  });

  /** The largest that a picture shows: that of the first model while it can, so that an error is seen to fall. */
  function reach(columns, along) {
    const sizes = Float64Array.from(columns.residual, Math.abs).sort();
    let largest = sizes[Math.floor(0.99 * (sizes.length - 1))];
    for (const { covariate } of along) for (const value of columns[`${covariate}/mean`]) largest = Math.max(largest, 1.15 * Math.abs(value));
    for (const sigma of columns.spread) largest = Math.max(largest, 2.2 * sigma);
    if (!base || largest > base) base = largest;
    return largest > base / STEADY ? base : largest;
  }

  /** One verdict leads: what the search says where it says that something is missing, else where the model fails. */
  function headline(failures) {
    const said = (text) => h("span", { class: "limits" }, text);
    if (isHiding) sentence.replaceChildren(t("workbench.guess.headline"));
    else if (judged?.verdict) sentence.replaceChildren(judged.verdict);
    else if (failures.length) sentence.replaceChildren(failures[0].sentence);
    // A fit that leaves nothing is read as "nothing is there": how far it holds belongs to it.
    else sentence.replaceChildren(t("workbench.fits"), " ", said(judged ? judged.untested : t("workbench.untested_waiting")));
  }

  /** Everything of the model that is shown; in guessing without a word of where it fails. */
  function draw() {
    const { columns: c, along } = shown;
    const failures = isHiding ? [] : shown.failures;
    const y = reach(c, along);
    residual.set([c.window_s, ...broken(c.window_s, c.residual), compared ? compared.columns.residual : new Array(c.window_s.length).fill(null)], {
      band: { x: c.window_s, half: c.spread.map((s) => 2 * s) }, limits: [-y, y],
      shade: failures.slice(0, 1).filter((f) => f.covariate === "time_s").map((f) => [f.from, f.to]),
    });
    residual.rename(compared ? t("workbench.residual_two") : t(points ? "workbench.residual_points" : "workbench.residual"), t("chart.residual"));
    headline(failures);
    for (const one of along) {
      if (!multiples.has(one.covariate)) multiples.set(one.covariate, multiple(one));
      const { plot, says, figure } = multiples.get(one.covariate);
      const at = (part) => c[`${one.covariate}/${part}`];
      const failing = failures.find((f) => f.covariate === one.covariate);
      plot.set(merged(at("at"), at("residual"), at("middle"), at("mean")), {
        band: { x: at("middle"), half: at("sigma").map((s) => 2 * s) }, limits: [-y, y],
        shade: failing && failing === failures[0] ? [[failing.from, failing.to]] : [],
      });
      says.textContent = isHiding ? "" : failing ? failing.sentence : t("workbench.no_failure");
      figure.classList.toggle("failing", Boolean(failing));
      // What fails in one picture shows faintly in most others: the surest leads.
      figure.classList.toggle("leads", Boolean(failing) && failing === failures[0]);
    }
    if (points) return;
    if (!spectrumPlace.isConnected) { grid.append(spectrumPlace); spectrumPlace.append(h("p", { class: "small muted" }, t("workbench.spectrum_says"))); }
    spectrum.set([c.frequency_hz, c.density, new Array(c.density.length).fill(shown.white_density)]);
  }

  return {
    signal({ columns }) {
      overlay.set([columns.time_s, ...broken(columns.time_s, columns.measured), new Array(columns.time_s.length).fill(null)]);
    },
    /** A fit, and beside its residual that of another model where two are compared. */
    fit(fit, other = null) {
      [shown, compared] = [fit, other];
      drawSignal(fit);
      draw();
    },
    /** The search's word on the model that is shown, empty where it misses nothing, and what it could not test. */
    judge(verdict, untested) {
      judged = { verdict, untested };
      if (shown) headline(shown.failures);
    },
    /** Nothing can be said of it, and why: the signal stays, the places of what would be left of it go. */
    fail(text) {
      sentence.replaceChildren(text);
      for (const node of [...traces.children].slice(1).concat([...place.children].slice(2))) node.hidden = true;
    },
    /** In guessing, each picture can be pointed at. */
    pointing(on, covariate = null) {
      grid.classList.toggle("pointing", on);
      if (on !== isHiding) { isHiding = on; if (shown) draw(); }
      for (const [name, { here }] of multiples) here.setAttribute("aria-pressed", String(name === covariate));
    },
  };
}

/** The columns without a line over a pause: where the next instant is far, nothing is drawn to it. */
function broken(x, ...columns) {
  const steps = Float64Array.from(x.subarray(1), (value, i) => value - x[i]).sort();
  const far = Math.max(1, 5 * (steps[steps.length >> 1] ?? 0));
  return columns.map((column) => Array.from(column, (value, i) => (i && x[i] - x[i - 1] > far ? null : value)));
}

/** Points and a curve with places of its own in one table, as a chart wants them. */
function merged(x1, y1, x2, y2) {
  const n = x1.length + x2.length;
  const [x, a, b] = [new Float64Array(n), new Array(n), new Array(n)];
  for (let i = 0, j = 0, k = 0; k < n; k++) {
    const first = j >= x2.length || (i < x1.length && x1[i] <= x2[j]);
    x[k] = first ? x1[i] : x2[j];
    a[k] = first ? y1[i++] : null;
    b[k] = first ? null : y2[j++];
  }
  return [x, a, b];
}
