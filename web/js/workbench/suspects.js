// The suspects: every effect with its evidence; rivals tied together; what cannot be tested, and why.

import { h } from "../dom.js";
import { fixed, t } from "../text.js";

/** A quarter of a bar's length is what noise alone reaches; beyond it the scale is logarithmic. */
const QUARTER = 25;
const FEW = 5;

function length(z, threshold, largest) {
  if (!(z > 0)) return 0;
  if (z < threshold) return (QUARTER * z) / threshold;
  return QUARTER + (100 - QUARTER) * (Math.log(z / threshold) / Math.log(Math.max(largest / threshold, 4)));
}

/** While the library is searched: every effect that this recording can show, to be added without waiting for its evidence. */
export function showByHand(place, cards, model, { open, toggle }) {
  const isIn = (name) => model.effects.includes(name);
  const possible = [...cards.values()].filter(({ name }) => model.possible?.includes(name)).sort((a, b) => a.title.localeCompare(b.title));
  const wasOpen = place.querySelector("details")?.open ?? false;
  place.replaceChildren(h("details", { open: wasOpen }, h("summary", {}, t("workbench.by_hand")),
    h("ul", { class: "suspects" }, possible.map(({ name, title }) => h("li", { class: isIn(name) ? "in_model" : null, "data-effect": name },
      h("button", { type: "button", class: "name", onclick: () => open(name) }, title), h("span", {}),
      h("button", { type: "button", class: "add", "aria-label": t(isIn(name) ? "workbench.remove_named" : "workbench.add_named", { effect: title }), onclick: () => toggle(name, isIn(name)) },
        t(isIn(name) ? "workbench.remove" : "workbench.add")))))));
}

/** Shows `answer` of the server in place. open(effect), toggle(effect, inModel), decide() (null: no motion can) are what its
 * buttons do; `guess` is the effect that the student named. */
export function showSuspects(place, answer, { open, toggle, decide, guess }) {
  const { suspects, threshold } = answer;
  const largest = Math.max(threshold, ...suspects.map(({ z }) => z ?? 0));
  const tied = new Map();
  for (const s of suspects) if (s.tie !== null) tied.set(s.tie, [...(tied.get(s.tie) ?? []), s]);

  function row(s) {
    const bar = h("span", { class: "evidence", role: "img", "aria-label": s.z == null ? s.sentence : t("workbench.bar", { z: fixed(s.z, 1), threshold: fixed(threshold, 1) }) });
    bar.style.setProperty("--w", `${length(s.z, threshold, largest)}%`);
    const isTested = s.status === "tested";
    return h("li", { class: [s.word, s.effect === guess ? "guessed" : ""].join(" ").trim(), "data-effect": s.effect },
      h("button", { type: "button", class: "name", onclick: () => open(s.effect) }, s.title),
      isTested && !s.in_model ? bar : h("span", {}),
      h("p", { class: "small" }, s.effect === guess ? h("strong", {}, `${t("workbench.guess.yours")} `) : null, s.sentence),
      s.can_be_added || s.in_model
        ? h("button", { type: "button", class: "add", "aria-label": t(s.in_model ? "workbench.remove_named" : "workbench.add_named", { effect: s.title }), onclick: () => toggle(s.effect, s.in_model) },
          t(s.in_model ? "workbench.remove" : "workbench.add"))
        : h("span", {}));
  }

  const drawn = new Set();
  const rows = [];
  for (const s of suspects) {
    if (drawn.has(s.effect)) continue;
    const group = s.tie === null ? [s] : tied.get(s.tie);
    for (const one of group) drawn.add(one.effect);
    rows.push([group, group.length < 2 ? row(s)
      : h("li", { class: "tied" }, h("div", { class: "row spread" }, h("p", { class: "small" }, t(["certain", "likely", "probable"].includes(group[0].word) ? `workbench.tied_${group[0].word}` : "workbench.tied")), decide && h("button", { type: "button", class: "add decide", onclick: decide }, t("workbench.decide"))), h("ul", {}, group.map(row)))]);
  }
  const isFirst = ([group], k) => k < FEW || group.some((s) => s.in_model || !["nothing", "no_data", "not_excited", "spanned"].includes(s.word) || s.effect === guess);
  const first = rows.filter(isFirst);
  const rest = rows.filter((one, k) => !isFirst(one, k));
  const wasOpen = place.querySelector("details")?.open ?? false;
  place.replaceChildren(
    h("ul", { class: "suspects" }, first.map(([, node]) => node)),
    rest.length ? h("details", { open: wasOpen }, h("summary", {}, t("workbench.all_effects", { count: suspects.length })), h("ul", { class: "suspects" }, rest.map(([, node]) => node))) : "",
    h("p", { class: "small muted" }, t("workbench.evidence_scale")));
}
