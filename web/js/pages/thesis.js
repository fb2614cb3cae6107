// The thesis' tables, computed again from its own readings, beside what it printed.

import { api } from "../api.js";
import { h } from "../dom.js";
import { page } from "../shell.js";
import { t } from "../text.js";

page("thesis", async (main) => {
  const report = await api.thesis();
  main.append(h("h1", {}, t("thesis.headline", report.statistics)), h("p", {}, t("thesis.purpose")));
});
