// Messages of typed columns, as the server's live.py writes them.

/** u32 length, JSON, then Float64 arrays back to back in the order of `arrays`. */
export function decode(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const frame = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  // The arrays start at a multiple of 8 after the length; a copy puts them at one in memory too.
  const arrays = buffer.slice(4 + length);
  let at = 0;
  frame.columns = {};
  for (const [name, count] of frame.arrays ?? []) {
    frame.columns[name] = new Float64Array(arrays, at, count);
    at += 8 * count;
  }
  return frame;
}
