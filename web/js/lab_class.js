// A teacher's class: the code to write on the board, who handed in what, the reveal, the table.

import { api, links } from "./api.js";
import { h, say, table } from "./dom.js";
import { answerWords, truthList, verdictList } from "./lab_results.js";
import { remember } from "./lab_student.js";
import { duration, t, when } from "./text.js";

const EVERY_MS = 5000;

/** Nobody else reaches a server by these names. */
const LOOPBACK = /^(localhost|127\.|\[?::1)/;

export async function classroom(main, exercise, key) {
  const { code } = exercise;
  const { items: effects } = await api.effects();
  const words = Object.fromEntries(effects.map(({ name, title }) => [name, title]));
  const list = h("div", {});
  const error = h("p", { class: "error", role: "alert" });
  const truth = h("div", { class: "stack" });
  const summary = h("summary", {}, t("lab.truth_show"));
  // The class may be watching: marks, too, are shown only beside the truth.
  const hidden = h("details", { class: "panel", ontoggle: () => draw() }, summary, truth);
  const link = new URL(links.lab(code, key), location.href).href;
  const state = h("p", { class: "lead", "aria-live": "polite" });
  let shown = "";
  let items = [];

  async function attempt(work) {
    say(error, null);
    try { await work(); } catch (problem) { say(error, problem); }
  }
  /** What cannot be taken back asks once more, in the button itself. */
  const twice = (text, again, work) => {
    const button = h("button", {
      type: "button",
      onclick: async () => {
        if (button.dataset.sure) {
          button.disabled = true;
          button.textContent = t("lab.working");
          await attempt(work);
          delete button.dataset.sure;
          button.disabled = false;
          button.textContent = text;
          return;
        }
        button.dataset.sure = "yes";
        button.textContent = again;
      },
      onblur: () => { delete button.dataset.sure; button.textContent = text; },
    }, text);
    return button;
  };
  const reveal = twice(t("lab.reveal"), t("lab.reveal_sure"), async () => {
    exercise = await api.reveal(code, key);
    shown = "";
    await look();
  });

  main.append(
    h("header", { class: "stack" }, h("h1", {}, exercise.title || t("lab.bench", exercise)), state),
    h("section", { class: "panel board-code" }, h("div", {}, h("p", {}, t("lab.tell_students", { address: `${location.host}/lab.html` })),
      LOOPBACK.test(location.hostname) ? h("p", { class: "small muted" }, t("lab.this_computer")) : null), h("p", { class: "code" }, code)),
    h("section", { class: "panel stack" }, h("h2", {}, t("lab.results")), list, error,
      h("div", { class: "row" }, reveal,
        h("button", { type: "button", onclick: () => attempt(async () => save(await api.labTable(code, key), `lab-${code}.csv`)) }, t("lab.csv")),
        h("button", { type: "button", onclick: () => print() }, t("lab.print")))),
    hidden,
    h("details", { class: "panel no-print" }, h("summary", {}, t("lab.key")), h("div", { class: "stack" },
      h("p", {}, t("lab.key_about")), h("p", { class: "small" }, h("a", { href: link }, link)),
      h("div", { class: "row" }, twice(t("lab.delete"), t("lab.delete_sure"), async () => {
        await api.deleteExercise(code, key);
        remember(code, { key: null, student: null });
        location.href = "/lab.html";
      })))));

  async function look() {
    const found = [];
    let page = null;
    do {
      page = await api.labResults(code, key, { limit: 200, cursor: page?.next });
      found.push(...page.items);
    } while (page.next);
    // Nothing new: the table stays as it is, with what is open in it and the reader's place.
    const now = JSON.stringify([found, exercise.revealed_at]);
    if (now === shown) return;
    shown = now;
    items = found;
    const board = page.truth;
    truth.replaceChildren(h("h2", { class: "for-print" }, t("lab.truth")), truthList(board, words, effects), h("p", { class: "small muted" }, t("lab.truth_board", { bias: board.bias_V, scale: 1000 * board.scale_factor_V_per_dps, seed: String(board.seed) })));
    if (exercise.revealed_at) {
      summary.textContent = t("lab.truth");
      hidden.open = true;
    }
    reveal.hidden = Boolean(exercise.revealed_at);
    const answered = items.filter(({ answer }) => answer).length;
    state.textContent = t(exercise.revealed_at ? "lab.class_revealed" : "lab.class_open", { students: items.length, answered });
    draw();
  }

  function draw() {
    const head = [t("lab.student"), t("lab.answer"), { n: t("lab.confidence_short") }, t("lab.reasoning_short"), t("lab.measured")];
    if (hidden.open) head.push(t("lab.marks"), t("lab.instrument_short"));
    list.replaceChildren(items.length
      ? table(head, [...items].reverse().map((one) => row(one, words).slice(0, head.length)), { label: t("lab.results"), cards: true })
      : h("p", { class: "muted" }, t("lab.no_student")));
  }
  await look();
  const again = () => { if (!document.hidden) attempt(look); };
  document.addEventListener("visibilitychange", again);
  setInterval(again, EVERY_MS);
}

function row({ name, answer, grade, runs, measured_s, diagnosis, submitted_at, notebook }, words) {
  const book = h("a", { href: links.notebook(notebook), class: "small" }, t("lab.notebook"));
  const measured = runs ? t("lab.measured_of", { runs, time: duration(measured_s) }) : "–";
  if (!answer) return [h("span", {}, name, " ", book), h("span", { class: "muted" }, t("lab.not_yet")), { n: "" }, "", measured, "", ""];
  return [
    h("span", {}, name, " ", book),
    h("div", {}, answerWords(answer, words), h("p", { class: "small muted" }, when(submitted_at))),
    { n: `${answer.confidence} %` }, h("p", { class: "small reasons" }, answer.reasoning), measured,
    verdictList(grade, answer, words), h("p", { class: "small" }, diagnosis?.sentence ?? "–"),
  ];
}

function save(blob, name) {
  const url = URL.createObjectURL(blob);
  h("a", { href: url, download: name }).click();
  URL.revokeObjectURL(url);
}
