// All gateways under the prefix: a map of states, the worst first, and a row for each. Asks only
// while the view is looked at.

import { byId, clock, h, keyed, moment, put, span, style } from "./dom.js";
import { api } from "./stream.js";

const EVERY = 10000; // ms
const MOST_ROWS = 200; // the others are found by words
const STATES = { missing: "missing", fault: "fault", look: "to look at", good: "good" };
const SIGNS = { missing: "×", fault: "!", look: "?", good: "" };

let all = [];
let prefix = ""; // that all names have in common
let only = ""; // a state
let askedAt = -Infinity; // performance.now()
let asking = false;

document.querySelector("nav").append(h("a", { href: "#fleet", "data-view": "fleet" }, "Fleet"));
byId("main").append(
  h("section", { id: "view-fleet", className: "view", "aria-labelledby": "fleet-title", hidden: true },
    h("div", { className: "bar" },
      h("h2", { id: "fleet-title", role: "status", "aria-live": "polite" }, "Gateways"),
      h("div", { id: "fleet-states", role: "group", "aria-label": "States" }),
      h("input", { id: "fleet-find", type: "search", placeholder: "Name, fault, version", "aria-label": "Find gateways", autocomplete: "off", oninput: show })),
    h("ul", { id: "fleet-map", "aria-label": "Map of the gateways" }),
    h("div", { id: "fleet-sums" },
      ...["faults", "versions", "standby", "load"].map((name) => h("p", { id: `fleet-${name}`, className: "soft" }))),
    h("ul", { id: "fleet-list", className: "rows", "aria-label": "Gateways" }),
    h("p", { id: "fleet-more", className: "soft" })),
);

const counted = (words) => {
  const found = new Map();
  for (const word of words) found.set(word, (found.get(word) ?? 0) + 1);
  return [...found].sort((one, other) => other[1] - one[1]);
};
const joined = (pairs) => pairs.map(([word, number]) => `${word} ${number}`).join(" · ");
const short = (name) => name.slice(prefix.length);

async function ask() {
  if (byId("view-fleet").hidden || document.hidden || asking || performance.now() - askedAt < EVERY) return;
  asking = true;
  askedAt = performance.now();
  const reply = await api("fleet").catch(() => null);
  asking = false;
  const old = !reply?.ok;
  byId("view-fleet").classList.toggle("old", old);
  if (old) return put("fleet-more", `Not asked: ${reply?.found.error ?? "no connection to the gateway"}. What is shown here may be old.`);
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
  put("fleet-title", `${all.length} gateways`);
  keyed(byId("fleet-states"), Object.keys(STATES).filter((state) => numbers.has(state) || state === only), (state) => state, makeState, (button, state) => {
    put(button, `${numbers.get(state) ?? 0} ${STATES[state]}`);
    button.setAttribute("aria-pressed", String(state === only));
  });
  const words = byId("fleet-find").value.toLowerCase().split(/\s+/).filter(Boolean);
  const found = all.filter((one) => (!only || one.state === only) && words.every((word) => text(one).includes(word)));
  const chosen = new Set(found);
  style(byId("fleet-map"), all.length > 60 ? "small" : "");
  keyed(byId("fleet-map"), all, (one) => one.gateway, makeCell, (cell, one) => showCell(cell, one, chosen.has(one)));
  put("fleet-faults", sum("Faults", joined(counted(all.flatMap((one) => Object.keys(one.faults ?? {}))))));
  put("fleet-versions", sum("Versions", joined(counted(all.filter((one) => one.version).map((one) => one.version)))));
  put("fleet-standby", sum("Standby groups", joined(counted(all.filter((one) => one.stand).map((one) => one.stand)))));
  const busy = all.filter((one) => one.load > 0).sort((one, other) => other.load - one.load).slice(0, 3);
  put("fleet-load", sum("Busiest", busy.map((one) => `${short(one.gateway)} ${Math.round(one.load * 100)} %`).join(" · ")));
  keyed(byId("fleet-list"), found.slice(0, MOST_ROWS), (one) => one.gateway, makeRow, showRow);
  const left = found.length - MOST_ROWS;
  byId("fleet-more").left = left > 0 ? `and ${left} more: find them by words` : found.length ? "" : "None.";
}

const sum = (title, found) => (found ? `${title}: ${found}` : "");
const text = (one) => [one.gateway, one.says, one.version, one.stand, ...Object.keys(one.faults ?? {})].join(" ").toLowerCase();

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
  const says = `${short(one.gateway)}: ${STATES[one.state]}${one.says ? `, ${one.says}` : ""}`;
  link.title = says;
  link.setAttribute("aria-label", says);
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
  put(row.says, one.says.replace(/\d{4}-\d\d-\d\dT[\d:]+Z/, (time) => moment(Date.parse(time))));
  const devices = Object.entries(one.devices ?? {}).map(([standing, number]) => `${number} ${standing}`).join(", ");
  const facts = one.version && [`version ${one.version}`, `up ${span(one.up)}`, `${one.tags} tags`, devices, one.load !== null && `load ${Math.round(one.load * 100)} %`, one.stand];
  put(row.facts, (facts || []).filter(Boolean).join(" · "));
}

addEventListener("hashchange", ask);
document.addEventListener("visibilitychange", ask);
setInterval(ask, 500);
