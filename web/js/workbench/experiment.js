// The motion that would settle what this recording cannot: shown, run with one click, and judged with the data in hand.

import { api } from "../api.js";
import { chart } from "../chart.js";
import { h, say, waiting } from "../dom.js";
import { duration, t } from "../text.js";

const ASK_MS = 400;

/** ask() gives {recording, axis, effects} as they are now; run(experiment, motion) does it and gives the recording of
 * both together; progress() says how far a search is; done(recording, verdict) is told of it. */
export function experimentPanel(place, { ask, progress, run, done, rig }) {
  const error = h("p", { class: "error", role: "alert" });
  const told = h("div", { class: "stack", "aria-live": "polite" });
  const find = h("button", { type: "button", id: "propose", onclick: propose }, t("workbench.next.find"));
  place.replaceChildren(h("h2", {}, t("workbench.next.title")), h("p", { class: "small muted" }, t("workbench.next.why")), h("div", { class: "row" }, find), error, told);
  let plot = null;

  function clear() {
    say(error, null);
    plot?.destroy();
    plot = null;
    told.replaceChildren();
  }

  async function propose() {
    clear();
    find.disabled = true;
    told.replaceChildren(waiting(t("workbench.next.finding"), progress));
    try {
      const experiment = await api.proposeExperiment(ask());
      const path = await api.experimentMotion(experiment.id);
      told.replaceChildren(h("p", {}, experiment.next_experiment.sentence));
      plot = chart(told, {
        name: t("workbench.next.motion", { duration: duration(path.time_s.at(-1)) }), height: 150,
        x: { label: t("chart.time"), unit: "s", digits: 1 }, y: { label: t("chart.angle"), unit: "deg", zero: true, digits: 1 },
        series: Object.keys(path.angle_deg).map((axis, i) => ({ name: axis, role: i ? "measured" : "model", draw: i ? "dots" : "line" })),
      });
      plot.set([path.time_s, ...Object.values(path.angle_deg)]);
      const go = h("button", { type: "button", class: "main", id: "run-experiment", onclick: () => perform(experiment, go) }, t("workbench.next.run", { rig: rig() }));
      told.append(h("div", { class: "row" }, go));
    } catch (problem) { clear(); say(error, problem); }
    find.disabled = false;
  }

  async function perform(experiment, go) {
    say(error, null);
    go.disabled = true;
    go.textContent = t("workbench.next.running");
    try {
      const { recording, diagnosis } = await run(experiment);
      go.remove();
      told.append(h("p", { class: "verdict" }, diagnosis?.sentence ?? t("workbench.next.done")),
        h("div", { class: "row" }, h("button", { type: "button", class: "main", id: "open-joined", onclick: () => done(recording) }, t("workbench.next.open"))));
      done(recording, { experiment, diagnosis });
    } catch (problem) {
      say(error, problem);
      go.disabled = false;
      go.textContent = t("workbench.next.run", { rig: rig() });
    }
  }
  return {
    propose,
    /** What the button is called: rivals are to be told apart, or what this motion hardly shows is to be tested. */
    label: ({ suspects }) => {
      const isTied = suspects.some(({ tie }) => tie !== null);
      find.textContent = t(!isTied && suspects.some(({ word }) => word === "not_excited") ? "workbench.next.find_more" : "workbench.next.find");
    },
  };
}

/** Runs a proposed experiment on the rig that is chosen, and waits for the verdict on all data together. */
export async function onRig(experiment) {
  await api.runExperiment(experiment.id);
  for (;;) {
    const now = await api.experiment(experiment.id);
    if (now.status === "done") return now.result;
    if (now.status === "failed") throw new Error(now.message?.sentence ?? t("run.sentence_failed"));
    await new Promise((resolve) => { setTimeout(resolve, ASK_MS); });
  }
}
