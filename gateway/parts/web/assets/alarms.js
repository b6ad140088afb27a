// Alarms that are not normal, each with its button.

import { byId, h, keyed, moment, put, style } from "./dom.js";
import { said, several, t } from "./language.js";
import { api, gateway, on, operator, post, signedIn } from "./stream.js";
import { unitOf } from "./values.js";

const SHORT = 6; // in the overview
const PAGE = 1000; // alarms of one request
const MOST = 5000;
const EVERY = 4000; // ms between two requests for what is not in the events
const PAST_EVERY = 10_000; // ms
const LEVELS = {
  high_high: t("far too high"), high: t("too high"), low: t("too low"), low_low: t("far too low"), on: t("on"), off: t("off"),
  offline: t("offline"), down: t("down"), silent: t("silent"), stopped: t("stopped"), fault: t("fault"),
};

let all = [];
let byTag = new Map();
let asked = 0; // performance.now() of the last request for more
const watchers = [];

export const alarmsOf = (key) => byTag.get(key);
export const onAlarms = (watcher) => watchers.push(watcher);

on("state", async ({ alarms }) => {
  if (!alarms?.shown) return put("alarms-head", t("The alarms do not work now"));
  showSuppressed(alarms.suppressed);
  showPast(PAST_EVERY);
  if (!alarms.more) return takeAll(alarms.shown);
  if (!all.length) takeAll(alarms.shown);
  if (performance.now() - asked < EVERY) return;
  asked = performance.now();
  const found = [];
  for (let after = ""; after !== null && found.length < MOST; ) {
    const reply = await api("alarms", { limit: PAGE, ...(after && { after }) }).catch(() => null);
    if (!reply?.ok) return;
    found.push(...reply.found.alarms);
    after = reply.found.next;
  }
  takeAll(found);
});

function takeAll(alarms) {
  all = alarms.map((one) => ({ ...one, why: why(one) }));
  byTag = new Map(all.map((one) => [one.alarm, one]));
  const open = all.filter((one) => one.state !== "acknowledged");
  put("alarm-count", String(open.length));
  byId("alarm-count").hidden = !open.length;
  byId("acknowledge-all").hidden = open.length < 2 || !gateway.you[1];
  put("acknowledge-all", t("Acknowledge all {n}", { n: open.length }));
  put("alarms-head", all.length ? t("Alarms: {n} to acknowledge, {all} in all", { n: open.length, all: all.length }) : t("Alarms: none"));
  showAll();
  for (const watcher of watchers) watcher();
}

function showAll() {
  const full = !byId("view-alarms").hidden;
  const list = byId(full ? "alarms-list" : "alarms-short");
  keyed(list, full ? all : all.slice(0, SHORT), (one) => one.alarm, makeRow, showRow);
  if (!all.length) list.append(h("li", { className: "soft" }, t("None.")));
  else if (!full && all.length > SHORT) list.append(h("li", {}, h("a", { href: "#alarms" }, t("and {n} more", { n: all.length - SHORT }))));
}

addEventListener("hashchange", () => { showAll(); showPast(); });
byId("past-span").addEventListener("change", () => showPast());

let pastAt = -Infinity; // performance.now() of the last request for it

async function showPast(every = 0) {
  if (byId("view-alarms").hidden || performance.now() - pastAt < every) return;
  pastAt = performance.now();
  const reply = await api("alarms/past", { time: `[now(-${byId("past-span").value})..]` }).catch(() => null);
  if (!reply) return;
  const rows = reply.ok ? reply.found.alarms : [];
  put("past-why", reply.ok ? (rows.length ? "" : t("Nothing.")) : said(reply.found.error));
  byId("past-list").replaceChildren(...rows.map((one) => {
    const by = one.event === "acknowledged" ? one.acknowledged.by : one.by;
    const reason = (one.shelved ?? one.out_of_service)?.reason ?? (one.part_of && t("part of {alarm}", { alarm: one.part_of }));
    const words = [one.alarm, said(one.change ?? one.event), by && t("by {name}", { name: by }), reason ?? why(one)];
    return h("li", { className: "soft" }, h("time", { dateTime: one.since }, moment(Date.parse(one.since))), ` ${words.filter(Boolean).join(" · ")}`);
  }));
}

function why(one) {
  const limit = typeof one.limit === "number" ? ` (${one.limit})` : "";
  const level = { on: "", off: "", offline: "", down: "", silent: "", stopped: "", fault: "" }[one.level] ?? `${LEVELS[one.level] ?? ""}${limit}`;
  const text = one.text ? (one.alarm.includes("/") ? one.text : said(one.text)) : one.alarm; // that of a tag is of the file
  return [text, level].filter(Boolean).join(": ") || LEVELS[one.level];
}

function makeRow() {
  const row = h("li", { className: "alarm" });
  row.why = h("b", { className: "why" });
  row.detail = h("span", { className: "detail" });
  row.where = h("span", { className: "where" });
  row.count = h("summary");
  row.names = h("span");
  row.parts = h("details", {}, row.count, row.names);
  row.button = h("button", { type: "button", onclick: () => acknowledge(row.alarm) }, t("Acknowledge"));
  row.shelve = h("button", { type: "button", onclick: () => shelve(row.alarm) }, t("Shelve …"));
  row.append(h("div", {}, row.why, row.detail, row.where, row.parts), h("div", { className: "bar" }, row.button, row.shelve));
  return row;
}

function showRow(row, one) {
  row.alarm = one;
  const { quality, reason, value, acknowledged, state } = one;
  const text = typeof value === "boolean" || value === "true" || value === "false" ? "" : quality === "good" ? `${value} ${unitOf(one)}`.trim() : `${said("bad")}: ${said(reason ?? "not known")}`;
  put(row.why, one.why);
  row.why.title = one.why;
  put(row.detail, one.detail && !one.why.includes(one.detail) ? said(one.detail) : "");
  const done = state === "acknowledged";
  const time = moment(Date.parse(done ? acknowledged.time : one.since));
  const by = done ? t("acknowledged by {name}, {time}", { name: acknowledged.by, time }) : state === "active" ? t("active since {time}", { time }) : t("returned since {time}", { time });
  put(row.where, [said(one.priority), one.alarm.replace(/^line:/, `${t("line")} `), "time" in one ? text : "", by].filter(Boolean).join(" · "));
  const parts = one.devices ?? [];
  row.parts.hidden = !parts.length;
  put(row.count, several(parts.length, "{n} device", "{n} devices"));
  put(row.names, parts.join(", "));
  const focused = document.activeElement === row.button;
  row.button.hidden = done || !gateway.you[1];
  row.button.setAttribute("aria-label", t("acknowledge {alarm}", one));
  row.shelve.hidden = !gateway.you[1];
  row.shelve.setAttribute("aria-label", t("shelve {alarm}", one));
  if (focused && row.button.hidden) row.shelve.focus(); // the keyboard stays at this alarm
  style(row, `alarm ${state}`);
}

function showSuppressed(found) {
  byId("suppressed").hidden = !found.length;
  keyed(byId("suppressed-list"), found, (one) => one.alarm, makeSuppressed, showRest);
}

function makeSuppressed() {
  const row = h("li", { className: "alarm" });
  row.why = h("b", { className: "why" });
  row.where = h("span", { className: "where" });
  row.button = h("button", { type: "button", onclick: () => order(row.alarm, { do: row.alarm.shelved ? "unshelve" : "in-service" }, t("put back")) }, t("Put back"));
  row.append(h("div", {}, row.why, row.where), row.button);
  return row;
}

function showRest(row, one) {
  row.alarm = one;
  const what = one.shelved ?? one.out_of_service;
  const until = one.shelved ? t("shelved until {time}", { time: moment(Date.parse(what.until)) }) : t("out of service since {time}", { time: moment(Date.parse(what.time)) });
  put(row.why, why(one));
  put(row.where, [said(one.priority), one.alarm, `${until} ${t("by {name}", { name: what.by })}`, what.reason].join(" · "));
  row.button.hidden = !gateway.you[1];
  row.button.setAttribute("aria-label", t("put {alarm} back", one));
}

let asking = null; // the alarm of the dialog

async function shelve(one) {
  if (!(await signedIn())) return;
  asking = one;
  put("shelve-title", t("Shelve {alarm}", one));
  byId("shelve").showModal();
}

byId("shelve-cancel").addEventListener("click", () => byId("shelve").close());
byId("shelve-form").addEventListener("submit", () => {
  const seconds = Number(byId("shelve-for").value);
  const fields = { do: seconds ? "shelve" : "out-of-service", reason: byId("shelve-reason").value, ...(seconds && { seconds }) };
  order(asking, fields, seconds ? t("shelved") : t("taken out of service"));
});

async function order({ alarm }, fields, done) {
  if (!(await signedIn())) return;
  try {
    const { ok, found } = await post("alarms/order", { alarm }, JSON.stringify({ by: operator(), ...fields }));
    put("acknowledge-result", `${alarm}: ${ok ? done : said(found.reason ?? found.error)}`);
  } catch {
    put("acknowledge-result", `${alarm}: ${t("the connection ended; it is not known whether it is done")}`);
  }
}

// The time of the alarm goes with it: an alarm that was raised again meanwhile is not acknowledged.
async function acknowledge(...alarms) {
  if (!(await signedIn())) return;
  let done = 0;
  let by = "";
  const wrong = [];
  for (const { alarm, raised } of alarms) {
    put("acknowledge-result", t("acknowledging {alarm} …", { alarm }));
    try {
      const { ok, found } = await post("alarms/acknowledge", { alarm }, JSON.stringify({ by: operator(), raised }));
      if (!ok) wrong.push(`${alarm}: ${said(found.reason ?? found.error)}`);
      else {
        done += 1;
        by = found.acknowledged?.by ?? operator(); // another operator may have been faster
        takeAll(all.map((one) => (one.alarm === alarm ? found : one)).filter((one) => one.state !== "normal"));
      }
    } catch {
      wrong.push(`${alarm}: ${t("the connection ended; it is not known whether it is done")}`);
      break;
    }
  }
  const first = done === 1 && alarms.length === 1 ? `${alarms[0].alarm}: ${t("acknowledged")} ${t("by {name}", { name: by })}` : done ? several(done, "{n} alarm acknowledged", "{n} alarms acknowledged") : "";
  put("acknowledge-result", [first, ...wrong.slice(0, 5)].filter(Boolean).join(". "));
}

byId("acknowledge-all").addEventListener("click", () => acknowledge(...all.filter((one) => one.state !== "acknowledged")));
