// The calibration of the rig's encoders: pairs of what the encoder read and what a better angle was, axis by axis.

import { api } from "./api.js";
import { h, say, table } from "./dom.js";
import { fixed, t } from "./text.js";

const AXES = ["x", "z"];
const field = (id, control, key, values) => h("div", {}, h("label", { for: id }, t(key, values)), control);
const asText = (points) => (points ?? []).map((pair) => pair.join(" ")).join("\n");
/** "-90 -89.5" a line, or with a comma or a tab between; what is no pair of numbers stays for the server to refuse. */
const asPoints = (text) => text.split("\n").map((line) => line.trim()).filter(Boolean).map((line) => line.split(/[\s,;]+/).map(Number));

/** Fills `place`; `show(rig)` asks again once another rig is chosen. */
export function referenceCard(place) {
  const [date, means, by] = [h("input", { id: "ref-date", type: "date" }), h("input", { id: "ref-means", maxlength: 200 }), h("input", { id: "ref-by", maxlength: 200, autocomplete: "name" })];
  const pairs = Object.fromEntries(AXES.map((axis) => [axis, h("textarea", { id: `ref-${axis}`, rows: 5, spellcheck: "false", placeholder: "-90 -89.6\n90 90.2" })]));
  const within = Object.fromEntries(AXES.map((axis) => [axis, h("input", { id: `ref-u-${axis}`, type: "number", min: 0.001, max: 9.9, step: "any" })]));
  const now = h("div", {});
  const error = h("p", { class: "error", role: "alert" });
  const save = h("button", { type: "button", id: "ref-save", onclick: () => attempt(() => api.setReference(record())) }, t("reference.save"));
  const drop = h("button", { type: "button", id: "ref-drop", onclick: () => attempt(async () => { await api.dropReference(); return api.reference(); }) }, t("reference.drop"));
  place.replaceChildren(h("h2", {}, t("reference.title")), now, h("details", {}, h("summary", {}, t("reference.edit")), h("div", { class: "stack" },
    h("p", { class: "small" }, t("reference.about")), h("div", { class: "pair" }, field("ref-date", date, "reference.date"), field("ref-means", means, "reference.means")), field("ref-by", by, "reference.by"),
    AXES.flatMap((axis) => [field(`ref-${axis}`, pairs[axis], "reference.pairs", { axis }), field(`ref-u-${axis}`, within[axis], "reference.within", { axis })]),
    error, h("div", { class: "row" }, save, drop))));

  const record = () => ({
    date: date.value, means: means.value.trim(), by: by.value.trim(),
    axes: Object.fromEntries(AXES.filter((axis) => pairs[axis].value.trim()).map((axis) =>
      [axis, { points: asPoints(pairs[axis].value), standard_uncertainty_deg: Number(within[axis].value) }])),
  });

  async function attempt(call) {
    say(error, null);
    try { fill(await call()); } catch (problem) { say(error, problem); }
  }

  function fill({ record: known, name, gains }) {
    now.replaceChildren(h("p", {}, known ? name : t("reference.none")),
      known ? table([t("rig.axis"), { n: t("reference.gain") }, { n: "± %" }], Object.entries(gains).map(([axis, gain]) =>
        [axis, { n: fixed(gain.scale, 5) }, { n: fixed(100 * gain.scale_uncertainty, 2) }]), { compact: true, label: t("reference.title") }) : "");
    drop.hidden = !known;
    [date.value, means.value, by.value] = [known?.date ?? "", known?.means ?? "", known?.by ?? ""];
    for (const axis of AXES) {
      pairs[axis].value = asText(known?.axes[axis]?.points);
      within[axis].value = known?.axes[axis]?.standard_uncertainty_deg ?? "";
    }
  }

  let shown = null;
  return {
    show(rig) {
      if (rig.url === shown) return;
      shown = rig.url;
      attempt(api.reference);
    },
  };
}
