// The form beside the run: what to calibrate, with what, how; refusals stand beside the field that caused them.

import { api } from "./api.js";
import { $, h } from "./dom.js";
import { editModel } from "./model_editor.js";
import { rigCard } from "./rig_card.js";
import { t } from "./text.js";

const KEPT = "gyrobench.setup";
const RANGES = ["rate_dps", "position_deg", "sine_deg"];
// Where a refusal belongs: by the field the server names, else by the first word of its code.
const PLACES = {
  board: "board", gyro_model: "gyro_model", readings: "readings", seed: "readings", spec: "spec", ranges: "ranges", plan: "ranges",
  motion: "ranges", axis: "ranges", rig: "rig", device: "rig", run: "form", room_temperature_degC: "temperature", conditions: "temperature",
};

export class Setup {
  models = [];

  constructor(form, { onStart, onChange }) {
    this.form = form;
    this.rig = rigCard($("#rig-card"));
    document.addEventListener("rig-changed", ({ detail }) => this.rig.show(detail));
    form.addEventListener("submit", (event) => { event.preventDefault(); onStart(); });
    form.addEventListener("input", () => { this.remember(); onChange(); });
    form.gyro_model.addEventListener("change", () => this.showRanges());
    $("#edit-model").addEventListener("click", async () => {
      const chosen = await editModel(this.model);
      if (chosen === null) return;
      await this.loadModels(chosen || undefined);
      onChange();
    });
  }

  get model() { return this.models.find((model) => model.id === this.form.gyro_model.value); }

  async load() {
    const kept = JSON.parse(localStorage.getItem(KEPT) ?? "{}");
    for (const [name, value] of Object.entries(kept)) if (this.form[name]) this.form[name].value = value;
    await this.loadModels(kept.gyro_model);
    const boards = await api.boards({ limit: 50 });
    $("#boards").replaceChildren(...boards.items.map(({ id }) => h("option", { value: id })));
  }

  async loadModels(chosen) {
    this.models = (await api.gyroModels()).items;
    this.form.gyro_model.replaceChildren(...this.models.map(({ id, name }) => h("option", { value: id }, name)));
    if (this.models.some(({ id }) => id === chosen)) this.form.gyro_model.value = chosen;
    this.showRanges();
  }

  showRanges() {
    for (const axis of ["x", "z"]) for (const key of RANGES) this.form[`${axis}.${key}`].placeholder = this.model?.ranges?.[axis]?.[key] ?? "";
  }

  remember() {
    const kept = Object.fromEntries(["gyro_model", "profile", "operator", "temperature"].map((name) => [name, this.form[name].value]));
    localStorage.setItem(KEPT, JSON.stringify(kept));
  }

  /** The body of POST runs; empty fields are left out so that the server's defaults hold. */
  async body() {
    const form = this.form;
    const number = (name) => (form[name].value === "" ? undefined : Number(form[name].value));
    const ranges = {};
    for (const axis of ["x", "z"]) {
      for (const key of RANGES) {
        const value = number(`${axis}.${key}`);
        if (value !== undefined) (ranges[axis] ??= { ...this.model?.ranges?.[axis] })[key] = value;
      }
    }
    const file = form.spec.files[0];
    let spec;
    if (file) {
      try { spec = JSON.parse(await file.text()); } catch { throw Object.assign(new Error(t("setup.spec_unreadable", { file: file.name })), { code: "spec" }); }
    }
    const temperature = number("temperature");
    const full = {
      board: form.board.value.trim(), gyro_model: form.gyro_model.value, profile: form.profile.value,
      operator: form.operator.value.trim() || undefined, note: form.note.value.trim() || undefined,
      readings: number("readings"), seed: number("seed"), spec,
      ranges: Object.keys(ranges).length ? ranges : undefined,
      conditions: temperature === undefined ? undefined : { room_temperature_degC: temperature },
    };
    return Object.fromEntries(Object.entries(full).filter(([, value]) => value !== undefined));
  }

  /** Shows the sentence beside the field it is about; without a problem, none. */
  refuse(problem, { focus = false } = {}) {
    for (const place of this.form.querySelectorAll("[data-for]")) place.textContent = "";
    for (const field of this.form.querySelectorAll("[aria-invalid]")) field.removeAttribute("aria-invalid");
    if (!problem) return;
    const named = String(problem.values?.field ?? "").split(".");
    const key = [...named, (problem.code ?? "").split(".")[0]].map((word) => PLACES[word]).find(Boolean) ?? "form";
    const place = $(`[data-for="${key}"]`, this.form);
    place.textContent = problem.message;
    const details = place.closest("details");
    if (details) details.open = true;
    const field = this.form[key];
    if (field?.setAttribute) {
      field.setAttribute("aria-invalid", "true");
      if (focus) field.focus();
    }
  }
}
