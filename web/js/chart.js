// The one module that knows uPlot. A chart is a figure: name, readout, plot.
//
// chart(place, {name, x, y, series, group, height, tight, onZoom}) -> {set, rename, destroy}
//   x, y      {label, unit, digits, zero, min, max, log, bare}; bare: the axis shows its unit alone
//   series    [{name, role: measured|model|residual, draw: line|dash|dots|points|faint|dust|stems, joined, digits}]
//   group     charts of one group share zoom and cursor; onZoom([from, to] or null) hears of it
//   tight     no room for names at the ends of lines
// set([xs, ys…], {from, to, band, shade, limits})  band: half-width of a shaded strip around zero, or {x, half} along x;
//   shade: [[from, to]…], stretches to look at; limits: [lowest, highest] of y.

import { fixed, plain, t } from "./text.js";

const colours = new Map();
function colour(name) {
  if (!colours.has(name)) colours.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
  return colours.get(name);
}

const all = new Set();
for (const query of ["(prefers-color-scheme: dark)", "print"]) {
  matchMedia(query).addEventListener("change", () => {
    colours.clear();
    for (const plot of all) plot.redraw(false);
  });
}

const groups = new Map();
const DASH = { line: [], dash: [8, 5], dots: [2, 4] };
const FONT = "12px Sarabun, system-ui, sans-serif";

const measure = document.createElement("canvas").getContext("2d");
function widthOf(text) {
  measure.font = FONT;
  return measure.measureText(text).width;
}

function stems(plot, index, first, last) {
  const path = new Path2D();
  const zero = plot.valToPos(0, "y", true);
  for (let i = first; i <= last; i++) {
    const value = plot.data[index][i];
    if (value == null) continue;
    const x = plot.valToPos(plot.data[0][i], "x", true);
    path.moveTo(x, zero);
    path.lineTo(x, plot.valToPos(value, "y", true));
  }
  return { stroke: path };
}

function seriesOptions({ role, draw, joined = false }) {
  const stroke = () => colour(role);
  const dots = (size) => ({ show: true, size, fill: stroke, stroke, width: 0 });
  if (draw === "points") return { stroke, paths: () => null, points: dots(6) };
  if (draw === "dust") return { stroke: () => colour(`${role}-dust`), paths: () => null, points: { show: true, size: 3, width: 0, fill: () => colour(`${role}-dust`) } };
  if (draw === "faint") return { stroke, paths: () => null, points: { show: true, size: 4, width: 1, fill: () => colour("paper"), stroke } };
  if (draw === "stems") return { stroke, width: 1.5, paths: stems, points: dots(6) };
  return { stroke, width: 1.5, dash: DASH[draw], points: { show: false }, spanGaps: joined };
}

/** Names stand at the ends of their lines; where lines meet, names are moved apart. */
function drawNames(plot, spec) {
  const { ctx, bbox } = plot;
  const ratio = devicePixelRatio;
  const names = [];
  spec.series.forEach((series, i) => {
    if (!series.name) return;
    const column = plot.data[i + 1];
    let last = Math.min(plot.series[0].idxs?.[1] ?? column.length - 1, column.length - 1);
    while (last >= 0 && column[last] == null) last--;
    if (last < 0) return;
    const y = Math.min(Math.max(plot.valToPos(column[last], "y", true), bbox.top), bbox.top + bbox.height);
    names.push({ ...series, y });
  });
  names.sort((a, b) => a.y - b.y);
  const step = 15 * ratio;
  names.forEach((name, i) => { if (i) name.y = Math.max(name.y, names[i - 1].y + step); });
  const over = names.length ? names.at(-1).y - (bbox.top + bbox.height) : 0;
  if (over > 0) for (const name of names) name.y -= over;
  for (let i = names.length - 2; i >= 0; i--) names[i].y = Math.min(names[i].y, names[i + 1].y - step);
  ctx.save();
  ctx.font = FONT.replace("12px", `${12 * ratio}px`);
  ctx.textBaseline = "middle";
  ctx.textAlign = "left";
  const x = bbox.left + bbox.width + 4 * ratio;
  for (const { name, role, draw, y } of names) {
    ctx.fillStyle = ctx.strokeStyle = colour(role);
    ctx.lineWidth = 1.5 * ratio;
    ctx.setLineDash((DASH[draw] ?? []).map((d) => d * ratio));
    ctx.beginPath();
    if (draw in DASH) { ctx.moveTo(x, y); ctx.lineTo(x + 16 * ratio, y); ctx.stroke(); }
    else { ctx.arc(x + 8 * ratio, y, 3 * ratio, 0, 7); draw === "faint" ? (ctx.setLineDash([]), ctx.stroke()) : ctx.fill(); }
    ctx.fillText(name, x + 20 * ratio, y);
  }
  ctx.restore();
}

function drawBack(plot, spec, state) {
  const { ctx, bbox } = plot;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  for (const [from, to] of state.shade) {
    const [left, right] = [plot.valToPos(from, "x", true), plot.valToPos(to, "x", true)];
    ctx.fillStyle = colour("look-soft");
    ctx.fillRect(left, bbox.top, Math.max(right - left, 2), bbox.height);
  }
  if (state.band?.x) {
    const { x, half } = state.band;
    ctx.fillStyle = colour("band");
    ctx.beginPath();
    for (let i = 0; i < x.length; i++) ctx.lineTo(plot.valToPos(x[i], "x", true), plot.valToPos(half[i], "y", true));
    for (let i = x.length - 1; i >= 0; i--) ctx.lineTo(plot.valToPos(x[i], "x", true), plot.valToPos(-half[i], "y", true));
    ctx.fill();
  } else if (state.band) {
    const top = plot.valToPos(state.band, "y", true);
    ctx.fillStyle = colour("band");
    ctx.fillRect(bbox.left, top, bbox.width, plot.valToPos(-state.band, "y", true) - top);
  }
  if (spec.y.zero) {
    const zero = plot.valToPos(0, "y", true);
    ctx.strokeStyle = colour("zero");
    ctx.lineWidth = devicePixelRatio;
    ctx.beginPath();
    ctx.moveTo(bbox.left, zero);
    ctx.lineTo(bbox.left + bbox.width, zero);
    ctx.stroke();
  }
  ctx.restore();
}

function yRange(spec, state, low, high) {
  if (low == null) return [spec.y.min ?? -1, spec.y.max ?? 1];
  if (state.limits) return state.limits;
  if (spec.y.log) return [10 ** Math.floor(Math.log10(low)), 10 ** Math.ceil(Math.log10(high))];
  const reach = state.band?.x ? Math.max(0, ...state.band.half) : state.band ?? 0;
  let [from, to] = [Math.min(low, -reach || low), Math.max(high, reach || high)];
  if (spec.y.zero) [from, to] = [Math.min(from, 0), Math.max(to, 0)];
  // A nearly constant signal must not fill the picture with its last digit.
  const least = spec.y.least ?? 0;
  const pad = Math.max((to - from) * 0.08, (least - (to - from)) / 2, 1e-9);
  return [from - pad, to + pad];
}

const axisLabel = ({ label, unit, bare }) => (bare ? unit : unit ? `${label}, ${unit}` : label);

export function chart(place, spec) {
  const figure = document.createElement("figure");
  figure.className = `chart ${spec.wide ? "wide" : ""}`;
  figure.innerHTML = '<figcaption><span class="name"></span><output class="readout"></output></figcaption>'
    + '<div class="plot" tabindex="0" role="application"><p class="waiting"></p></div>';
  const [name, readout] = figure.querySelectorAll(".name, .readout");
  const [box, waiting] = [figure.querySelector(".plot"), figure.querySelector(".waiting")];
  name.textContent = spec.name;
  box.setAttribute("aria-label", `${spec.name}. ${t("chart.keys")}`);
  box.style.setProperty("--h", `${spec.height ?? 220}px`);
  waiting.textContent = spec.waiting ?? "";
  place.append(figure);

  const state = { band: null, shade: [], limits: null, range: null, zoom: null };
  const group = spec.group ?? Symbol("alone");
  if (!groups.has(group)) groups.set(group, new Set());
  // Pictures above each other share their time axis, so their names get the same room.
  const room = spec.tight ? 16 : Math.max(innerWidth > 720 ? 92 : 0, ...spec.series.map((series) => (series.name ? widthOf(series.name) + 26 : 8)));
  let plot = null;

  function zoom(range) {
    for (const member of groups.get(group)) member.zoom(range);
  }
  const self = {
    zoom(range) {
      state.zoom = range;
      if (plot) plot.setScale("x", between());
      spec.onZoom?.(range);
    },
  };
  groups.get(group).add(self);

  function between() {
    const xs = plot?.data[0] ?? [];
    if (state.zoom) return { min: state.zoom[0], max: state.zoom[1] };
    if (state.range) return { min: state.range[0], max: state.range[1] };
    const [first, last] = [xs[0] ?? 0, xs[xs.length - 1] ?? 1];
    const pad = spec.x.pad ? (last - first) * 0.04 : 0;
    return first === last ? { min: first - 1, max: last + 1 } : { min: first - pad, max: last + pad };
  }

  function read(index) {
    if (index == null || plot.data[0][index] == null) { readout.textContent = ""; return; }
    const parts = [`${spec.x.label} ${fixed(plot.data[0][index], spec.x.digits ?? 2)} ${spec.x.unit ?? ""}`];
    spec.series.forEach((series, i) => {
      const value = plot.data[i + 1][index];
      const label = series.name ?? series.reads;
      if (value != null && label) parts.push(`${label} ${fixed(value, series.digits ?? spec.y.digits ?? 2)} ${spec.y.unit ?? ""}`);
    });
    readout.textContent = parts.join(" · ");
  }

  function build(data) {
    const axis = (extra) => ({
      stroke: () => colour("ink-2"), font: FONT, labelFont: FONT, labelSize: 18, labelGap: 0,
      grid: { stroke: () => colour("grid"), width: 1 }, ticks: { show: false }, ...extra,
    });
    plot = new uPlot({
      width: box.clientWidth, height: box.clientHeight, padding: [8, room, 0, 0], legend: { show: false },
      scales: { x: { time: false, distr: spec.x.log ? 3 : 1 }, y: { distr: spec.y.log ? 3 : 1, range: (_, low, high) => yRange(spec, state, low, high) } },
      axes: [
        axis({ label: axisLabel(spec.x), size: 26, values: (_, ticks) => tickWords(ticks, spec.x.log) }),
        axis({ label: axisLabel(spec.y), size: 52, space: 22, values: (_, ticks) => tickWords(ticks, spec.y.log) }),
      ],
      series: [{}, ...spec.series.map(seriesOptions)],
      cursor: {
        points: { size: 7 }, y: false, drag: { x: true, y: false, setScale: false, dist: 6 },
        sync: spec.group ? { key: spec.group, scales: ["x", null] } : undefined,
        bind: { dblclick: () => () => { zoom(null); return null; } },
      },
      hooks: {
        drawAxes: [(u) => drawBack(u, spec, state)],
        draw: [(u) => drawNames(u, spec)],
        setCursor: [(u) => read(u.cursor.idx)],
        setSelect: [(u) => {
          if (u.select.width < 6) return;
          const [from, to] = [u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x")];
          u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
          zoom([from, to]);
        }],
      },
    }, data, box);
    all.add(plot);
    observer.observe(box);
  }

  const observer = new ResizeObserver(() => {
    if (plot && box.clientWidth) plot.setSize({ width: box.clientWidth, height: box.clientHeight });
  });

  box.addEventListener("keydown", (event) => {
    if (!plot) return;
    const last = plot.data[0].length - 1;
    const here = plot.cursor.idx ?? last;
    const stride = event.shiftKey ? 10 : 1;
    const moves = { ArrowLeft: here - stride, ArrowRight: here + stride, Home: 0, End: last };
    if (event.key === "Escape") zoom(null);
    else if (event.key in moves) {
      const to = Math.max(0, Math.min(last, moves[event.key]));
      plot.setCursor({ left: plot.valToPos(plot.data[0][to], "x"), top: plot.bbox.height / 2 / devicePixelRatio });
    } else return;
    event.preventDefault();
  });

  return {
    set(data, { from, to, band = null, shade = [], limits = null } = {}) {
      Object.assign(state, { band, shade, limits, range: from === undefined ? null : [from, to] });
      const isEmpty = data[0].length === 0;
      waiting.hidden = !isEmpty;
      if (!plot) {
        if (isEmpty) return;
        build(data);
        plot.setScale("x", between());
        return;
      }
      plot.batch(() => {
        plot.setData(data, false);
        plot.setScale("x", between());
      });
    },
    rename(text, yLabel) {
      name.textContent = text;
      spec.y.label = yLabel;
      if (plot) plot.axes[1].label = axisLabel(spec.y);
    },
    destroy() {
      groups.get(group).delete(self);
      observer.disconnect();
      if (plot) { all.delete(plot); plot.destroy(); }
      figure.remove();
    },
  };
}

const tickWords = (ticks, isLog) => ticks.map((tick) => (tick == null ? "" : isLog ? plain(tick) : fixed(tick, step(ticks))));

/** Decimals that the distance between ticks asks for. */
function step(ticks) {
  const distance = ticks.length > 1 ? Math.abs(ticks[1] - ticks[0]) : 1;
  const digits = Math.max(0, -Math.floor(Math.log10(distance) + 1e-9));
  // A quarter takes one more: 1.75 is not 1.8.
  const steps = distance * 10 ** digits;
  return Math.abs(steps - Math.round(steps)) > 1e-6 ? digits + 1 : digits;
}
