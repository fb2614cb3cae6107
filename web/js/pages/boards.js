// Boards: every gyro that was ever on the bench; one board's runs and certificates.

import { api, links } from "../api.js";
import { facts, h, table } from "../dom.js";
import { empty, list, recordingName, toWorkbench } from "../list.js";
import { page } from "../shell.js";
import { duration, t, when } from "../text.js";

page("boards", async (main) => {
  const id = new URLSearchParams(location.search).get("id");
  await (id ? showBoard(main, id) : showBoards(main));
});

async function showBoards(main) {
  const place = h("section", { class: "panel stack" });
  main.append(h("div", { class: "row spread" }, h("h1", {}, t("page.boards")), h("a", { href: "/run.html" }, t("run.all"))), place);
  await list(place, {
    load: (q) => api.boards({ ...q, limit: 50 }),
    label: t("page.boards"),
    head: [t("boards.board"), t("boards.model"), { n: t("boards.runs") }, { n: t("boards.certificates") }, t("boards.last_run"), t("page.workbench"), t("boards.note")],
    row: (board) => [h("a", { href: links.board(board.id) }, board.id), board.gyro_model, { n: String(board.runs ?? "–") }, { n: String(board.certificates ?? "–") }, when(board.last_run_at), toWorkbench(board.last_recording, board.id), board.note],
    empty: empty("boards.empty", "/", "boards.first"),
  });
}

async function showBoard(main, id) {
  const [board, { items: recordings }] = await Promise.all([api.board(id), api.recordings({ board: id, limit: 50 })]);
  const { runs, certificates } = board;
  document.title = `${board.id} · Gyrobench`;
  main.append(
    h("h1", {}, board.id),
    facts([[t("boards.model"), board.gyro_model], [t("boards.note"), board.note], [t("boards.since"), when(board.created_at)]]),
    h("section", { class: "panel stack" }, h("h2", {}, t("boards.certificates")), certificates.length
      ? table([t("certificates.number"), t("certificates.verdict"), t("certificates.issued"), t("certificates.documents")], certificates.map(certificateCells), { label: t("boards.certificates"), cards: true })
      : h("p", { class: "muted" }, t("boards.no_certificate"))),
    h("section", { class: "panel stack" }, h("h2", {}, t("run.runs")), runs.length
      ? table([t("run.started"), t("run.status"), t("setup.profile"), t("run.certificate")], runs.map((run) => [
        h("a", { href: links.run(run.id) }, when(run.created_at)), t(`run.status_${run.status}`), t(`profile.${run.profile}`), run.certificate ?? ""]), { label: t("run.runs"), cards: true })
      : h("p", { class: "muted" }, t("boards.no_run"))),
    h("section", { class: "panel stack" }, h("h2", {}, t("workbench.recordings")), recordings.length
      ? table([t("workbench.made"), t("workbench.recording"), { n: t("run.length") }, t("page.workbench")], recordings.map((row) => [
        when(row.created_at), recordingName(row), { n: row.duration_s ? duration(row.duration_s) : t("workbench.points", { count: row.samples }) }, toWorkbench(row.id, recordingName(row))]), { label: t("workbench.recordings"), cards: true })
      : h("p", { class: "muted" }, t("boards.no_recording"))),
    h("p", { class: "row" }, h("a", { class: "button", href: links.compare(board.id, "") }, t("boards.compare"))),
  );
}

const certificateCells = (c) => [c.number, t(`verdict.${c.verdict}`), when(c.issued_at),
  h("span", { class: "row" }, ["pdf", "csv", "json"].map((kind) => h("a", { href: links.document(c.number, kind), download: "" }, kind.toUpperCase())))];
