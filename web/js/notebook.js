// The lab notebook beside a page: writes lines in their order, shows them, and gives the PDF.
//
// notebook() -> {write, panel, refresh, id}: the notebook `id`, else that of the address (?notebook=…), else this
// browser's own, begun with its first line. Lines stay: there is nothing here that changes or deletes one.

import { api, links } from "./api.js";
import { h, say } from "./dom.js";
import { clock, t } from "./text.js";

const OWN = "gyrobench.notebook";

export function notebook({ id: known = null, title = "", author = "" } = {}) {
  const given = known ?? new URLSearchParams(location.search).get("notebook");
  let id = given ?? localStorage.getItem(OWN);
  let queue = Promise.resolve();
  const lines = [];
  const shown = new Set();
  const tell = (problem = null) => { for (const show of shown) show(problem); };

  async function append(line) {
    for (let attempt = 0; ; attempt++) {
      try {
        if (!id) {
          ({ id } = await api.beginNotebook({ title, author }));
          localStorage.setItem(OWN, id);
        }
        lines.push(await api.writeNotebook(id, line));
        return tell();
      } catch (problem) {
        // This browser's own notebook may be another server's: then a new one is begun.
        if (given || attempt || problem.status !== 404) return tell(problem);
        id = null;
      }
    }
  }

  async function load() {
    if (!id) return;
    try {
      lines.splice(0, lines.length, ...(await api.notebook(id)).content);
      tell();
    } catch (problem) {
      if (given || problem.status !== 404) return tell(problem);
      localStorage.removeItem(OWN);
      id = null;
    }
  }

  return {
    get id() { return id; },
    /** Writes {step, …values} as the next line; a failure is said in the panel and stops nothing. */
    write(line) {
      queue = queue.then(() => append(line));
      return queue;
    },
    /** Reads again what stands in it: the server writes some lines itself. */
    refresh() { queue = queue.then(load); },
    /** Shows the lines in `place`, with a field for a note and the PDF. */
    panel(place) {
      const list = h("ol", { class: "lines", tabindex: "0", "aria-label": t("notebook.title") });
      const text = h("textarea", { id: "notebook-note", rows: "2", maxlength: "4000" });
      const error = h("p", { class: "error", role: "alert" });
      const pdf = h("a", { class: "button", download: "" }, t("notebook.export"));
      const fresh = given ? null : h("button", {
        type: "button",
        onclick: () => { localStorage.removeItem(OWN); id = null; lines.length = 0; tell(); },
      }, t("notebook.new"));
      const form = h("form", {
        class: "stack no-print",
        onsubmit: (event) => {
          event.preventDefault();
          if (!text.value.trim()) return;
          this.write({ step: "note", text: text.value.trim() });
          text.value = "";
        },
      }, h("div", {}, h("label", { for: "notebook-note" }, t("notebook.note")), text),
      h("div", { class: "row" }, h("button", { type: "submit" }, t("notebook.write")), pdf, fresh), error);
      place.replaceChildren(h("h2", {}, t("notebook.title")), list, form);
      const show = (problem) => {
        say(error, problem);
        list.replaceChildren(...(lines.length ? lines.map(line) : [h("li", { class: "muted" }, t("notebook.empty"))]));
        list.scrollTop = list.scrollHeight;
        pdf.hidden = !id;
        if (id) pdf.href = links.notebook(id);
        if (fresh) fresh.hidden = !lines.length;
      };
      shown.add(show);
      show(null);
      queue = queue.then(load);
    },
  };
}

const line = ({ at, step, sentence, own }) => h("li", {},
  h("p", { class: "small muted" }, `${clock(new Date(at))} · ${t(`notebook.step.${step}`)}`),
  sentence ? h("p", {}, sentence) : null,
  own ? h("p", { class: "own" }, own) : null);
