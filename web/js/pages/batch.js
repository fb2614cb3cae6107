// Batch: many boards certified together. Drop, watch, read the rows that failed, take the results.

import { api, links } from "../api.js";
import { fleetPanel } from "../batch_fleet.js";
import { rowsPanel } from "../batch_rows.js";
import { sendPanel } from "../batch_send.js";
import { h, say, table } from "../dom.js";
import { loadFigures } from "../figures.js";
import { page } from "../shell.js";
import { duration, sentence, t, when } from "../text.js";

const LOOK_MS = 1000;
const isOpen = ({ status }) => status === "queued" || status === "running";

page("batch", async (main) => {
  await loadFigures();
  const id = new URLSearchParams(location.search).get("id");
  const current = h("div", { class: "stack" });
  const earlier = h("section", { class: "panel stack", hidden: true });
  let follow = null;

  async function open(batch) {
    follow?.stop();
    history.replaceState(null, "", links.batch(batch.id));
    follow = watch(current, batch, listEarlier);
    await follow.begun;
  }

  main.append(h("h1", {}, t("page.batch")), sendPanel(async (batch) => { await open(batch); await listEarlier(); }), current, earlier);

  async function listEarlier() {
    const { items } = await api.batches({ limit: 50 });
    earlier.hidden = !items.length;
    earlier.replaceChildren(h("h2", {}, t("batch.earlier")), table(
      [t("batch.name"), t("batch.begun"), { n: t("batch.files") }, { n: t("batch.done") }, { n: t("batch.errors") }, t("batch.state")],
      items.map((batch) => [h("a", { href: links.batch(batch.id) }, nameOf(batch)), when(batch.created_at), { n: String(batch.files) }, { n: String(batch.done) }, { n: String(batch.failed) }, t(`batch.is_${batch.status}`)]),
      { label: t("batch.earlier"), cards: true }));
  }
  if (id) await open(await api.batch(id));
  await listEarlier();
});

/** Shows a batch and follows it until stop(); what has changed is asked for by the last change that was seen. */
function watch(place, first, ended) {
  const told = h("p", { class: "sentence", role: "status" });
  const notice = h("p", { class: "notice", hidden: true });
  const [good, bad] = [h("div", {}), h("div", { class: "bad" })];
  const error = h("p", { class: "error", role: "alert" });
  const rows = rowsPanel();
  const fleet = fleetPanel();
  const ask = (work) => async () => {
    say(error, null);
    try { await work(first.id); await look(); } catch (problem) { say(error, problem); }
  };
  const cancel = h("button", { type: "button", onclick: ask(api.cancelBatch) }, t("batch.cancel"));
  const retry = h("button", { type: "button", onclick: ask(api.retryBatch) }, t("batch.retry"));
  const results = ["zip", "csv"].map((kind) => h("a", { class: "button", href: links.batchResults(first.id, kind), download: "" }, t(`batch.results_${kind}`)));
  place.replaceChildren(
    h("section", { class: "panel stack" },
      h("div", { class: "row spread" }, h("h2", {}, t("batch.title", { name: nameOf(first), date: when(first.created_at) })), h("div", { class: "row" }, cancel, retry, ...results)),
      told, h("div", { class: "progress", "aria-hidden": "true" }, good, bad), notice, error),
    fleet.node, rows.node);
  let seen = 0;
  let timer = null;
  let isOver = false;

  async function look() {
    clearTimeout(timer);
    const batch = await api.batch(first.id);
    let changed = [];
    for (let next = seen; next != null;) {
      const answer = await api.batchFiles(first.id, { cursor: next, limit: 200 });
      changed = changed.concat(answer.items);
      next = answer.next;
    }
    if (isOver) return;
    seen = changed.at(-1)?.change ?? seen;
    show(batch);
    rows.total(batch);
    rows.take(changed);
    if (changed.some((file) => file.axes)) fleet.show(rows.files());
    if (isOpen(batch)) timer = setTimeout(again, LOOK_MS);
    else await ended();
  }
  const again = () => look().catch((problem) => { say(error, problem); timer = setTimeout(again, 5 * LOOK_MS); });

  function show(batch) {
    told.textContent = sentenceOf(batch);
    good.style.setProperty("--f", batch.done / batch.files);
    bad.style.setProperty("--f", batch.failed / batch.files);
    notice.hidden = !batch.message;
    notice.textContent = batch.message ? sentence(batch.message) : "";
    cancel.hidden = !isOpen(batch);
    retry.hidden = isOpen(batch) || batch.failed + batch.cancelled === 0;
    for (const link of results) link.hidden = batch.done + batch.failed === 0;
    document.title = `${isOpen(batch) ? `${batch.done + batch.failed}/${batch.files} · ` : ""}${nameOf(batch)} · Gyrobench`;
  }
  return { begun: look(), stop() { isOver = true; clearTimeout(timer); } };
}

const nameOf = ({ name, files }) => (files > 1 ? t("batch.and_more", { name, n: files - 1 }) : name);

/** One sentence: how far, what came of it, how long still. */
function sentenceOf(batch) {
  const { pass = 0, fail = 0, issued = 0 } = batch.verdicts;
  const parts = [t("batch.so_far", { n: batch.done + batch.failed, files: batch.files })];
  const came = [[pass, "batch.n_pass"], [fail, "batch.n_fail"], [issued, "batch.n_issued"], [batch.failed, "batch.n_error"], [batch.cancelled, "batch.n_cancelled"]];
  parts.push(...came.filter(([n]) => n).map(([n, key]) => t(key, { n })));
  if (batch.status === "queued") parts.push(t("batch.starting"));
  if (batch.status === "running" && batch.seconds_left != null) parts.push(t("batch.left", { time: duration(batch.seconds_left) }));
  return parts.join(" · ");
}
