// All gateways under the prefix: a map of states, the worst first, and a row for each. Asks only
// while the view is looked at.

import { byId, clock, h, keyed, moment, put, span, style } from "./dom.js";
import { listed, said, several, t } from "./language.js";
import { api } from "./stream.js";

const EVERY = 10000; // ms
const MOST_ROWS = 200; // the others are found by words
const STATES = { missing: t("missing"), fault: t("fault"), look: t("to look at"), good: t("good") };
const SIGNS = { missing: "×", fault: "!", look: "?", good: "" };

let all = [];
let prefix = ""; // that all names have in common
let only = ""; // a state
let askedAt = -Infinity; // performance.now()
let asking = false;

document.querySelector("nav").append(h("a", { href: "#fleet", "data-view": "fleet" }, t("Fleet")));
byId("main").append(
  h("section", { id: "view-fleet", className: "view", "aria-labelledby": "fleet-title", hidden: true },
    h("div", { className: "bar" },
      h("h2", { id: "fleet-title", role: "status", "aria-live": "polite" }, t("Gateways")),
      h("div", { id: "fleet-states", role: "group", "aria-label": t("States") }),
      h("input", { id: "fleet-find", type: "search", placeholder: t("Name, fault, version"), "aria-label": t("Find gateways"), autocomplete: "off", oninput: show })),
    h("ul", { id: "fleet-map", "aria-label": t("Map of the gateways") }),
    h("div", { id: "fleet-sums" },
      ...["faults", "versions", "drift", "standby", "load"].map((name) => h("p", { id: `fleet-${name}`, className: "soft" }))),
    h("ul", { id: "fleet-list", className: "rows", "aria-label": t("Gateways") }),
    h("p", { id: "fleet-more", className: "soft" })),
);

const counted = (words) => {
  const found = new Map();
  for (const word of words) found.set(word, (found.get(word) ?? 0) + 1);
  return [...found].sort((one, other) => other[1] - one[1]);
};
const short = (name) => name.slice(prefix.length);

async function ask() {
  if (byId("view-fleet").hidden || document.hidden || asking || performance.now() - askedAt < EVERY) return;
  asking = true;
  askedAt = performance.now();
  const reply = await api("fleet").catch(() => null);
  asking = false;
  const old = !reply?.ok;
  byId("view-fleet").classList.toggle("old", old);
  if (old) {
    const why = said(reply?.found.error) ?? t("no connection to the gateway");
    return put("fleet-more", `${t("Not asked: {why}.", { why })} ${t("What is shown here may be old.")}`);
  }
  const { gateways, mistakes, time, took } = reply.found;
  all = gateways;
  const [first] = all;
  prefix = "";
  if (all.length > 1) {
    let end = first.gateway.lastIndexOf("/") + 1;
    while (end && !all.every((one) => one.gateway.startsWith(first.gateway.slice(0, end)))) end = first.gateway.lastIndexOf("/", end - 2) + 1;
    prefix = first.gateway.slice(0, end);
  }
  show();
  put("fleet-more", [`${clock(Date.parse(time))}, ${span(took)}`, ...mistakes.slice(0, 5), byId("fleet-more").left].filter(Boolean).join(" · "));
}

function show() {
  const numbers = new Map(counted(all.map((one) => one.state)));
  put("fleet-title", several(all.length, "{n} gateway", "{n} gateways"));
  keyed(byId("fleet-states"), Object.keys(STATES).filter((state) => numbers.has(state) || state === only), (state) => state, makeState, (button, state) => {
    put(button, `${numbers.get(state) ?? 0} ${STATES[state]}`);
    button.setAttribute("aria-pressed", String(state === only));
  });
  const words = byId("fleet-find").value.toLowerCase().split(/\s+/).filter(Boolean);
  const found = all.filter((one) => (!only || one.state === only) && words.every((word) => text(one).includes(word)));
  const chosen = new Set(found);
  style(byId("fleet-map"), all.length > 60 ? "small" : "");
  keyed(byId("fleet-map"), all, (one) => one.gateway, makeCell, (cell, one) => showCell(cell, one, chosen.has(one)));
  const busy = all.filter((one) => one.load > 0).sort((one, other) => other.load - one.load).slice(0, 3);
  const stands = all.filter((one) => one.stand).map(stand);
  sum("fleet-faults", counted(all.flatMap((one) => Object.keys(one.faults ?? {}))), (list) => t("Faults: {list}", { list }));
  sum("fleet-versions", counted(all.filter((one) => one.version).map((one) => one.version)), (list) => t("Versions: {list}", { list }));
  sum("fleet-drift", counted(all.filter((one) => one.drift).map((one) => one.drift === "no file" ? t("no file") : t("differs"))), (list) => t("Files: {list}", { list }));
  sum("fleet-standby", counted(stands), (list) => t("Standby groups: {list}", { list }));
  sum("fleet-load", busy.map((one) => [short(one.gateway), `${Math.round(one.load * 100)} %`]), (list) => t("Busiest: {list}", { list }));
  keyed(byId("fleet-list"), found.slice(0, MOST_ROWS), (one) => one.gateway, makeRow, showRow);
  const left = found.length - MOST_ROWS;
  byId("fleet-more").left = left > 0 ? t("and {n} more: use the search", { n: left }) : found.length ? "" : t("None.");
}

const sum = (id, pairs, shown) => put(id, pairs.length ? shown(pairs.map((pair) => pair.join(" ")).join(" · ")) : "");
const says = (one) => one.says.replace(/\d{4}-\d\d-\d\dT[\d:]+Z/, (time) => moment(Date.parse(time))).split("; ").map(said).join("; ");
const stand = (one) => one.stand && `${one.group ?? "?"}: ${said(one.stand)}`;
const text = (one) => [one.gateway, says(one), one.version, one.group, one.stand, ...Object.keys(one.faults ?? {})].join(" ").toLowerCase();

function makeState(state) {
  return h("button", { type: "button", className: state, onclick: () => { only = only === state ? "" : state; show(); } });
}

function makeCell({ gateway }) {
  return h("li", {}, h("a", { href: "#fleet", onclick: (event) => {
    event.preventDefault();
    only = "";
    byId("fleet-find").value = gateway;
    show();
  } }));
}

function showCell(cell, one, chosen) {
  const link = cell.firstElementChild;
  style(cell, `${one.state}${chosen ? "" : " other"}`);
  put(link, SIGNS[one.state] + (all.length > 60 ? "" : ` ${short(one.gateway)}`));
  const about = `${short(one.gateway)}: ${listed([STATES[one.state], says(one)])}`;
  link.title = about;
  link.setAttribute("aria-label", about);
}

function makeRow() {
  const row = h("li");
  row.state = h("b");
  row.name = h("b", { className: "name" });
  row.says = h("span", { className: "says" });
  row.facts = h("span", { className: "soft" });
  row.append(row.state, h("div", {}, row.name, row.says, row.facts));
  return row;
}

function showRow(row, one) {
  put(row.state, STATES[one.state]);
  style(row.state, `pill ${one.state}`);
  put(row.name, short(one.gateway));
  put(row.says, says(one));
  const devices = Object.entries(one.devices ?? {}).map(([standing, number]) => `${number} ${said(standing)}`);
  const facts = one.version && [t("version {version}", one), t("up {span}", { span: span(one.up) }), several(one.tags, "{n} tag", "{n} tags"), listed(devices), one.load !== null && t("load {n}", { n: `${Math.round(one.load * 100)} %` }), stand(one)];
  put(row.facts, (facts || []).filter(Boolean).join(" · "));
}

addEventListener("hashchange", ask);
document.addEventListener("visibilitychange", ask);
setInterval(ask, 500);
