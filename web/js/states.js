// The six states in a row, each with how far it is.

import { h } from "./dom.js";
import { duration, t } from "./text.js";

export const STATES = ["estimate_x", "rate_x", "position_x", "estimate_z", "rate_z", "position_z"];
export const UNIT = { rate: "deg/s", position: "deg" };
export const split = (state) => state.split("_");
export const stateName = (state) => t(`state.${state}`);
const FRACTION = { done: 1, kept: 1, waiting: 0 };

/** states: [{name, status, fraction, seconds}]; a state that this run does not repeat is "off". */
export function showStates(place, states, actions = () => null) {
  const known = new Map(states.map((state) => [state.name, state]));
  place.replaceChildren(...STATES.map((name, i) => {
    const state = known.get(name) ?? { status: "off" };
    const fraction = FRACTION[state.status] ?? state.fraction ?? 0;
    const words = state.status === "running" ? t("states.percent", { percent: Math.floor(100 * fraction) })
      : state.status === "waiting" && state.seconds ? duration(state.seconds) : t(`states.${state.status}`);
    const done = h("div", { class: "done" });
    done.style.setProperty("--f", fraction);
    return h("li", { class: { running: "now", off: "off", failed: "failed" }[state.status], "aria-current": state.status === "running" ? "step" : null },
      h("div", { class: "track" }, done), h("span", { class: "what" }, `${i + 1} ${stateName(name)}`), h("span", {}, words), actions(name));
  }));
}
