// Choosing a recording: an example, one of the instrument's own, or a file.

import { api, links } from "../api.js";
import { h, say } from "../dom.js";
import { list, recordingName } from "../list.js";
import { duration, t, when } from "../text.js";

/** Shows what there is to open; choosing goes to the recording's own address. */
export async function choose(main, carried) {
  const error = h("p", { class: "error", role: "alert" });
  const go = ({ id, axis }) => { location.href = links.workbench(id, axis, carried); };

  async function attempt(button, work) {
    say(error, null);
    button.disabled = true;
    try { await work(); } catch (problem) { say(error, problem); button.disabled = false; }
  }

  const examples = h("div", { class: "examples" });
  const file = h("input", { id: "file", type: "file", accept: ".csv,.gz,.parquet" });
  const drop = h("div", { class: "drop stack" }, h("p", {}, t("workbench.drop")), h("div", {}, h("label", { for: "file" }, t("workbench.file")), file));
  const upload = (given) => attempt(file, async () => go({ id: (await api.upload(given)).id }));
  file.addEventListener("change", () => { if (file.files.length) upload(file.files[0]); });
  for (const [name, over] of [["dragenter", true], ["dragover", true], ["dragleave", false], ["drop", false]]) {
    main.addEventListener(name, (event) => { event.preventDefault(); drop.classList.toggle("over", over); });
  }
  main.addEventListener("drop", (event) => { if (event.dataTransfer.files.length) upload(event.dataTransfer.files[0]); });

  const own = h("div", {});
  main.append(
    h("header", { class: "stack" }, h("h1", {}, t("workbench.title")), h("p", { class: "lead" }, t("workbench.lead"))),
    error,
    h("section", { class: "panel stack" }, h("h2", {}, t("workbench.examples")), examples),
    h("div", { class: "columns" },
      h("section", { class: "panel stack" }, h("h2", {}, t("workbench.recordings")), own),
      h("section", { class: "panel stack" }, h("h2", {}, t("workbench.from_file")), drop)));

  examples.append(...(await api.examples()).items.map((example) => {
    const button = h("button", {
      type: "button", class: "example",
      onclick: () => attempt(button, async () => {
        const { recording } = example.recording ? example : await api.makeExample(example.name);
        go({ id: recording, axis: example.axis });
      }),
    }, h("strong", {}, example.title), h("span", {}, example.story));
    return button;
  }));
  await list(own, {
    load: (q) => api.recordings({ ...q, limit: 10 }),
    label: t("workbench.recordings"),
    head: [t("workbench.recording"), t("workbench.made"), { n: t("run.length") }],
    row: (row) => [h("a", { href: links.workbench(row.id, null, carried) }, recordingName(row)), when(row.created_at),
      { n: row.duration_s ? duration(row.duration_s) : t("workbench.points", { count: row.samples }) }],
    empty: () => h("p", { class: "empty muted" }, t("workbench.no_recordings")),
  });
}
