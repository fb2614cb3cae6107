// Which rig, and what of it answers. Used beside the form and on the rig's own page.

import { api } from "./api.js";
import { h, say } from "./dom.js";
import { speedWord } from "./shell.js";
import { t } from "./text.js";

const SPEEDS = [1, 5, 20, 100, "max"];
const WORD = (part) => (part.ok === null ? t("rig.unknown") : part.ok ? t("rig.ok") : t("rig.bad"));

/** One line a part: a word with its mark; the sentence and the cure where something is wrong, or always when `full`. */
export function partsList(parts, full = false) {
  return h("ul", { class: full ? "parts full" : "parts" }, parts.map((part) => h("li", { class: part.ok === null ? "" : part.ok ? "ok" : "bad" },
    h("span", { class: "name" }, t(`rig.part_${part.part.replace(" ", "_")}`)), " ", h("span", { class: "small" }, WORD(part)),
    part.ok === false || full ? h("p", { class: "small" }, [part.sentence, part.cure].filter(Boolean).join(" ")) : null)));
}

/** Choice of rig, port and speed with the parts below; `show(rig)` fills it. A person's half-made choice is left alone. */
export function rigCard(place, { full = false } = {}) {
  const choice = h("select", { id: "rig-url" });
  const port = h("select", { id: "rig-port" });
  const url = h("input", { id: "rig-custom", spellcheck: "false", autocomplete: "off" });
  const speed = h("select", { id: "rig-speed" });
  const error = h("p", { class: "error", role: "alert" });
  const parts = h("div", {});
  const check = h("button", { type: "button", id: "rig-check" }, t("rig.check"));
  const field = (id, control, key) => h("div", {}, h("label", { for: id }, t(key)), control);
  const [portField, urlField, speedField] = [field("rig-port", port, "rig.port"), field("rig-custom", url, "rig.address"), field("rig-speed", speed, "rig.speed")];
  place.replaceChildren(h("div", { class: "pair uneven" }, field("rig-url", choice, "rig.rig"), speedField), portField, urlField, parts, error, h("div", { class: "row" }, check));

  const OTHER = "other:";
  let rig = null;

  async function ask(call) {
    say(error, null);
    check.disabled = true;
    try { show(await call()); } catch (problem) {
      say(error, problem);
      // Shows the rig that the server has now; an address that was typed stays to be corrected.
      if (choice.value !== OTHER) fill();
    }
    document.dispatchEvent(new Event("rig-asked"));
    check.disabled = false;
  }
  const isBench = (address) => address.startsWith("dynamixel:");
  const PORT = /^dynamixel:([^?+]*)/;
  const address = () => (choice.value === OTHER ? url.value.trim()
    : isBench(choice.value) && port.value ? choice.value.replace(PORT, `dynamixel:${port.value}`) : choice.value);
  const change = () => {
    portField.hidden = !isBench(choice.value) || !port.options.length;
    urlField.hidden = choice.value !== OTHER;
    if (!address()) return;
    const isSimulated = /^twin:/.test(address());
    speedField.hidden = !isSimulated;
    ask(() => api.chooseRig({ url: address(), ...(isSimulated && { speed: speed.value === "max" ? "max" : Number(speed.value) }) }));
  };
  choice.addEventListener("change", () => { showPort(choice.value); });
  for (const control of [choice, port, url, speed]) control.addEventListener("change", change);
  check.addEventListener("click", () => ask(() => api.checkRig()));

  /** The port that an address names, even one that is not plugged in now. */
  function showPort(named) {
    const wanted = PORT.exec(named)?.[1];
    const there = rig?.ports ?? [];
    port.replaceChildren(...[...there, ...(wanted && !there.includes(wanted) ? [wanted] : [])].map((name) => h("option", {}, name)));
    if (wanted) port.value = wanted;
  }

  function show(next) {
    const isNew = JSON.stringify(next) !== JSON.stringify(rig);
    rig = next;
    if (isNew && document.activeElement !== url) fill();
  }

  function fill() {
    const next = rig;
    const choices = [...next.choices];
    if (!choices.some(({ url: known }) => known === next.url)) choices.push({ url: next.url, label: next.url });
    choice.replaceChildren(...choices.map(({ url: known, label }) => h("option", { value: known }, label)), h("option", { value: OTHER }, t("rig.other")));
    choice.value = next.url;
    showPort(next.url);
    const speeds = SPEEDS.includes(next.speed) || next.speed == null ? SPEEDS : [...SPEEDS, next.speed];
    speed.replaceChildren(...speeds.map((value) => h("option", { value }, speedWord(value))));
    speed.value = next.speed ?? 1;
    speedField.hidden = !next.simulated;
    portField.hidden = !isBench(next.url) || !port.options.length;
    urlField.hidden = true;
    parts.replaceChildren(partsList(next.parts, full));
    for (const control of [choice, port, url, speed, check]) control.disabled = next.run != null;
  }
  return { show };
}
