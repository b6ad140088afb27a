// What is wrong, the lines with their causes, devices folded below; calls and transfers.

import { byId, clock, h, keyed, moment, put, span, style, svg } from "./dom.js";
import { listed, said, several, t, whole } from "./language.js";
import { api, gateway, now, on, post, signedIn } from "./stream.js";
import { wireOf } from "./wire.js";

const KEPT = 360; // loads of a line: half an hour
const SHORT = 4; // sentences of the overview before the rest is folded
const LINES = 8; // of the overview
const DAY = 86400e3; // ms
const UNSEEN_EVERY = 10_000; // ms
const SHOWN_STATES = 12;
const SHOWN = 200; // devices or transfers
const ORDER = { silent: 0, failing: 1, starting: 2, up: 3 };

export const devices = new Map(); // [line, state, why] by name
const loads = new Map();
const transfers = new Map();
const timelines = new Map(); // [ms, kind, cause] of each state, the oldest first
let lines = [];
let doors = []; // with programs
let origins = {}; // of lines without real devices
let all = false; // every sentence is shown

on("begin", () => {
  loads.clear();
  begun = true;
});
let begun = false; // the next state has all devices and transfers

on("state", (state) => {
  if (begun) for (const known of [devices, transfers, timelines]) known.clear();
  begun = false;
  const history = state.history === null ? t("no history") : state.history === "ok" ? t("history ok") : t("history not ok");
  put("name", state.name);
  put("about", listed([`plc-gateway ${state.version}`, t("up {span}", { span: span(state.up) }), several(state.tags, "{n} tag", "{n} tags"), several(state.links.length, "{n} Zenoh link", "{n} Zenoh links"), history, said(state.standby), !state.you[1] && t("read only")]));
  lines = state.lines;
  doors = state.doors;
  origins = state.origins;
  merge(devices, state.devices);
  merge(transfers, state.transfers);
  merge(timelines, state.timelines);
  showWrong(state);
  showLines();
  showCalls(state.calls);
  showTransfers();
});

on("loads", (added) => {
  for (const [name, more] of Object.entries(added)) loads.set(name, [...(loads.get(name) ?? []), ...more].slice(-KEPT));
  showLines();
});

function merge(into, changes) {
  for (const [name, one] of Object.entries(changes)) {
    if (one === null) into.delete(name);
    else into.set(name, one);
  }
}

function showWrong(state) {
  const sentences = [
    ...(state.ready ? [] : [["warning", t("The gateway does not serve its plant: it starts, or is the standby.")]]),
    ...state.faults.map((text) => ["wrong", text]),
    ...state.warnings.map((text) => ["warning", text]),
    ...(state.more ? [["warning", t("and {n} more", { n: state.more })]] : []),
  ];
  const count = state.faults.length;
  put("fault-count", String(count));
  byId("fault-count").hidden = !count;
  entitle(count + Number(byId("alarm-count").textContent || 0));
  const listed = all ? sentences : sentences.slice(0, SHORT);
  const list = byId("wrong");
  keyed(list, listed, ([, text]) => text.replace(TIMES, ""), ([, text]) => {
    const item = h("li");
    item.head = h("b");
    item.rest = h("span");
    const { head, rest } = parted(text);
    const isShort = !rest || (innerWidth >= 1000 && sentences.length <= SHORT) || (head + rest).length < innerWidth / 12;
    item.colon = isShort && rest ? ": " : "";
    item.append(isShort ? h("p", {}, item.head, item.rest) : h("details", {}, h("summary", {}, item.head), item.rest));
    return item;
  }, (item, [kind, text]) => {
    const { head, rest } = parted(text);
    style(item, kind);
    put(item.head, head + item.colon);
    put(item.rest, rest);
  });
  if (!sentences.length) list.append(h("li", { className: "well" }, t("No faults.")));
  if (sentences.length > SHORT) {
    const fold = () => {
      all = !all;
      showWrong(state);
    };
    list.append(h("li", { className: "fold" }, h("button", { type: "button", className: "link", onclick: fold }, all ? t("Show less") : t("and {n} more", { n: sentences.length - SHORT }))));
  }
}

const entitle = (wanted) => (document.title = `${wanted ? `(${wanted}) ` : ""}${byId("name").textContent}`);

// The title of a tab that is not seen, which has no stream.
setInterval(async () => {
  if (!document.hidden) return;
  const { ok, found } = await api("status").catch(() => ({}));
  if (document.hidden) entitle(ok ? found.faults.length + (found.alarms?.active ?? 0) + (found.alarms?.returned ?? 0) : "?");
}, UNSEEN_EVERY);

const TIMES = / \(for .*?\)|\d+% of the last \d+ requests/g; // what changes in a sentence

const HEAD = new RegExp(`^((?:(?:${t("line")} )?[^\\s：]+?(?:: |：))?(?:(?!: |：).)*)(?:(?:: |：)(.*))?$`, "s");

// A sentence in two: what is wrong, with the name of the line or device, and its cause.
function parted(text) {
  const [, head, rest = ""] = said(text).match(HEAD) ?? [null, said(text)];
  return { head, rest };
}

// -- lines --

function stateOf([name, open]) {
  return said(open ? (origins[name] ?? "open") : "down");
}

// Returns [kind, sentence] of each cause.
function causesOf([name, open, trouble, , , faults, warnings]) {
  const own = new RegExp(`^line ${name.replace(/[.*+?^${}()|[\]\\]/g, "\\$&")}(: | is (down: )?|, )`);
  const found = [...faults.map((text) => ["wrong", text.replace(own, "")]), ...warnings.map((text) => ["warning", text.replace(own, "")])];
  return found.length || open ? found : [["warning", trouble || "not opened yet"]];
}

function showLines() {
  const worst = [...lines].sort((a, b) => Number(a[1]) - Number(b[1]) || b[5].length - a[5].length || b[6].length - a[6].length);
  if (byId("view-lines").hidden) {
    keyed(byId("lines-short"), worst.slice(0, LINES), ([name]) => name, makeShort, showShort);
    if (worst.length > LINES) byId("lines-short").append(h("li", {}, h("a", { href: "#lines" }, t("and {n} more", { n: worst.length - LINES }))));
  } else {
    keyed(byId("lines-list"), worst, ([name]) => name, makeLine, showLine);
  }
}

addEventListener("hashchange", showLines);

function makeShort([name]) {
  const row = h("li", { className: "line" });
  row.state = h("span");
  row.load = h("span", { className: "age" });
  row.cause = h("p", { className: "cause" });
  row.append(h("a", { href: `#lines?line=${encodeURIComponent(name)}` }, name), row.state, row.load, row.cause);
  return row;
}

function showShort(row, line) {
  const of = ownDevices(line[0]);
  const up = of.filter(([, [, state]]) => state === "up").length;
  const [[kind, cause] = ["soft", ""]] = causesOf(line);
  put(row.state, `${stateOf(line)} · ${several(of.length, "{up} of {n} device up", "{up} of {n} devices up", { up })}`);
  style(row.state, kind);
  put(row.load, line[1] ? load(line[0]) : "");
  put(row.cause, line[1] ? parted(cause).head : said(cause));
  row.cause.title = said(cause);
}

const namesOf = (line) => [...devices].filter(([, [of]]) => of === line).map(([name]) => name);

function ownDevices(line) {
  return [...devices].filter(([, [of]]) => of === line).sort(([a, [, one]], [b, [, other]]) => (ORDER[one] ?? 0) - (ORDER[other] ?? 0) || a.localeCompare(b));
}

const load = (name) => {
  const last = loads.get(name)?.at(-1);
  return last === undefined ? "" : `${Math.round(last * 100)} %`;
};

function makeLine([name]) {
  const card = h("li", { className: "card line" });
  card.state = h("span");
  card.causes = h("ul", { className: "causes" });
  card.doors = h("ul", { className: "causes" });
  card.chart = svg("svg", { viewBox: "0 0 360 22", preserveAspectRatio: "none", class: "load", role: "img" });
  card.chart.append(svg("polyline"));
  card.load = h("span", { className: "soft" });
  card.past = svg("svg", { viewBox: "0 0 1000 10", preserveAspectRatio: "none", class: "past", role: "img" });
  card.changes = h("summary");
  card.states = h("ul", { className: "rows" });
  card.timeline = h("details", {}, card.changes, card.states);
  card.summary = h("summary");
  card.devices = h("ul", { className: "rows" });
  card.wire = h("div");
  card.fold = h("details", { ontoggle: () => showDevices(card, name) }, card.summary, card.devices);
  card.button = h("button", { type: "button", className: "quiet", "aria-label": t("wire of {name}", { name }), onclick: () => wireOf(name, card.wire, card.button, namesOf) }, t("Wire"));
  card.append(h("div", { className: "bar" }, h("h2", {}, name), card.state, card.button), card.causes, card.past, card.timeline, card.doors, h("div", { className: "bar" }, card.chart, card.load), card.fold, card.wire);
  return card;
}

function showLine(card, line) {
  const [name, open, , expected, rate] = line;
  put(card.state, stateOf(line));
  const causes = causesOf(line);
  style(card.state, `pill ${!open ? "wrong" : causes.length ? "" : "good"}`);
  keyed(card.causes, causes, ([, text]) => text.replace(TIMES, ""), () => {
    const item = h("li");
    item.head = h("b");
    item.rest = h("span");
    item.append(item.head, item.rest);
    return item;
  }, (item, [kind, text]) => {
    const { head, rest } = parted(text);
    style(item, kind);
    put(item.head, rest ? `${head}: ` : head);
    put(item.rest, rest);
  });
  showTimeline(card, name, timelines.get(name) ?? []);
  keyed(card.doors, doors.filter(([, of]) => of === name), ([door]) => door, ([door]) => {
    const item = h("li");
    item.text = h("span");
    item.button = h("button", { type: "button", className: "quiet write", "aria-label": t("disconnect the programs of {door}", { door }), onclick: () => release(door, item) }, t("Disconnect"));
    item.append(item.text, item.button);
    return item;
  }, (item, [door, , share, programs]) => {
    const shown = programs.slice(0, SHORT).map(([address, since]) => t("{address} for {span}", { address, span: span(since) })).join(t(", "));
    const more = programs.length > SHORT ? ` ${t("and {n} more", { n: programs.length - SHORT })}` : "";
    put(item.text, item.result ?? `${t("door {door}, {share} % of the wire: {programs}", { door, share: Math.round(share * 100), programs: shown })}${more} `);
  });
  const known = loads.get(name) ?? [];
  const step = 360 / Math.max(60, known.length); // five minutes at least
  card.chart.firstChild.setAttribute("points", known.map((share, at) => `${360 - (known.length - 1 - at) * step},${20 - share * 18}`).join(" "));
  card.chart.setAttribute("aria-label", t("load of {name}, highest {n} %", { name, n: Math.round(Math.max(0, ...known) * 100) }));
  put(card.load, listed([t("load {n}", { n: load(name) || "–" }), t("expected {n} %", { n: Math.round(expected * 100) }), rate !== null && t("{n} requests/s", { n: rate.toFixed(1) })]));
  const of = ownDevices(name);
  const up = of.filter(([, [, state]]) => state === "up").length;
  put(card.summary, several(of.length, "{n} device, {up} up", "{n} devices, {up} up", { up }));
  showDevices(card, name, of);
}

// A band of the states since the gateway started, at most of a day, and the newest ones as text.
function showTimeline(card, name, states) {
  const until = now() || Date.now();
  const from = Math.max(states[0]?.[0] ?? until, until - DAY);
  const x = (time) => (1000 * (Math.max(time, from) - from)) / Math.max(until - from, 1);
  const spans = states.map(([time, kind, cause], at) => ({ time, kind, cause, end: states[at + 1]?.[0] ?? until })).filter(({ end }) => end >= from);
  card.past.replaceChildren(...spans.map(({ time, kind, cause, end }) => {
    const part = svg("rect", { x: x(time), width: Math.max(x(end) - x(time), 2), height: 10, class: kind });
    part.append(Object.assign(svg("title"), { textContent: `${clock(time)}: ${said(cause || kind)}` }));
    return part;
  }));
  card.past.setAttribute("aria-label", t("states of {name} in the last {span}", { name, span: span((until - from) / 1000) }));
  const changes = Math.max(0, spans.length - 1);
  put(card.changes, several(changes, "{n} change in the last {span}", "{n} changes in the last {span}", { span: span((until - from) / 1000) }));
  keyed(card.states, spans.reverse().slice(0, SHOWN_STATES), ({ time }) => time, ({ kind }) => h("li", { className: kind }), (item, { time, kind, cause, end }) => put(item, `${moment(time)}, ${span((end - time) / 1000)}: ${said(cause || kind)}`));
}

async function release(door, item) {
  if (!(await signedIn())) return;
  if (!item.armed) {
    item.armed = true;
    return put(item.button, t("Confirm: disconnect"));
  }
  try {
    const { ok, found } = await post("doors/release", { door }, '{"do": "release"}');
    item.result = `${t("door {door}", { door })}: ${ok ? t("disconnected") : said(found.reason ?? found.error)} `;
  } catch {
    item.result = `${t("door {door}", { door })}: ${t("the connection ended; it is not known whether it is done")} `;
  }
  put(item.text, item.result);
}

function showDevices(card, name, of = ownDevices(name)) {
  if (!card.fold.open) return;
  keyed(card.devices, of.slice(0, SHOWN), ([device]) => device, ([device]) => {
    const row = h("li", { className: "device" });
    row.state = h("span");
    row.why = h("p", { className: "cause" });
    row.append(h("a", { href: `#tags?device=${encodeURIComponent(device)}` }, device), row.state, row.why);
    return row;
  }, (row, [, [, state, why]]) => {
    put(row.state, said(state));
    style(row.state, state);
    put(row.why, said(why));
  });
  if (of.length > SHOWN) card.devices.append(h("li", { className: "soft" }, t("and {n} more: use the search", { n: of.length - SHOWN })));
}

// -- calls and transfers --

function showCalls(calls) {
  byId("calls-section").hidden = !calls.length;
  keyed(byId("calls"), calls, ([line]) => line, ([line]) => {
    const row = h("li", { className: "device" });
    row.state = h("span");
    row.more = h("p", { className: "cause" });
    row.append(h("b", {}, line), row.state, row.more);
    return row;
  }, (row, [, state, since, next, result, made, failed]) => {
    put(row.state, since === null ? said(state) : t("{state} for {span}", { state: said(state), span: span(since) }));
    style(row.state, state);
    put(row.more, listed([next !== null && t("next call in {span}", { span: span(next) }), result && t("last result {result}", { result: said(result) }), t("{n} calls, {failed} failed", { n: made, failed })]));
  });
}

const STATES = { unclear: 0, refused: 1, stale: 2, waiting: 3, starting: 4, carried: 5 };

function showTransfers() {
  byId("transfers-section").hidden = !transfers.size;
  if (!transfers.size || byId("view-lines").hidden) return;
  const sorted = [...transfers].sort(([a, one], [b, other]) => STATES[one[2]] - STATES[other[2]] || a - b);
  keyed(byId("transfers"), sorted.slice(0, SHOWN), ([number, [from, to]]) => `${number} ${from} ${to}`, ([number, [from, to]]) => {
    const row = h("li", { className: "device" });
    row.state = h("span");
    row.when = h("span", { className: "age" });
    row.why = h("p", { className: "cause" });
    row.append(h("b", {}, t("{number}: {from} to {to}", { number, from, to })), row.state, row.when, row.why);
    return row;
  }, (row, [, [, , state, code, time, why]]) => {
    put(row.state, said(state));
    style(row.state, state);
    const at = Date.parse(time);
    put(row.when, !time ? t("never carried") : now() ? t("{span} ago", { span: span(Math.max(0, (now() - at) / 1000)) }) : "");
    row.when.title = time ? clock(at) : "";
    put(row.why, [said(why), said(code)].filter(Boolean).join(" · "));
  });
  const working = sorted.filter(([, one]) => one[2] === "carried").length;
  put("transfer-count", [t("{n} of {all} carry their value", { n: whole(working), all: whole(sorted.length) }), sorted.length > SHOWN && t("{n} are shown", { n: SHOWN })].filter(Boolean).join("; "));
}

on("tick", () => gateway.live && showTransfers());
