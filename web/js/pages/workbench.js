// The workbench: compare, see, learn, add, and watch the error fall.

import { api, links } from "../api.js";
import { h, say, waiting } from "../dom.js";
import { recordingName } from "../list.js";
import { notebook } from "../notebook.js";
import { page } from "../shell.js";
import { duration, t } from "../text.js";
import { showCard } from "../workbench/card.js";
import { experimentPanel, onRig } from "../workbench/experiment.js";
import { formulaForm } from "../workbench/formula.js";
import { guessForm } from "../workbench/guess.js";
import { keepPanel } from "../workbench/keep.js";
import { ledger } from "../workbench/ledger.js";
import { pictures } from "../workbench/pictures.js";
import { choose } from "../workbench/start.js";
import { showByHand, showSuspects } from "../workbench/suspects.js";

const GUESS_FIRST = "gyrobench.guess-first";
const asked = new URLSearchParams(location.search);
/** What goes on from recording to recording: the blind lab's code and its notebook. */
const carried = Object.fromEntries(["lab", "notebook"].filter((key) => asked.has(key)).map((key) => [key, asked.get(key)]));

page("workbench", async (main) => {
  const recording = asked.get("recording");
  if (!recording) return choose(main, carried);
  // Shown as soon as there is something to see; the fit comes into its own places.
  const [signal, row] = await Promise.all([api.signal(recording, { axis: asked.get("axis"), board: asked.get("board") }), api.recording(recording)]);
  return open(main, recording, row, signal);
});

async function open(main, recording, row, signal) {
  const { axis, unit } = signal;
  // Independent readings may be of several boards.
  const board = signal.points ? signal.board : null;
  const book = notebook();
  const cards = new Map();
  const own = new Map();
  const name = recordingName(row);
  const titles = (effect) => cards.get(effect)?.title ?? effect;
  const error = h("p", { class: "error", role: "alert" });
  const [seen, side, listed, cardPlace, nextPlace, keepPlace, bookPlace] = ["pictures stack", "side stack", "list stack", "panel stack about", "panel stack", "panel stack", "panel stack"]
    .map((name) => h("section", { class: name }));
  const isGuessing = h("input", { type: "checkbox", id: "guess-first", checked: localStorage.getItem(GUESS_FIRST) === "yes", onchange: () => { localStorage.setItem(GUESS_FIRST, isGuessing.checked ? "yes" : "no"); guess = null; refresh(); } });
  const progress = async () => {
    const { stage } = await api.progress(recording, axis);
    return stage && t(`workbench.stage.${stage}`);
  };
  const suspectsPlace = h("div", { class: "stack" }, waiting(t("workbench.looking"), progress));
  cardPlace.append(h("p", { class: "muted" }, t("workbench.card.choose")));
  const byHand = h("div", {});
  suspectsPlace.append(byHand);
  const verdict = h("p", { class: "verdict" });
  listed.classList.add("panel");
  listed.append(
    h("div", { class: "row spread" }, h("h2", {}, t("workbench.suspects")), h("label", { class: "row check", for: "guess-first" }, isGuessing, t("workbench.guess.first"))),
    verdict, suspectsPlace);

  main.append(
    h("header", { class: "row spread opened" },
      h("p", {}, h("strong", {}, name), ` · ${[board && t("workbench.board", { board }), t("workbench.axis", { axis }), extent(signal)].filter(Boolean).join(" · ")}`),
      h("div", { class: "row" }, signal.axes.length > 1 ? h("nav", { class: "row axes", "aria-label": t("workbench.axes") }, signal.axes.map((one) => [one].flat()).map((pair) => h("a", {
        class: "button", href: links.workbench(recording, pair.at(-1), { ...(pair[1] && { board: pair[0] }), ...carried }),
        "aria-current": pair.at(-1) === axis && (!pair[1] || pair[0] === board) ? "page" : null,
      }, pair.join(" ")))) : null,
        carried.lab ? h("a", { class: "button", href: links.lab(carried.lab) }, t("workbench.back_to_lab")) : h("a", { class: "button", href: "/workbench.html" }, t("workbench.another"))), error),
    seen, h("aside", { class: "beside", "aria-label": t("workbench.error") }, side), h("div", { class: "evidence-row" }, listed, h("div", { class: "stack" }, cardPlace, formulaForm(addOwn))), h("div", { class: "columns of-model" }, nextPlace, h("div", { class: "stack" }, keepPlace, bookPlace)));

  const history = [];
  let at = -1;
  let beside = null;
  let answer = null;
  let guess = null;
  let form = null;
  let busy = false;
  let judged = 0;
  const draw = pictures(seen, { unit, points: signal.points, detail: ([begin_s, end_s]) => fit(history[at].effects, { begin_s, end_s }), pointed: (along) => form?.point(along) });
  const bench = ledger(side, { undo: () => change(history[at].effects.slice(0, -1)), compare });
  draw.signal(signal);
  performance.mark("first-plot");

  const fit = (effects, part = {}) => api.fit(recording, { axis, ...(board && { board }), effects, formulas: effects.filter((name) => own.has(name)).map((name) => own.get(name)), ...part });

  /** Another model: from what was tried before, or fitted now. */
  async function change(effects) {
    if (busy) return;
    busy = true;
    say(error, null);
    const before = history[at];
    const began = performance.now();
    try {
      const known = history.findIndex((model) => model.effects.join() === effects.join());
      if (known < 0) history.push(await fit(effects));
      at = known < 0 ? history.length - 1 : known;
      beside = null;
      if (before && answer) draw.judge("", answer.untested);  // until the search has spoken of this model
      drawModel(performance.now() - began);
      if (before) {
        const more = effects.length > before.effects.length;
        const changed = more ? effects.filter((name) => !before.effects.includes(name)) : before.effects.filter((name) => !effects.includes(name));
        const { held_out: after, floor, unit: of } = history[at].error;
        book.write({ step: more ? "added" : "removed", effects: changed, before: before.error.held_out, after, floor, unit: of });
      }
      if (before) judge(effects);
      else refresh();
    } catch (problem) {
      if (before && problem.code?.startsWith("formula.")) throw problem;
      if (before) say(error, problem);
      else fail(problem.message);
    } finally { busy = false; }
  }

  /** Nothing can be said of this recording: one sentence says why, where the answer would stand; what needs a fit is gone. */
  function fail(why) {
    judged++;
    draw.fail(why);
    for (const place of [side.parentElement, main.querySelector(".evidence-row"), nextPlace, keepPlace]) place.hidden = true;
  }

  /** What the library says beside the model; a long search holds nothing up, and the last question counts. */
  async function judge(effects) {
    const mine = ++judged;
    refresh();
    try {
      const said = await api.suspects(recording, { axis, board, effects });
      if (mine !== judged) return;
      const isFirst = !answer;
      if (isFirst && !effects.length && !isGuessing.checked && said.verdict !== "not_testable") book.write({ step: "verdict", code: said.code, values: said.values });
      answer = said;
      refresh();
      // A search knows the noise better than the first fit did: what is shown is to say the same as the verdict.
      if (isFirst && at >= 0 && mine === judged && !signal.points) await again();
    } catch (problem) {
      if (mine !== judged) return;
      say(error, problem);
      if (!answer) suspectsPlace.replaceChildren(h("p", { class: "error" }, problem.message), byHand);
    }
  }

  /** The models tried so far, fitted anew. */
  async function again() {
    const models = await Promise.all(history.map(({ effects }) => fit(effects)));
    history.splice(0, models.length, ...models);
    drawModel();
  }

  function drawModel(ms) {
    draw.fit(history[at], beside == null ? null : history[beside]);
    bench.show(history, at, titles, ms);
    bench.others(history, at, titles, beside);
  }

  function compare(index) {
    beside = index;
    drawModel();
  }

  function refresh() {
    if (!cards.size || at < 0) return;
    if (!answer) {
      if (!isGuessing.checked) showByHand(byHand, cards, history[at], { open: show, toggle });
      return;
    }
    if (answer.verdict === "not_testable") { fail(answer.sentence); return; }
    draw.judge(answer.headline, answer.untested);
    next.label(answer);
    const hidden = isGuessing.checked && guess === null;
    draw.pointing(hidden);
    nextPlace.hidden = hidden || Boolean(signal.points);  // what it would tell apart tells what is suspected
    if (hidden) {
      cardPlace.replaceChildren(h("p", { class: "muted" }, t("workbench.guess.read")));
      verdict.textContent = t("workbench.guess.hidden");
      form = guessForm(suspectsPlace, cards, {
        pointed: (covariate) => draw.pointing(true, covariate),
        read: (effect) => show(effect, false),
        guessed(given) {
          guess = given.effect ?? "none";
          book.write({ step: "guessed", effects: given.effect ? [given.effect] : [], ...(given.covariate && { covariate: given.covariate }), ...(given.why && { why: given.why }) });
          book.write({ step: "verdict", code: answer.code, values: answer.values });
          refresh();
          show(given.effect ?? answer.suspects[0].effect);
        },
      });
      return;
    }
    form = null;
    verdict.textContent = answer.sentence;
    showSuspects(suspectsPlace, answer, { open: show, guess, decide: signal.points ? null : decide, toggle });
    if (cardPlace.querySelector("h2")) return;
    // Of many that noise explains none is to be put before a reader.
    if (answer.suspects[0].word === "nothing") cardPlace.replaceChildren(h("p", { class: "muted" }, t("workbench.card.choose")));
    else show(answer.suspects[0].effect, false);
  }

  function toggle(effect, isIn) {
    const now = history[at].effects;
    return change(isIn ? now.filter((name) => name !== effect) : [...now, effect]);
  }

  async function show(effect, isAsked = true) {
    if (!cards.has(effect)) return;
    const title = await showCard(cardPlace, effect, cards, { open: show });
    if (!isAsked) return;
    const found = answer?.suspects.find((s) => s.effect === effect);
    book.write({ step: "seen", effect, two_delta_lnL: found?.two_delta_lnL ?? null });
    title.focus({ preventScroll: false });
  }

  async function addOwn(given) {
    own.set(given.name, given);
    const effects = [...history[at].effects.filter((name) => name !== given.name), given.name];
    for (let k = history.length - 1; k >= 0; k--) if (k !== at && history[k].effects.includes(given.name)) history.splice(k, 1);
    await change(effects);
  }

  /** The model as it is now; formulas of the student's own are stored first, so that it can name them. */
  async function current() {
    const { effects } = history[at];
    for (const name of effects) if (own.has(name)) await api.keepEffect(own.get(name)).catch((problem) => { if (problem.status !== 409) throw problem; });
    return { recording, axis, effects };
  }

  let rigName = "";
  document.addEventListener("rig-changed", ({ detail }) => { rigName = detail.simulated ? t("rig.simulated") : detail.url; });
  const next = experimentPanel(nextPlace, {
    ask: () => ({ recording, axis, effects: history[at]?.effects ?? [] }),
    progress,
    rig: () => (carried.lab ? t("workbench.next.hidden_bench") : rigName),
    async run(experiment) {
      if (!carried.lab) return onRig(experiment);
      const { lab } = await import("../lab_student.js");
      return (await lab(carried.lab)).run(experiment.next_experiment.motion, { joins: recording });
    },
    done(joined, told) {
      if (!told) {
        const effects = history[at].effects.filter((name) => !own.has(name)).join();
        location.href = links.workbench(joined, axis, { ...carried, ...(effects && { effects }) });
        return;
      }
      const { motion, duration_s } = told.experiment.next_experiment;
      book.write({ step: "experiment", motion, duration_s, recording: joined });
      if (told.diagnosis) book.write({ step: "verdict", code: told.diagnosis.code, values: told.diagnosis.values });
    },
  });
  function decide() {
    nextPlace.scrollIntoView({ block: "nearest" });
    next.propose();
  }
  // Readings without a time have no motion to go on with, and no model that could correct a signal.
  nextPlace.hidden = keepPlace.hidden = Boolean(signal.points);
  keepPanel(keepPlace, { ask: current, isSession: ["run", "upload"].includes(row.source) });
  book.panel(bookPlace);

  // The page is there; numbers come into their places.
  (async () => {
    try {
      book.write({ step: "opened", recording, name, axis, samples: signal.samples, duration_s: signal.duration_s });
      const library = api.effects().then(({ items }) => { for (const card of items) cards.set(card.name, card); });
      judge([]);
      await Promise.all([library, change([])]);
      refresh();
      // From the recording before this one, to which a motion was joined.
      const kept = (asked.get("effects") ?? "").split(",").filter((name) => history[at]?.possible?.includes(name));
      if (kept.length) await change(kept);
    } catch (problem) { say(error, problem); }
  })();
}

/** How much there is of it: samples and seconds, or readings. */
function extent({ points, samples, duration_s }) {
  if (points) return t("workbench.points", { count: samples });
  return `${samples.toLocaleString("en").replaceAll(",", " ")} ${t("workbench.samples")} · ${duration(duration_s)}`;
}
