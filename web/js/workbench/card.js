// One effect: what it is, a drawing, the equation, why, what it looks like, what it is confused with, how to provoke it.

import { links } from "../api.js";
import { h } from "../dom.js";
import { t } from "../text.js";

const GREEK = { tau: "τ", theta: "θ", phi: "φ", omega: "ω", beta: "β" };

/** 25 (T - T0)**2 as people write it: superscripts, a minus, Greek letters. */
function written(equation) {
  const text = equation.replace(/\b(tau|theta|phi|omega|beta)\b/g, (name) => GREEK[name]).replace(/ - /g, " − ").replace(/\bT0\b/g, "T₀");
  return text.split(/\*\*(\d)/).map((part, i) => (i % 2 ? h("sup", {}, part) : part));
}

const drawings = new Map();

/** The drawing as part of the page, so that it takes the page's colours. */
async function drawing(effect) {
  if (!drawings.has(effect)) {
    const answer = await fetch(links.drawing(effect));
    drawings.set(effect, answer.ok ? await answer.text() : null);
  }
  const text = drawings.get(effect);
  return text && document.importNode(new DOMParser().parseFromString(text, "image/svg+xml").documentElement, true);
}

/** Shows the card of `effect`; `cards` has them all by name. Names of other effects in it open theirs. */
export async function showCard(place, effect, cards, { open, actions = [] }) {
  const card = cards.get(effect);
  const picture = h("div", { class: "drawing", role: "img", "aria-label": card.signature });
  const title = h("h2", { tabindex: "-1" }, card.title);
  const linked = (text) => text.split(/\b([a-z]+(?:_[a-z]+)*)\b/).map((part) => (cards.has(part) && part !== effect
    ? h("button", { type: "button", class: "word", onclick: () => open(part) }, cards.get(part).title) : part));
  const rows = [["cause", card.cause], ["signature", card.signature], ["confused_with", card.confused_with], ["excite_it", card.excite_it], ["source", card.source]];
  place.replaceChildren(h("div", { class: "row spread" }, title, ...actions), h("p", {}, card.summary), picture,
    h("p", { class: "equation" }, written(card.equation)),
    h("dl", { class: "facts card" }, rows.filter(([, text]) => text).map(([key, text]) => h("div", {}, h("dt", {}, t(`workbench.card.${key}`)), h("dd", {}, linked(text))))));
  const drawn = await drawing(effect);
  if (drawn && picture.isConnected) picture.replaceChildren(drawn);
  return title;
}
