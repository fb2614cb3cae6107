// Blind lab: join a bench or set one up; a student's bench; a teacher's class.

import { api, links } from "../api.js";
import { h, say } from "../dom.js";
import { classroom } from "../lab_class.js";
import { hunt } from "../lab_hunt.js";
import { setupForm } from "../lab_setup.js";
import { exercises, lab, remember } from "../lab_student.js";
import { page } from "../shell.js";
import { t } from "../text.js";

page("lab", async (main) => {
  const address = new URLSearchParams(location.search);
  const code = address.get("code")?.trim().toUpperCase();
  if (!code) return start(main);
  // …#key=… brings a teacher's key to another browser; it does not stay in the address bar.
  const given = new URLSearchParams(location.hash.slice(1)).get("key");
  if (given) {
    remember(code, { key: given });
    history.replaceState(null, "", location.pathname + location.search);
  }
  const [exercise, { student, key }] = [await api.exercise(code), lab(code)];
  document.title = `${exercise.title || code} · Gyrobench`;
  if (key && !address.has("student")) return classroom(main, exercise, key);
  if (!student) return joining(main, exercise);
  try {
    return hunt(main, exercise, await api.student(code, student));
  } catch (problem) {
    if (problem.status !== 404) throw problem;
    remember(code, { student: null, name: null });
    return joining(main, exercise);
  }
});

async function start(main) {
  const mine = exercises();
  main.append(
    h("header", { class: "stack" }, h("h1", {}, t("lab.headline")), h("p", { class: "lead" }, t("lab.about"))),
    h("div", { class: "columns start" },
      h("div", { class: "stack" },
        h("section", { class: "panel stack" }, h("h2", {}, t("lab.join_title")), h("p", { class: "muted" }, t("lab.join_about")), joinForm()),
        mine.length ? h("section", { class: "panel stack" }, h("h2", {}, t("lab.mine")), h("ul", { class: "plain" }, mine.map((one) =>
          h("li", { class: "row spread" }, h("a", { href: links.lab(one.code) }, one.title || one.code),
            h("span", { class: "muted small" }, one.key ? t("lab.as_teacher", one) : t("lab.as_student", one)))))) : null),
      h("section", { class: "panel stack" }, h("h2", {}, t("lab.setup_title")), h("p", { class: "muted" }, t("lab.setup_about")), await setupForm())),
  );
}

function joining(main, exercise) {
  main.append(
    h("header", { class: "stack" }, h("h1", {}, exercise.title || t("lab.bench", exercise)), h("p", { class: "lead" }, t("lab.join_one", exercise))),
    h("section", { class: "panel stack narrow" }, h("h2", {}, t("lab.join_title")), joinForm(exercise.code)));
}

function joinForm(code = "") {
  const [codeField, name] = [
    h("input", { id: "lab-code", class: "code", required: true, maxlength: 12, autocomplete: "off", spellcheck: "false", value: code }),
    h("input", { id: "lab-name", required: true, maxlength: 80, autocomplete: "name" }),
  ];
  const error = h("p", { class: "error", role: "alert" });
  const join = h("button", { class: "main", type: "submit" }, t("lab.join"));
  return h("form", {
    class: "stack", novalidate: true,
    onsubmit: async (event) => {
      event.preventDefault();
      say(error, null);
      join.disabled = true;
      try {
        const exercise = await api.exercise(codeField.value.trim().toUpperCase());
        const { student } = await api.joinExercise(exercise.code, name.value);
        remember(exercise.code, { student, name: name.value.trim(), title: exercise.title });
        location.href = `${links.lab(exercise.code)}&student`;
      } catch (problem) {
        say(error, problem);
        join.disabled = false;
      }
    },
  },
  h("div", { hidden: Boolean(code) }, h("label", { for: "lab-code" }, t("lab.code")), codeField),
  h("div", {}, h("label", { for: "lab-name" }, t("lab.name")), name),
  error, h("div", { class: "row" }, join));
}
