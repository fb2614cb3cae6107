// Guess first: the evidence stays hidden until the student has pointed at a picture and named a cause.

import { h } from "../dom.js";
import { t } from "../text.js";
import { alongName } from "./pictures.js";

/** The form in place of the suspects; guessed({effect, covariate, why}) is told once,
 * read(effect) of a cause that is looked at, pointed(covariate) of a picture. */
export function guessForm(place, cards, { guessed, pointed, read }) {
  const where = h("p", { class: "pointed" }, t("workbench.guess.point"));
  const names = [...cards.values()].sort((a, b) => a.title.localeCompare(b.title));
  const cause = h("select", { id: "guess-effect", required: true }, h("option", { value: "" }, t("workbench.guess.choose")),
    h("option", { value: "none" }, t("workbench.guess.none")), names.map(({ name, title }) => h("option", { value: name }, title)));
  const why = h("textarea", { id: "guess-why", rows: "2", maxlength: "1000" });
  const show = h("button", { type: "submit", class: "main", id: "show-evidence", disabled: true }, t("workbench.guess.show"));
  let covariate = null;
  const ready = () => { show.disabled = !cause.value || (cause.value !== "none" && !covariate); };
  cause.addEventListener("change", () => { ready(); read(cause.value); });
  place.replaceChildren(h("form", {
    class: "stack guess",
    onsubmit: (event) => {
      event.preventDefault();
      guessed({ effect: cause.value === "none" ? null : cause.value, covariate: covariate?.covariate ?? null, why: why.value.trim() });
    },
  }, h("ol", { class: "steps" },
    h("li", {}, where),
    h("li", {}, h("label", { for: "guess-effect" }, t("workbench.guess.cause")), cause),
    h("li", {}, h("label", { for: "guess-why" }, t("workbench.guess.why")), why)),
  h("div", { class: "row" }, show)));
  return {
    point(along) {
      covariate = along;
      where.replaceChildren(t("workbench.guess.pointed", { along: along.kind === "time" ? t("workbench.along_time") : alongName(along) }));
      ready();
      pointed(along.covariate);
    },
  };
}
