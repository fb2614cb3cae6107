// What this browser knows of blind exercises: who joined them here, and the keys of those that were made here.
//
// lab(code) -> {student, key, run}: `run(motion, {joins})` moves the hidden bench for the student who joined here.

import { api } from "./api.js";

const KEPT = "gyrobench.lab";
const known = () => JSON.parse(localStorage.getItem(KEPT) ?? "{}");

/** Exercises of this browser, the newest first: {code, title, student?, name?, key?}. */
export const exercises = () => Object.entries(known()).map(([code, facts]) => ({ code, ...facts })).reverse();

/** Keeps facts of an exercise; null takes one away, and an exercise without student and key is forgotten. */
export function remember(code, facts) {
  const { [code]: before, ...others } = known();
  const after = Object.fromEntries(Object.entries({ ...before, ...facts }).filter(([, value]) => value != null));
  localStorage.setItem(KEPT, JSON.stringify(after.student || after.key ? { ...others, [code]: after } : others));
}

export function lab(code) {
  const { student = null, key = null } = known()[code] ?? {};
  return { student, key, run: (motion, more = {}) => api.labRun(code, student, { motion, ...more }) };
}
