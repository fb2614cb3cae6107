// Rig: which one, what of it answers, what to do about the rest, and who holds it.

import { api } from "../api.js";
import { facts, h, say, table } from "../dom.js";
import { partsList, rigCard } from "../rig_card.js";
import { referenceCard } from "../rig_reference.js";
import { page, rigSentence } from "../shell.js";
import { fixed, plain, t } from "../text.js";

page("rig", async (main) => {
  const state = h("p", { class: "muted" });
  const card = h("section", { class: "panel stack" });
  const limits = h("section", { class: "panel stack" });
  const physics = h("section", { class: "panel stack", id: "physics" });
  const reference = h("section", { class: "panel stack", id: "reference" });
  const holder = h("section", { class: "panel stack" });
  main.append(h("h1", {}, t("page.rig")), state, h("div", { class: "columns" }, card, h("div", { class: "stack" }, physics, limits, reference, holder)));
  const choose = rigCard(card, { full: true });
  const calibration = referenceCard(reference);

  const name = h("input", { id: "holder", autocomplete: "name", maxlength: 80 });
  const error = h("p", { class: "error", role: "alert" });
  const told = h("p", {});
  const attempt = (work) => async () => {
    say(error, null);
    try { await work(); document.dispatchEvent(new Event("rig-asked")); } catch (problem) { say(error, problem); }
  };
  holder.append(h("h2", {}, t("rig.holder_title")), told, h("div", {}, h("label", { for: "holder" }, t("rig.your_name")), name), error,
    h("div", { class: "row" }, h("button", { type: "button", onclick: attempt(() => api.holdRig(name.value.trim())) }, t("rig.hold")),
      h("button", { type: "button", onclick: attempt(() => api.releaseRig()) }, t("rig.release"))));

  const model = h("select", { id: "check-model" });
  const start = h("button", { type: "button", id: "start-check" }, t("rig.start_check"));
  const wrong = h("p", { class: "error", role: "alert" });
  const checks = h("div", { "aria-live": "polite" });
  start.addEventListener("click", async () => {
    say(wrong, null);
    try { await api.startCheck(model.value); document.dispatchEvent(new Event("rig-asked")); } catch (problem) { say(wrong, problem); }
  });
  physics.append(h("h2", {}, t("rig.physics")), h("p", {}, t("rig.physics_about")),
    h("div", {}, h("label", { for: "check-model" }, t("rig.model")), model), h("div", { class: "row" }, start), wrong, checks);
  let shown = "";

  function showChecks(rig) {
    start.disabled = rig.checking || rig.run != null;
    start.textContent = t(rig.checking ? "rig.checking" : "rig.start_check");
    if (JSON.stringify(rig.checks) !== shown) checks.replaceChildren(...(rig.checks.length ? [partsList(rig.checks, true)] : []));
    shown = JSON.stringify(rig.checks);
    if (rig.checking) setTimeout(() => document.dispatchEvent(new Event("rig-asked")), 1000);
  }

  document.addEventListener("rig-changed", ({ detail: rig }) => {
    state.textContent = rigSentence(rig);
    choose.show(rig);
    showChecks(rig);
    calibration.show(rig);
    told.textContent = rig.lease ? t("rig.lease", { holder: rig.lease.holder }) : t("rig.no_lease");
    limits.replaceChildren(h("h2", {}, t("rig.limits")), facts([[t("rig.address"), rig.url]]),
      table(["", { n: `${t("rig.from")}, deg` }, { n: `${t("rig.to")}, deg` }, { n: `${t("rig.top_speed")}, deg/s` }],
        Object.entries(rig.axes ?? {}).map(([axis, a]) => [axis, { n: plain(a.min_deg) }, { n: plain(a.max_deg) }, { n: fixed(a.max_rate_dps, 0) }]), { cards: true, label: t("rig.limits") }));
  });

  const { items } = await api.gyroModels();
  model.replaceChildren(...items.map(({ id, name: words }) => h("option", { value: id }, words)));
});
