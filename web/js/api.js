// The one module that knows addresses.

import { decode } from "./columns.js";
import { language, t } from "./text.js";

const ROOT = "/api/v1";
const TOKEN = "gyrobench.token";
const LEASE = "gyrobench.lease";

// `serve` on an open address prints http://…/#token=…; keep it, and keep it out of the address bar.
function takeToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (!given) return false;
  localStorage.setItem(TOKEN, given);
  history.replaceState(null, "", location.pathname + location.search);
  return true;
}
takeToken();
addEventListener("hashchange", () => { if (takeToken()) location.reload(); });

/** A refusal or a failure, with the server's sentence in the reader's language as its message. */
export class Refused extends Error {
  constructor(problem, status) {
    super(problem.detail ?? problem.title ?? t("page.failed", { status }));
    this.status = status;
    this.code = problem.code;
    this.values = problem.values ?? {};
  }
}

async function call(method, path, body, { as = "json", ...more } = {}) {
  const headers = { "Accept-Language": language, ...more };
  const token = localStorage.getItem(TOKEN);
  const lease = sessionStorage.getItem(LEASE);
  if (token) headers.Authorization = `Bearer ${token}`;
  if (lease) headers["X-Rig-Lease"] = lease;
  const isForm = body instanceof FormData;
  if (body !== undefined && !isForm) headers["Content-Type"] = "application/json";
  let answer;
  try {
    answer = await fetch(ROOT + path, { method, headers, body: isForm || body === undefined ? body : JSON.stringify(body) });
  } catch {
    throw new Refused({ detail: t("page.unreachable") }, 0);
  }
  if (answer.status === 204) return null;
  if (answer.ok && as === "blob") return answer.blob();
  if (answer.ok && answer.headers.get("Content-Type") === "application/octet-stream") return decode(await answer.arrayBuffer());
  const content = await answer.json().catch(() => ({}));
  if (answer.ok) return content;
  const refused = new Refused(content, answer.status);
  if (answer.status === 401) document.dispatchEvent(new CustomEvent("token-needed", { detail: refused }));
  throw refused;
}

const query = (values) => {
  const kept = Object.entries(values).filter(([, value]) => value != null && value !== "");
  return kept.length ? `?${new URLSearchParams(kept)}` : "";
};
const id = encodeURIComponent;

export const api = {
  health: () => call("GET", "/health"),
  rig: () => call("GET", "/rig"),
  chooseRig: (body) => call("PUT", "/rig", body),
  checkRig: () => call("POST", "/rig/check"),
  startCheck: (gyro_model) => call("POST", "/rig/start-check", { gyro_model }),
  reference: () => call("GET", "/rig/reference"),
  setReference: (record) => call("PUT", "/rig/reference", record),
  dropReference: () => call("DELETE", "/rig/reference"),
  emergencyStop: () => call("POST", "/rig/stop"),
  async holdRig(holder) {
    const lease = await call("POST", "/rig/lease", { holder });
    sessionStorage.setItem(LEASE, lease.token);
    return lease;
  },
  async releaseRig() {
    await call("DELETE", "/rig/lease");
    sessionStorage.removeItem(LEASE);
  },
  /** A lease is short: renews it in its last minute, and forgets it where it is over or another's. */
  async keepRig(lease) {
    if (!api.holdsRig()) return;
    if (lease && Date.parse(lease.expires_at) - Date.now() > 60_000) return;
    try {
      if (!lease) throw new Error("over");
      await api.holdRig(lease.holder);
    } catch {
      sessionStorage.removeItem(LEASE);
    }
  },
  holdsRig: () => sessionStorage.getItem(LEASE) !== null,

  gyroModels: () => call("GET", `/gyro-models${query({ limit: 200 })}`),
  createGyroModel: (model) => call("POST", "/gyro-models", model),
  changeGyroModel: ({ id: model, preset: _, ...facts }) => call("PUT", `/gyro-models/${id(model)}`, facts),
  removeGyroModel: (model) => call("DELETE", `/gyro-models/${id(model)}`),

  boards: (q) => call("GET", `/boards${query(q)}`),
  board: (board) => call("GET", `/boards/${id(board)}`),

  fields: () => call("GET", "/fields"),

  plan: (body) => call("POST", "/runs/plan", body),
  start: (body) => call("POST", "/runs", body),
  runs: (q) => call("GET", `/runs${query(q)}`),
  run: (run) => call("GET", `/runs/${id(run)}`),
  stopRun: (run) => call("POST", `/runs/${id(run)}/stop`),
  comparison: (run, axis) => call("GET", `/runs/${id(run)}/comparison${query({ axis })}`),

  certificates: (q) => call("GET", `/certificates${query(q)}`),
  certificate: (number) => call("GET", `/certificates/${id(number)}`),
  certify: (body) => call("POST", "/certificates", body),
  upload(file) {
    const form = new FormData();
    form.append("file", file);
    return call("POST", "/recordings", form);
  },
  batches: (q) => call("GET", `/batches${query(q)}`),
  batch: (batch) => call("GET", `/batches/${id(batch)}`),
  batchFiles: (batch, q) => call("GET", `/batches/${id(batch)}/files${query(q)}`),
  retryBatch: (batch) => call("POST", `/batches/${id(batch)}/retry`),
  cancelBatch: (batch) => call("POST", `/batches/${id(batch)}/cancel`),
  /** Sends a form with many files; `told(part)` hears how much has gone. A key makes sending it again harmless. */
  sendBatch: (form, key, told) => new Promise((resolve, reject) => {
    // fetch does not tell how far an upload is.
    const request = new XMLHttpRequest();
    request.open("POST", `${ROOT}/batches`);
    const token = localStorage.getItem(TOKEN);
    const headers = { "Accept-Language": language, "Idempotency-Key": key, ...(token && { Authorization: `Bearer ${token}` }) };
    for (const [name, value] of Object.entries(headers)) request.setRequestHeader(name, value);
    request.responseType = "json";
    request.upload.onprogress = ({ loaded, total }) => told(loaded / total);
    request.onerror = () => reject(new Refused({ detail: t("page.unreachable") }, 0));
    request.onload = () => {
      if (request.status < 300) return resolve(request.response);
      const refused = new Refused(request.response ?? {}, request.status);
      if (request.status === 401) document.dispatchEvent(new CustomEvent("token-needed", { detail: refused }));
      return reject(refused);
    };
    request.send(form);
  }),
  verify: (number) => call("GET", `/certificates/${id(number)}/verify`),

  beginNotebook: (body) => call("POST", "/notebooks", body),
  notebook: (notebook) => call("GET", `/notebooks/${id(notebook)}`),
  writeNotebook: (notebook, line) => call("POST", `/notebooks/${id(notebook)}/lines`, line),

  effects: () => call("GET", "/effects"),
  hideable: () => call("GET", "/lab/effects"),
  createExercise: (body) => call("POST", "/lab", body),
  exercise: (code) => call("GET", `/lab/${id(code)}`),
  joinExercise: (code, name) => call("POST", `/lab/${id(code)}/students`, { name }),
  student: (code, who) => call("GET", `/lab/${id(code)}/students/${id(who)}`),
  labPlan: (code, who, motion) => call("POST", `/lab/${id(code)}/students/${id(who)}/plan`, { motion }),
  labRun: (code, who, body) => call("POST", `/lab/${id(code)}/students/${id(who)}/runs`, body),
  labAnswer: (code, who, body) => call("PUT", `/lab/${id(code)}/students/${id(who)}/answer`, body),
  labResults: (code, key, q) => call("GET", `/lab/${id(code)}/results${query(q)}`, undefined, { "X-Lab-Key": key }),
  labTable: (code, key) => call("GET", `/lab/${id(code)}/results.csv`, undefined, { "X-Lab-Key": key, as: "blob" }),
  reveal: (code, key) => call("POST", `/lab/${id(code)}/reveal`, undefined, { "X-Lab-Key": key }),
  deleteExercise: (code, key) => call("DELETE", `/lab/${id(code)}`, undefined, { "X-Lab-Key": key }),
  recordings: (q) => call("GET", `/recordings${query(q)}`),
  recording: (recording) => call("GET", `/recordings/${id(recording)}`),
  examples: () => call("GET", "/examples"),
  makeExample: (name) => call("POST", `/examples/${id(name)}`),
  signal: (recording, q) => call("GET", `/recordings/${id(recording)}/signal${query(q)}`),
  fit: (recording, body) => call("POST", `/recordings/${id(recording)}/fit`, body),
  suspects: (recording, { effects, ...q }) => call("GET", `/recordings/${id(recording)}/suspects${query({ ...q, effects: effects.join(",") })}`),
  progress: (recording, axis) => call("GET", `/recordings/${id(recording)}/progress${query({ axis })}`),
  keepEffect: (own) => call("POST", "/effects", own),
  models: (q) => call("GET", `/models${query(q)}`),
  saveModel: (body) => call("POST", "/models", body),
  experimentMotion: (experiment) => call("GET", `/experiments/${id(experiment)}/motion`),
  proposeExperiment: (body) => call("POST", "/experiments", body),
  experiment: (experiment) => call("GET", `/experiments/${id(experiment)}`),
  runExperiment: (experiment) => call("POST", `/experiments/${id(experiment)}/run`, {}),

  thesis: () => call("GET", "/thesis"),
  useToken: (token) => localStorage.setItem(TOKEN, token),
};

export const links = {
  live: (run) => `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${ROOT}/runs/${id(run)}/live${query({ lang: language })}`,
  recording: (recording, kind = "csv") => `${ROOT}/recordings/${id(recording)}.${kind}`,
  document: (number, kind) => `${ROOT}/certificates/${id(number)}.${kind}${kind === "pdf" ? query({ lang: language }) : ""}`,
  notebook: (notebook) => `${ROOT}/notebooks/${id(notebook)}.pdf${query({ lang: language })}`,
  lab: (code, key = null) => `/lab.html${query({ code })}${key ? `#key=${id(key)}` : ""}`,
  workbench: (recording, axis, more = {}) => `/workbench.html${query({ recording, axis, ...more })}`,
  model: (model, kind) => `${ROOT}/models/${id(model)}.${kind}`,
  drawing: (effect) => `/effects/${id(effect)}.svg`,
  batch: (batch) => `/batch.html${query({ id: batch })}`,
  batchResults: (batch, kind) => `${ROOT}/batches/${id(batch)}/results.${kind}${query({ lang: kind === "zip" ? language : null })}`,
  run: (run) => `/run.html${query({ id: run })}`,
  board: (board) => `/boards.html${query({ id: board })}`,
  compare: (a, b) => `/compare.html${query({ a, b })}`,
};
