// What every page has: the bar on top with the stop, the language, and one place for sentences about the whole page.

import { api } from "./api.js";
import { $, h } from "./dom.js";
import { chooseLanguage, clock, language, loadTexts, t, translate } from "./text.js";

const PAGES = [
  ["calibrate", "/"], ["workbench", "/workbench.html"], ["boards", "/boards.html"], ["certificates", "/certificates.html"], ["batch", "/batch.html"], ["lab", "/lab.html"],
  ["compare", "/compare.html"], ["rig", "/rig.html"], ["thesis", "/thesis.html"],
];
const RIG_EVERY_MS = 5000;
const SETTLE_MS = 600;

/** The stop comes first and needs nothing else of the page: no texts, no rig, no confirmation. */
function stopButton() {
  const button = h("button", { class: "stop", type: "button" }, "STOP");
  button.addEventListener("click", async () => {
    notice("stop", t("page.stopping"), "fail");
    try {
      await api.emergencyStop();
      notice("stop", t("page.stopped", { time: clock() }), "fail");
    } catch (problem) {
      notice("stop", t("page.stop_failed", { reason: problem.message }), "fail");
    }
  });
  return button;
}

/** A sentence about the whole page, under the bar, until another with the same name or null replaces it. */
export function notice(name, text, kind = "") {
  $(`#notices [data-name="${name}"]`)?.remove();
  if (text) $("#notices").append(h("div", { class: `notice ${kind}`, "data-name": name, role: kind === "fail" ? "alert" : "status" }, text));
}

/** The server asks for its token: its sentence, and the place to type it. */
function askToken(problem) {
  notice("token", problem.message, "fail");
  const field = h("input", { type: "password", "aria-label": t("page.token"), autocomplete: "off" });
  $('#notices [data-name="token"]').append(h("form", {
    class: "row",
    onsubmit: (event) => { event.preventDefault(); api.useToken(field.value.trim()); location.reload(); },
  }, field, h("button", { type: "submit" }, t("page.use_token"))));
}

/** Whether the system's own faces have Thai; the page's is not sent for the one word on the button. */
function hasThai() {
  const pen = document.createElement("canvas").getContext("2d");
  pen.font = `32px ${getComputedStyle(document.documentElement).getPropertyValue("--system")}`;
  // U+0E3E is no letter: what is drawn for it is drawn for whatever is not there.
  return pen.measureText("ก").width !== pen.measureText("\u0e3e").width;
}

export function rigSentence(rig) {
  const name = rig.simulated ? t("rig.simulated_at", { speed: speedWord(rig.speed) }) : rig.url;
  const holder = rig.run ? t("rig.in_use") : api.holdsRig() ? t("rig.you_hold") : rig.lease ? t("rig.held_by", { holder: rig.lease.holder }) : t("rig.free");
  return `${name} · ${rig.connected ? t("rig.connected") : t("rig.not_connected")} · ${holder}`;
}

export const speedWord = (speed) => (speed === "max" || speed === Infinity || speed === 0 ? t("rig.full_speed") : `${speed}×`);

/** Starts a page: bar, texts, the page's own work; then the rig every five seconds, told to `rig-changed` listeners. */
export async function page(name, work) {
  const who = h("p", { class: "who" });
  const nav = h("nav", { id: "menu" });
  const menu = h("button", {
    class: "menu", type: "button", "aria-expanded": "false", "aria-controls": "menu",
    onclick: () => menu.setAttribute("aria-expanded", String(nav.classList.toggle("open"))),
  });
  const languages = h("div", { class: "languages", role: "group" });
  const stop = stopButton();
  const skip = h("a", { class: "skip", href: "#content" });
  document.body.prepend(
    skip, h("header", { class: "bar" }, h("a", { class: "brand", href: "/" }, "Gyrobench"), menu, nav, who, languages, stop),
  );
  const main = $("main");
  main.id = "content";
  main.before(h("div", { id: "notices", "aria-live": "polite" }));

  await loadTexts();
  // Before the first word and the first chart: a canvas does not wait for a face.
  if (language === "th") await document.fonts.load("1rem Sarabun", "ก");
  document.title = `${t(`page.${name}`)} · Gyrobench`;
  stop.textContent = t("page.stop");
  stop.setAttribute("aria-label", t("page.emergency_stop"));
  menu.textContent = t("page.menu");
  skip.textContent = t("page.skip");
  nav.setAttribute("aria-label", t("page.pages"));
  nav.append(...PAGES.map(([key, href]) => h("a", { href, "aria-current": key === name ? "page" : null }, t(`page.${key}`))));
  languages.setAttribute("aria-label", t("page.language"));
  languages.append(...[["en", "EN"], ["th", language === "th" || hasThai() ? "ไทย" : "Thai"]].map(([code, word]) => h("button", {
    type: "button", lang: code, "aria-pressed": String(code === language), onclick: () => chooseLanguage(code),
  }, word)));
  translate();

  async function lookAtRig() {
    try {
      const rig = await api.rig();
      await api.keepRig(rig.lease);
      who.textContent = rigSentence(rig);
      notice("rig", null);
      document.dispatchEvent(new CustomEvent("rig-changed", { detail: rig }));
    } catch (problem) {
      notice("rig", problem.message, "fail");
    }
  }
  document.addEventListener("rig-asked", lookAtRig);
  document.addEventListener("token-needed", ({ detail }) => askToken(detail));
  setInterval(() => { if (!document.hidden || api.holdsRig()) lookAtRig(); }, RIG_EVERY_MS);
  const begun = Promise.all([work(main), lookAtRig()]);
  // Shown when it has taken its form, so that nothing moves under the eye; but soon, whatever does not answer.
  await Promise.race([begun.catch(() => {}), new Promise((resolve) => { setTimeout(resolve, SETTLE_MS); })]);
  document.documentElement.dataset.ready = "";
  try {
    await begun;
  } catch (problem) {
    notice("fault", problem.message, "fail");
    if (problem.status === undefined) throw problem;
  }
}
