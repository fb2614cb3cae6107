// A student's motion: chosen from what the bench offers, its numbers to be changed, looked at before it is run.

import { api } from "./api.js";
import { chart } from "./chart.js";
import { h, say } from "./dom.js";
import { runName } from "./lab_results.js";
import { duration, plain, t } from "./text.js";

const LISTS = { sine: ["amplitude_deg", "frequency_hz"], multisine: ["amplitude_deg", "frequency_hz"], staircase: ["rates_dps"], poses: ["angles_deg"], hold: [], heat: [] };
const TYPING_MS = 300;

/** motionEditor(place, {exercise, student, onRun(motion, restart, joins)}) -> {runs(list)}: `runs` fills the choice of what to go on from. */
export function motionEditor(place, { exercise, student, onRun }) {
  let motion = [];
  const rows = h("ol", { class: "motions" });
  const error = h("p", { class: "error", role: "alert" });
  const said = h("p", { class: "muted", "aria-live": "polite" });
  const joins = h("select", { id: "joins" });
  const restart = h("input", { type: "checkbox", id: "restart", onchange: () => { joins.disabled = restart.checked; } });
  const more = h("div", { class: "pair", hidden: true }, h("div", {}, h("label", { for: "joins" }, t("lab.joins")), joins),
    h("label", { class: "choice low", for: "restart" }, restart, t("lab.restart")));
  const run = h("button", { class: "main", type: "button", onclick: begin }, t("lab.run"));
  const picture = h("div", {});
  const plot = chart(picture, {
    name: t("lab.picture"), height: 180, wide: true,
    x: { label: t("chart.time"), unit: "s" }, y: { label: t("lab.angle"), unit: "deg", zero: true, digits: 1 },
    series: [{ name: "x", role: "ink", draw: "line" }, { name: "z", role: "ink-2", draw: "dash" }],
  });
  place.replaceChildren(
    h("div", { class: "offers" }, exercise.offers.map(({ name, motion: steps }) => h("button", {
      type: "button", "data-offer": name, onclick: () => { motion.push(...structuredClone(steps)); draw(); },
    }, h("strong", {}, t(`lab.offer_${name}`)), h("span", { class: "small muted" }, t(`lab.why_${name}`))))),
    rows, picture, said,
    more,
    error, h("div", { class: "row" }, run, h("span", { class: "small muted" }, t("lab.run_about"))));

  function draw() {
    rows.replaceChildren(...motion.map(row));
    look();
  }

  function row(step, index) {
    const id = (name) => `motion-${index}-${name}`;
    const list = (name) => h("div", {}, h("label", { for: id(name) }, t(`lab.${name}`)), h("input", {
      id: id(name), value: step[name].map(plain).join(", "), inputmode: "text", autocomplete: "off",
      oninput: ({ target }) => { step[name] = numbers(target.value); soon(); },
    }));
    const axis = h("select", { id: id("axis"), onchange: ({ target }) => { step.axis = target.value; look(); } }, ["x", "z"].map((name) => h("option", { selected: name === step.axis }, name)));
    const seconds = h("input", { id: id("seconds"), type: "number", min: 1, step: "any", value: step.duration_s, oninput: ({ target }) => { step.duration_s = Number(target.value); soon(); } });
    return h("li", {}, h("div", { class: "fields" },
      h("strong", {}, t(`lab.kind_${step.kind}`)),
      step.kind === "hold" || step.kind === "heat" ? null : h("div", {}, h("label", { for: id("axis") }, t("lab.motion_axis")), axis),
      LISTS[step.kind].map(list),
      h("div", {}, h("label", { for: id("seconds") }, t("lab.seconds")), seconds),
      h("button", { type: "button", "aria-label": t("lab.remove_motion", { number: index + 1 }), onclick: () => { motion.splice(index, 1); draw(); } }, t("lab.remove"))));
  }

  let timer;
  const soon = () => { clearTimeout(timer); timer = setTimeout(look, TYPING_MS); };
  let asked = 0;
  /** Where this would send the table, or why it cannot be done: asked of the server, which knows the limits. */
  async function look() {
    const mine = ++asked;
    run.disabled = true;
    say(error, null);
    picture.hidden = !motion.length;
    if (!motion.length) { said.textContent = t("lab.picture_empty"); return; }
    try {
      const shown = await api.labPlan(exercise.code, student, motion);
      if (mine !== asked) return;
      plot.set([shown.time_s, shown.angle_deg.x, shown.angle_deg.z]);
      const warm = Math.max(...shown.warming_degC);
      said.textContent = t(warm > 0.5 ? "lab.takes_warm" : "lab.takes", { time: duration(shown.duration_s), warm });
      run.disabled = false;
    } catch (problem) {
      if (mine !== asked) return;
      said.textContent = "";
      say(error, problem);
    }
  }

  async function begin() {
    run.disabled = true;
    run.textContent = t("lab.running");
    say(error, null);
    try {
      await onRun(motion, restart.checked, restart.checked ? null : joins.value || null);
      motion = [];
      restart.checked = joins.disabled = false;
      draw();
    } catch (problem) {
      say(error, problem);
      run.disabled = false;
    }
    run.textContent = t("lab.run");
  }
  draw();

  return {
    runs(list, session) {
      const own = list.filter((one) => one.session === session).reverse();
      more.hidden = !list.length;
      joins.replaceChildren(...own.map((one) => h("option", { value: one.recording }, t("lab.joins_one", { name: runName(one) }))), h("option", { value: "" }, t("lab.joins_none")));
    },
  };
}

/** "1, 2.5" as numbers; what is none goes as it is, and the server says so. */
const numbers = (text) => text.split(/[,;\s]+/).filter(Boolean).map((part) => (Number.isFinite(Number(part.replace("−", "-"))) ? Number(part.replace("−", "-")) : part));
