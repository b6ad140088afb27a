// The page of the gateway: its views and its keys. What is shown is live, or says that it is not.

import { byId, go, place } from "./dom.js";
import { follow } from "./stream.js";
import { choose } from "./overview.js";
import "./alarms.js";
import "./lines.js";
import { showTags } from "./tags.js";
import { leaveTrend, showTrend } from "./trend.js";

const VIEWS = [...document.querySelectorAll("nav a")].map((link) => link.dataset.view);

function show() {
  const { view } = place();
  const shown = VIEWS.includes(view) ? view : "overview";
  for (const name of VIEWS) byId(`view-${name}`).hidden = name !== shown;
  for (const link of document.querySelectorAll("nav a")) {
    if (link.dataset.view === shown) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  if (shown === "tags") showTags();
  else if (document.activeElement !== byId("find")) byId("find").value = "";
  if (shown === "trend") showTrend();
  else leaveTrend();
}

// The listeners of the views were added before: they see the view of before, so it is shown first.
addEventListener("hashchange", show, { capture: true });

const KEYS = { o: "overview", t: "tags", a: "alarms", l: "lines", c: "trend" };

addEventListener("keydown", (event) => {
  const typing = event.target.closest("input, select, textarea, dialog");
  if (event.key === "Escape" && event.target === byId("find")) {
    byId("find").value = "";
    byId("find").blur();
    if (place().view === "tags") go("tags");
    return;
  }
  if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === "/") {
    event.preventDefault();
    byId("find").focus();
    byId("find").select();
  } else if (KEYS[event.key] && byId(`view-${KEYS[event.key]}`).hidden) go(KEYS[event.key]);
});

byId("skip").addEventListener("click", () => byId("main").focus());

show();
choose().catch(() => follow());
