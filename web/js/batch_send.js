// Where recordings are dropped: what was chosen, how it is judged, and how far it has been sent.

import { api } from "./api.js";
import { h, say } from "./dom.js";
import { fixed, t } from "./text.js";

const isZip = (file) => /\.zip$/i.test(file.name);
const MB = 1e6;

/** A panel that calls sent(batch) once the server has the files. */
export function sendPanel(sent) {
  let chosen = [];
  let key = null; // the same files again are the same request
  const error = h("p", { class: "error", role: "alert" });
  const told = h("output", {});
  const bar = h("div", {});
  const progress = h("div", { class: "progress", hidden: true }, bar);
  const input = h("input", { id: "files", type: "file", multiple: true, accept: ".csv,.gz,.parquet,.zip", class: "unseen", tabindex: "-1", onchange: () => choose([...input.files]) });
  const pick = h("button", { type: "button", onclick: () => input.click() }, t("batch.choose"));
  const spec = h("input", { id: "spec", type: "file", accept: ".json" });
  const model = h("select", { id: "model" }, h("option", { value: "" }, t("batch.model_own")));
  const send = h("button", { type: "button", class: "main", hidden: true, onclick: start });
  const place = h("div", { class: "drop stack" }, h("p", { class: "measure" }, t("batch.empty")), h("label", { for: "files", class: "unseen" }, t("batch.choose")), input, pick, told, send, progress, error);
  api.gyroModels().then(({ items }) => model.append(...items.map(({ id, name }) => h("option", { value: id }, name || id))), () => {});

  for (const name of ["dragenter", "dragover"]) place.addEventListener(name, (event) => { event.preventDefault(); place.classList.add("over"); });
  for (const name of ["dragleave", "drop"]) place.addEventListener(name, () => place.classList.remove("over"));
  place.addEventListener("drop", (event) => { event.preventDefault(); choose([...event.dataTransfer.files]); });
  // A file that misses the frame must not take the page away.
  for (const name of ["dragover", "drop"]) addEventListener(name, (event) => event.preventDefault());

  function choose(files) {
    if (!files.length) return;
    chosen = files;
    key = crypto.randomUUID?.() ?? `${Date.now()}-${Math.random()}`;
    say(error, null);
    const size = files.reduce((sum, file) => sum + file.size, 0) / MB;
    told.textContent = t("batch.chosen", { files: files.length, size: fixed(size, size < 10 ? 1 : 0) });
    send.textContent = t("batch.certify");
    send.hidden = false;
    send.focus();
  }

  async function start() {
    const archives = chosen.filter(isZip);
    if (archives.length && chosen.length > 1) return say(error, new Error(t("batch.one_zip")));
    say(error, null);
    const form = new FormData();
    if (model.value) form.append("gyro_model", model.value);
    if (spec.files.length) form.append("spec", await spec.files[0].text());
    for (const file of chosen) form.append(archives.length ? "archive" : "files", file);
    progress.hidden = false;
    send.disabled = pick.disabled = true;
    try {
      const batch = await api.sendBatch(form, key, (part) => {
        bar.style.setProperty("--f", part);
        told.textContent = part < 1 ? t("batch.sending", { part: Math.round(100 * part) }) : t("batch.unpacking");
      });
      input.value = told.textContent = "";
      send.hidden = true;
      place.classList.add("again");
      await sent(batch);
    } catch (problem) {
      told.textContent = "";
      say(error, problem);
    }
    progress.hidden = true;
    send.disabled = pick.disabled = false;
  }

  return h("section", { class: "panel stack no-print" }, place,
    h("details", {}, h("summary", {}, t("batch.options")), h("div", { class: "options" },
      h("div", {}, h("label", { for: "spec" }, t("batch.limits")), spec),
      h("div", {}, h("label", { for: "model" }, t("batch.model")), model))));
}
