// One run: its results, the comparison pictures, its points, its recording; certify it, or do one state again.

import { api, links } from "../api.js";
import { chart } from "../chart.js";
import { loadFigures } from "../figures.js";
import { facts, h, say, table } from "../dom.js";
import { testCharts } from "../plots.js";
import { budgetTable, limitsCard, linearityTable, repeatTable, resultCard } from "../results.js";
import { page } from "../shell.js";
import { showStates, split, stateName } from "../states.js";
import { duration, fixed, sentence, t, when } from "../text.js";

page("run", async (main) => {
  const id = new URLSearchParams(location.search).get("id");
  if (!id) return showRuns(main);
  const [run] = await Promise.all([api.run(id), loadFigures()]);
  return showRun(main, run, run.certificate ? await api.certificate(run.certificate) : null);
});

async function showRuns(main) {
  const { empty, list, toWorkbench } = await import("../list.js");
  const place = h("section", { class: "panel stack" });
  main.append(h("h1", {}, t("run.runs")), place);
  await list(place, {
    load: (q) => api.runs({ ...q, limit: 50 }),
    label: t("run.runs"),
    head: [t("run.started"), t("setup.board"), t("run.status"), t("setup.profile"), t("page.workbench")],
    row: (run) => [h("a", { href: links.run(run.id) }, when(run.created_at)), run.board, t(`run.status_${run.status}`), t(`profile.${run.profile}`), toWorkbench(run.recording, run.board)],
    empty: empty("boards.empty", "/", "boards.first"),
  });
}

function showRun(main, run, certificate) {
  document.title = `${run.board} · Gyrobench`;
  const error = h("p", { class: "error", role: "alert" });
  const states = h("ol", { class: "states" });
  const isOn = run.status === "queued" || run.status === "running";

  async function attempt(work) {
    say(error, null);
    try { await work(); } catch (problem) { say(error, problem); }
  }
  const repeat = (state) => h("button", {
    type: "button", class: "no-print", disabled: isOn, "aria-label": t("run.repeat_state", { state: stateName(state) }),
    onclick: () => attempt(async () => {
      const { id } = await api.start({ board: run.board, gyro_model: run.gyro_model, profile: run.profile, states: [state], continues: run.id, ...(run.operator && { operator: run.operator }) });
      location.href = `/?run=${encodeURIComponent(id)}`;
    }),
  }, t("run.repeat"));
  const certify = h("button", {
    type: "button", disabled: isOn,
    onclick: () => attempt(async () => { await api.certify({ recording: run.recording }); location.reload(); }),
  }, t("run.certify"));

  main.append(
    h("header", { class: "stack" },
      h("h1", {}, t("run.title", { board: run.board, date: when(run.created_at) })),
      h("p", {}, run.message ? sentence(run.message) : t(`run.sentence_${run.status}`)),
      facts([[t("run.status"), t(`run.status_${run.status}`)], [t("setup.model"), run.gyro_model], [t("setup.profile"), t(`profile.${run.profile}`)],
        [t("setup.operator"), run.operator], [t("setup.note"), run.note], [t("setup.temperature"), run.conditions?.room_temperature_degC == null ? null : fixed(run.conditions.room_temperature_degC, 1)],
        [t("rig.rig"), run.rig], [t("setup.readings"), run.readings], [t("run.seed"), run.seed == null ? null : String(run.seed)],
        [t("run.length"), run.duration_s == null ? null : duration(run.duration_s)],
        [t("run.certificate"), run.certificate]], true),
      h("div", { class: "row" },
        isOn ? h("a", { class: "button main", href: `/?run=${encodeURIComponent(run.id)}` }, t("run.watch")) : null,
        ...(run.certificate ? ["pdf", "csv", "json"].map((kind, i) => h("a", { class: `button ${i ? "" : "main"}`, href: links.document(run.certificate, kind), download: "" }, t(`document.${kind}`))) : []),
        isOn ? null : h("a", { class: "button", href: links.workbench(run.recording, "x") }, t("run.workbench")),
        h("a", { class: "button", href: links.recording(run.recording), download: "" }, t("run.raw")),
        h("a", { class: "button", href: links.recording(run.recording, "fast.csv"), download: "" }, t("run.raw_fast")),
        run.certificate ? null : certify),
      error),
    states,
    ...[limitsCard(certificate)].filter(Boolean),
  );
  showStates(states, run.states);

  const results = Object.fromEntries(run.states.map(({ name, result }) => [name, result ?? run.results?.[name]]).filter(([, result]) => result));
  for (const [name, result] of Object.entries(results)) {
    const [kind, axis] = split(name);
    const card = resultCard(name, result, { actions: [repeat(name)] });
    main.append(card);
    if (kind === "estimate") {
      if (result.budget) card.append(h("details", {}, h("summary", {}, t("result.budget")), budgetTable(result.budget)));
      if (result.still) still(card, result.still);
      comparison(card, run, axis);
    }
    else test(card, kind, result);
  }
  const missing = run.states.filter(({ name }) => !results[name]);
  if (missing.length && !isOn) {
    main.append(h("section", { class: "panel stack" }, h("p", {}, t("run.missing")), h("div", { class: "row" }, missing.map(({ name }) => h("span", { class: "row" }, stateName(name), repeat(name))))));
  }
}

/** The gyro at rest: Allan deviation of the hold before the motion, in a drawer that is drawn when it is opened. */
function still(card, { tau_s: tau, deviation_dps: deviation }) {
  const place = h("div", {});
  const drawer = h("details", {}, h("summary", {}, t("run.allan")), h("p", { class: "small muted" }, t("run.allan_says")), place);
  drawer.addEventListener("toggle", () => {
    if (!drawer.open || place.firstChild) return;
    chart(place, {
      name: t("run.allan"), height: 220,
      x: { label: t("run.averaging"), unit: "s", log: true }, y: { label: t("run.deviation"), unit: "deg/s", log: true },
      series: [{ role: "measured", draw: "line" }],
    }).set([tau, deviation]);
  });
  card.append(drawer);
}

/** Thesis 4.17, 4.18, 5.7 to 5.9: rate and integrated angle against the encoder, with the datasheet's parameters and the estimated ones. */
async function comparison(card, run, axis) {
  const place = h("div", { class: "stack" }, h("h3", {}, t("run.comparison", { axis })));
  const waiting = h("p", { class: "muted small" }, t("run.comparing"));
  place.append(waiting);
  card.append(place);
  let data;
  try { data = await api.comparison(run.id, axis); } catch (problem) { waiting.textContent = problem.message; return; }
  waiting.remove();
  const charts = h("div", { class: "charts" });
  place.append(
    table([t("run.parameters"), { n: t("run.rate_rms") }, { n: t("run.angle_rms") }], ["datasheet", "estimated"].map((key) => [
      t(`run.with_${key}`), { n: fixed(data[key].rate_rms_dps, 3) }, { n: fixed(data[key].angle_rms_deg, 3) }]), { compact: true, cards: true, label: t("run.comparison", { axis }) }),
    charts);
  for (const [quantity, unit, key] of [["rate", "deg/s", "rate_dps"], ["angle", "deg", "angle_deg"]]) {
    chart(charts, {
      name: t(`run.compare_${quantity}`), group: `compare-${axis}`, height: 220, wide: true,
      x: { label: t("chart.time"), unit: "s" }, y: { label: t(`chart.${quantity}`), unit, zero: true },
      series: [
        { name: t("chart.encoder"), role: "measured", draw: "line" },
        { name: t("chart.datasheet"), role: "model", draw: "dots" },
        { name: t("chart.estimated"), role: "model", draw: "dash" },
      ],
    }).set([data.time_s, data.encoder[key], data.datasheet[key], data.estimated[key]]);
  }
}

function test(card, kind, result) {
  if (!result.points) return;
  const charts = h("div", { class: "charts" });
  card.append(charts,
    h("details", {}, h("summary", {}, t("table.linearity")), linearityTable(result.points.linearity, kind)),
    h("details", {}, h("summary", {}, t("table.repeat")), repeatTable(result.points.repeat, kind)));
  testCharts(charts, kind).show(result.points, "linearity");
}
