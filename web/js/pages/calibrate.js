// Calibrate: prepare, start, watch, leave with the certificate.

import { api, links } from "../api.js";
import { $, facts, h, say } from "../dom.js";
import { loadFigures } from "../figures.js";
import { watch } from "../live.js";
import { livePlots } from "../plots.js";
import { estimateSummary, limitsCard, resultCard } from "../results.js";
import { Setup } from "../setup.js";
import { notice, page, speedWord } from "../shell.js";
import { STATES, showStates, split, stateName } from "../states.js";
import { duration, plain, sentence, t } from "../text.js";

const FRAME_MS = 45;   // the screen's next picture after this: 20 a second, no more
const PLAN_AFTER_MS = 300;

let setup;
let watched = null;    // id of the run on the page
let isStarting = false;

page("calibrate", async () => {
  let seen;
  const first = new Promise((resolve) => { seen = resolve; });   // the rig's first answer, and the run that is on
  setup = new Setup($("#setup"), { onStart: start, onChange: planSoon });
  document.addEventListener("rig-changed", ({ detail }) => {
    // A run that another browser or the command line started belongs on this page too.
    speed = detail.speed;
    showLength();
    seen(detail.run && detail.run !== watched && !isStarting ? follow(detail.run) : null);
  });
  $("#stop-run").addEventListener("click", async () => {
    say($("#about-error"), null);
    try { await api.stopRun(watched); } catch (problem) { say($("#about-error"), problem); }
  });
  showIdle();
  await Promise.all([setup.load(), loadFigures()]);
  const asked = new URLSearchParams(location.search).get("run");
  if (asked) await follow(asked);
  else plan();
  await first;
});

// --- before the run ---------------------------------------------------------------------------------------------

function showIdle() {
  $("#headline").textContent = t("calibrate.ready");
  $("#next").textContent = t("calibrate.ready_next");
  showStates($("#states"), STATES.map((name) => ({ name, status: "waiting" })));
}

let seconds = null;    // bench time of the plan
let speed = 1;

function showLength() {
  if (watched || seconds === null) return;
  $("#left").textContent = speed > 1
    ? t("calibrate.bench_time_at", { duration: duration(seconds), wall: duration(seconds / speed), speed: speedWord(speed) })
    : t("calibrate.bench_time", { duration: duration(seconds) });
}

let planTimer;
function planSoon() {
  setup.refuse(null);
  clearTimeout(planTimer);
  planTimer = setTimeout(plan, PLAN_AFTER_MS);
}

/** Asks what would happen, so that a refusal is read before Start is pressed. */
async function plan() {
  if (watched) return;
  try {
    const body = await setup.body();
    const planned = await api.plan({ ...body, board: body.board || "board" });
    if (watched) return;
    showStates($("#states"), planned.states.map((state) => ({ ...state, status: "waiting" })));
    seconds = planned.seconds;
    showLength();
    setup.refuse(null);
  } catch (problem) {
    setup.refuse(problem);
  }
}

async function start() {
  clearTimeout(planTimer);
  setup.refuse(null);
  notice("stop", null);
  isStarting = true;
  $("#start").disabled = true;
  try {
    const run = await api.start(await setup.body());
    await follow(run.id);
    $(".headline").scrollIntoView({ block: "nearest" });
  } catch (problem) {
    setup.refuse(problem, { focus: true });
  } finally {
    isStarting = false;
    $("#start").disabled = false;
  }
}

// --- the run ----------------------------------------------------------------------------------------------------

let leave = () => {};

async function follow(id) {
  if (watched === id) return;
  leave();
  watched = id;
  let run;
  try {
    run = await api.run(id);
  } catch (problem) {
    watched = null;
    notice("live", problem.message, "fail");
    return;
  }
  const models = setup.models.length ? setup.models : (await api.gyroModels()).items;
  $("#setup").hidden = true;
  $("#mounting").hidden = $("#elsewhere").hidden = true;
  $("#about").hidden = false;
  $("#live").hidden = false;
  $("#stop-run").hidden = false;
  $(".work").classList.remove("ended");
  $("#documents").replaceChildren();
  $("#results").replaceChildren();
  $("#about-facts").replaceChildren(facts([
    [t("setup.board"), h("a", { href: links.board(run.board) }, run.board)], [t("setup.model"), models.find((m) => m.id === run.gyro_model)?.name ?? run.gyro_model],
    [t("setup.profile"), t(`profile.${run.profile}`)], [t("setup.operator"), run.operator],
    [t("setup.temperature"), run.conditions?.room_temperature_degC == null ? null : plain(run.conditions.room_temperature_degC)], [t("setup.note"), run.note],
    [t("setup.readings"), run.readings], [t("rig.rig"), run.rig], [t("run.seed"), run.seed == null ? null : String(run.seed)],
  ]));
  const plots = livePlots($("#charts"), models.find((model) => model.id === run.gyro_model));
  let latest = null;
  let asked = null;
  let drawn = 0;

  function draw(now) {
    if (now - drawn < FRAME_MS) { asked = requestAnimationFrame(draw); return; }
    asked = null;
    drawn = now;
    plots.show(latest);
    showProgress(latest);
  }

  function showResults(fresh, all) {
    for (const [state, result] of Object.entries(fresh)) {
      const card = resultCard(state, result);
      const old = $(`#result-${state}`);
      if (old) old.replaceWith(card); else $("#results").append(card);
    }
    const estimates = Object.entries(all).filter(([state]) => split(state)[0] === "estimate");
    $("#summary").replaceChildren(facts(estimates.flatMap(([state, result]) => estimateSummary(split(state)[1], result))));
  }

  const unwatch = watch(id, {
    onFrame(soFar, frame) {
      latest = soFar;
      asked ??= requestAnimationFrame(draw);
      if (Object.keys(frame.results).length) showResults(frame.results, soFar.results);
      if (soFar.ended) end(id, Object.keys(soFar.columns).length > 0);
    },
    onConnection: (text) => notice("live", text, "fail"),
  });
  leave = () => { unwatch(); plots.destroy(); cancelAnimationFrame(asked); };
}

function showProgress(soFar) {
  if (soFar.ended) return;
  const progress = soFar.progress ?? {};
  showStates($("#states"), soFar.states.map((state) => ({ ...state, fraction: progress.state_fraction })));
  $("#headline").textContent = soFar.state ? `${STATES.indexOf(soFar.state) + 1} ${stateName(soFar.state)}` : t("calibrate.starting");
  $("#left").textContent = [
    progress.of ? t("calibrate.done_of", { done: progress.done, of: progress.of }) : null,
    progress.seconds_left == null ? null : t("calibrate.left", { duration: duration(progress.seconds_left) }),
  ].filter(Boolean).join(" · ");
  $("#next").textContent = soFar.state ? t(`calibrate.what_${soFar.state.split("_")[0]}`) : "";
}

/** The run is over, in whatever way: the sentence, the documents, the next step. */
async function end(id, hasPictures) {
  const run = await api.run(id);
  if (watched !== id) return;
  document.dispatchEvent(new Event("rig-asked"));
  $("#live").hidden = !hasPictures;
  $("#stop-run").hidden = true;
  $(".work").classList.add("ended");
  $("#left").textContent = run.duration_s == null ? "" : t("calibrate.took", { duration: duration(run.duration_s) });
  showStates($("#states"), run.states);
  const number = run.certificate;
  const certificate = number ? await api.certificate(number).catch(() => null) : null;
  $("#results").prepend(...[limitsCard(certificate)].filter(Boolean));
  $("#headline").textContent = number ? t(`calibrate.certificate_${certificate?.verdict ?? "issued"}`, { board: run.board, number }) : t(`calibrate.${run.status}`, { board: run.board });
  $("#next").textContent = run.message ? sentence(run.message) : t(number ? "calibrate.certificate_next" : "calibrate.ended_next");
  const documents = number ? ["pdf", "csv", "json"].map((kind, i) => h("a", { class: `button ${i ? "" : "main"}`, href: links.document(number, kind), download: "" }, t(`document.${kind}`))) : [];
  $("#documents").replaceChildren(
    ...documents,
    h("a", { class: "button", href: links.run(id) }, t("calibrate.open_run")),
    run.recording && hasPictures ? h("a", { class: "button", href: links.workbench(run.recording, null) }, t("run.workbench")) : "",
    h("button", { type: "button", id: "again", onclick: again }, t("calibrate.again")),
  );
}

function again() {
  leave();
  leave = () => {};
  watched = null;
  history.replaceState(null, "", "/");
  for (const [name, hidden] of [["#setup", false], ["#mounting", false], ["#elsewhere", false], ["#about", true], ["#live", true]]) $(name).hidden = hidden;
  for (const name of ["#documents", "#results", "#summary"]) $(name).replaceChildren();
  $("#left").textContent = "";
  showIdle();
  plan();
  $("#board").focus();
}
