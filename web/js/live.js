// A run as it happens: frames from the websocket, kept as typed columns; the page redraws from them.

import { links } from "./api.js";
import { decode } from "./columns.js";
import { clock, t } from "./text.js";

const ROWS = 8192;      // more than two minutes at 50 rows/s
const RETRY_MS = [500, 1000, 2000, 4000];
const NO_SUCH_RUN = 4404;
const ENDED = new Set(["finished", "stopped", "failed", "interrupted"]);

/** The newest rows of one column, contiguous in memory: filled to the end, then the newest half moves to the front. */
export class Column {
  #values = new Float64Array(2 * ROWS);
  #end = 0;
  append(block) {
    if (block.length > ROWS) block = block.subarray(block.length - ROWS);
    if (this.#end + block.length > 2 * ROWS) {
      this.#values.copyWithin(0, this.#end - ROWS, this.#end);
      this.#end = ROWS;
    }
    this.#values.set(block, this.#end);
    this.#end += block.length;
  }
  get values() { return this.#values.subarray(Math.max(0, this.#end - ROWS), this.#end); }
}

/** The run so far, whoever watches and since when. */
export class RunSoFar {
  constructor() { this.clear(); }
  clear() {
    Object.assign(this, { columns: {}, points: [], results: {}, status: null, state: null, progress: null, certificate: null, message: null });
  }
  take(frame) {
    if (frame.reset) this.clear();
    for (const [name, block] of Object.entries(frame.columns)) (this.columns[name] ??= new Column()).append(block);
    this.points.push(...(frame.points ?? []));
    Object.assign(this.results, frame.results);
    for (const key of ["run", "status", "state", "state_index", "step", "progress", "bench_time_s", "speed", "states"]) {
      if (frame[key] !== undefined) this[key] = frame[key];
    }
    if (frame.certificate != null) this.certificate = frame.certificate;
    if (frame.message != null) this.message = frame.message;
  }
  column(name) { return this.columns[name]?.values ?? new Float64Array(0); }
  get ended() { return ENDED.has(this.status); }
}

/** Watches a run until it ends. onFrame(soFar, frame) for every frame, onConnection(sentence or null) when the line breaks or mends. */
export function watch(run, { onFrame, onConnection }) {
  const soFar = new RunSoFar();
  let socket;
  let tries = 0;
  let isClosed = false;

  function connect() {
    socket = new WebSocket(links.live(run));
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => {
      if (tries) onConnection(null);
      tries = 0;
      const frame = decode(data);
      soFar.take(frame);
      onFrame(soFar, frame);
    };
    socket.onclose = ({ code, reason }) => {
      if (isClosed || soFar.ended) return;
      if (code === NO_SUCH_RUN) { onConnection(reason); return; }
      if (!tries) onConnection(t("live.lost", { time: clock() }));
      setTimeout(connect, RETRY_MS[Math.min(tries++, RETRY_MS.length - 1)]);
    };
  }
  connect();
  return () => { isClosed = true; socket.close(); };
}
