// A student's bench: move it, look at what came, hand in; after the reveal, the truth beside the answer.

import { api, links } from "./api.js";
import { h, table } from "./dom.js";
import { answerForm } from "./lab_answer.js";
import { motionEditor } from "./lab_motion.js";
import { answerWords, runName, truthList, verdictList } from "./lab_results.js";
import { lab, remember } from "./lab_student.js";
import { notebook } from "./notebook.js";
import { duration, t, when } from "./text.js";
import { showCard } from "./workbench/card.js";

const LOOK_MS = 5000;

export async function hunt(main, exercise, student) {
  const { code, axis } = exercise;
  const { items: effects } = await api.effects();
  const names = Object.fromEntries(effects.map(({ name, title }) => [name, title]));
  const recordings = h("div", {});
  const handed = h("p", { class: "muted", "aria-live": "polite" });
  const form = h("div", {});
  const motions = h("div", { class: "stack" });
  const bench = lab(code);
  const book = h("section", { class: "panel stack" });
  const pages = notebook({ id: student.notebook });

  main.append(
    h("header", { class: "stack" },
      h("h1", {}, exercise.title || t("lab.bench", exercise)),
      h("p", { class: "lead" }, exercise.revealed_at ? t("lab.is_revealed") : t("lab.task", { axis })),
      h("p", { class: "row small muted" }, h("span", {}, t("lab.you_are", { name: student.name, code })),
        h("button", { type: "button", class: "quiet no-print", onclick: () => { remember(code, { student: null, name: null }); location.reload(); } }, t("lab.not_you")))),
    ...(exercise.truth ? [truthPanel(exercise, student, effects, names)] : []),
    h("div", { class: "hunt" },
      h("div", { class: "stack" },
        h("section", { class: "panel stack" }, h("h2", {}, t("lab.step_move")), motions),
        h("section", { class: "panel stack" }, h("h2", {}, t("lab.step_look")), recordings)),
      h("div", { class: "stack" },
        exercise.revealed_at ? null : h("section", { class: "panel stack" }, h("h2", {}, t("lab.step_answer")), handed, form),
        book)));

  const editor = motionEditor(motions, {
    exercise, student: student.student,
    async onRun(motion, restart, joins) {
      const made = await bench.run(motion, { restart, joins });
      pages.write({ step: "experiment", motion, duration_s: made.run_s, recording: made.recording });
      student = await api.student(code, student.student);
      show();
      recordings.querySelector("a")?.focus();
    },
  });

  function show() {
    const { runs, answer, session } = student;
    editor.runs(runs, session);
    recordings.replaceChildren(runs.length
      ? table([t("lab.recording"), t("lab.done"), { n: t("lab.length") }, t("lab.data")], [...runs].reverse().map((run) => [
        runName(run), run.numbers.length > 1 ? t("lab.done_after", { numbers: run.numbers.slice(0, -1), motion: run.sentence }) : run.sentence, { n: duration(run.duration_s) },
        h("span", { class: "row" }, h("a", { class: "button open", href: links.workbench(run.recording, axis, { lab: code, notebook: student.notebook }) }, t("lab.open")),
          h("a", { href: links.recording(run.recording), download: "" }, "CSV"))]), { label: t("lab.step_look"), cards: true })
      : h("p", { class: "muted" }, t("lab.no_recording")));
    handed.textContent = answer ? t("lab.handed_in", { time: when(student.submitted_at), answer: answerWords(answer, names), confidence: answer.confidence }) : t("lab.answer_about");
    if (!exercise.revealed_at) {
      form.replaceChildren(answerForm({
        code, effects, answer, runs,
        async onSubmit(given) {
          try {
            student = await api.labAnswer(code, student.student, given);
          } catch (problem) {
            if (problem.code === "lab.revealed") location.reload();
            throw problem;
          }
          show();
          pages.refresh();
          handed.scrollIntoView({ block: "nearest" });
        },
      }));
    }
  }
  show();
  pages.panel(book);
  // The teacher reveals when the class is ready: every page turns over by itself.
  if (!exercise.revealed_at) {
    const timer = setInterval(async () => {
      if (document.hidden) return;
      const now = await api.exercise(code).catch(() => null);
      if (now?.revealed_at) { clearInterval(timer); location.reload(); }
    }, LOOK_MS);
  }
}

/** The truth, the answer with its marks, what the instrument makes of the same data, and the cards of what was hidden. */
function truthPanel(exercise, student, effects, names) {
  const { answer, grade, diagnosis } = student;
  const hidden = exercise.truth.effects.map(({ effect }) => effect);
  return h("section", { class: "panel stack" },
    h("div", { class: "columns" },
      h("div", { class: "stack" }, h("h2", {}, t("lab.truth")), truthList(exercise.truth, names, effects)),
      h("div", { class: "stack" }, h("h2", {}, t("lab.your_answer")),
        answer ? verdictList(grade, answer, names) : h("p", {}, t("lab.no_answer")),
        diagnosis ? h("div", { class: "stack" }, h("h3", {}, t("lab.instrument")), h("p", {}, diagnosis.sentence)) : null)),
    ...hidden.map((name) => card(name, new Map(effects.map((effect) => [effect.name, effect])))));
}

/** An effect's card; the names in it open theirs in its place. */
function card(name, cards) {
  const place = h("article", { class: "about stack" });
  const open = async (other) => (await showCard(place, other, cards, { open })).focus();
  showCard(place, name, cards, { open });
  return place;
}
