// Alarms that are not normal, each with its button.

import { byId, h, keyed, moment, put, style } from "./dom.js";
import { said, several, t } from "./language.js";
import { api, gateway, on, operator, post, signedIn } from "./stream.js";
import { unitOf } from "./values.js";

const SHORT = 6; // in the overview
const PAGE = 1000; // alarms of one request
const MOST = 5000;
const ROWS = 300; // in the list: a browser stands still with thousands
const AT_ONCE = 6; // orders: more wait in the browser
const EVERY = 4000; // ms between two requests for what is not in the events; of a thousand alarms
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
  if (performance.now() - asked < EVERY * Math.max(1, all.length / PAGE)) return;
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
  const open = all.filter(waits);
  put("alarm-count", String(open.length));
  byId("alarm-count").hidden = !open.length;
  put("alarms-head", all.length ? t("Alarms: {n} to acknowledge, {all} in all", { n: open.length, all: all.length }) : t("Alarms: none"));
  showAll();
  for (const watcher of watchers) watcher();
}

const waits = (one) => one.state !== "acknowledged";

// Returns the alarms that have each word of the filter.
function filtered() {
  const words = byId("alarm-filter").value.toLowerCase().split(/\s+/).filter(Boolean);
  if (!words.length) return all;
  return all.filter((one) => {
    const text = `${one.alarm} ${one.why} ${one.detail ?? ""} ${said(one.priority)} ${one.state}`.toLowerCase();
    return words.every((word) => text.includes(word));
  });
}

function showAll() {
  const full = !byId("view-alarms").hidden;
  const list = byId(full ? "alarms-list" : "alarms-short");
  const found = full ? filtered() : all;
  const rows = found.slice(0, full ? ROWS : SHORT);
  keyed(list, rows, (one) => one.alarm, makeRow, showRow);
  const more = t("and {n} more", { n: found.length - rows.length });
  if (!found.length) list.append(h("li", { className: "soft" }, t("None.")));
  else if (found.length > rows.length) list.append(h("li", { className: "soft" }, full ? more : h("a", { href: "#alarms" }, more)));
  const open = found.filter(waits).length;
  byId("alarm-filter").hidden = all.length < 2;
  byId("acknowledge-all").hidden = open < 2 || !gateway.you[1];
  put("acknowledge-all", t("Acknowledge all {n}", { n: open }));
}

byId("alarm-filter").addEventListener("input", showAll);

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
  const done = new Map(); // documents by alarm
  let by = "";
  const [wrong, left] = [[], [...alarms]];
  const next = async () => {
    for (let one = left.shift(); one; one = left.shift()) {
      const { alarm, raised } = one;
      put("acknowledge-result", alarms.length === 1 ? t("acknowledging {alarm} …", { alarm }) : t("acknowledging: {n} left …", { n: left.length + 1 }));
      try {
        const { ok, refused, found } = await post("alarms/acknowledge", { alarm }, JSON.stringify({ by: operator(), raised }));
        if (refused) left.length = 0; // the token was withdrawn
        if (!ok) wrong.push(`${alarm}: ${said(found.reason ?? found.error)}`);
        else {
          done.set(alarm, found);
          by = found.acknowledged?.by ?? operator(); // another operator may have been faster
        }
      } catch {
        wrong.push(`${alarm}: ${t("the connection ended; it is not known whether it is done")}`);
        left.length = 0;
      }
    }
  };
  await Promise.all(Array.from({ length: AT_ONCE }, next));
  takeAll(all.map((one) => done.get(one.alarm) ?? one).filter((one) => one.state !== "normal"));
  const first = done.size === 1 && alarms.length === 1 ? `${alarms[0].alarm}: ${t("acknowledged")} ${t("by {name}", { name: by })}` : done.size ? several(done.size, "{n} alarm acknowledged", "{n} alarms acknowledged") : "";
  put("acknowledge-result", [first, ...wrong.slice(0, 5)].filter(Boolean).join(". "));
}

byId("acknowledge-all").addEventListener("click", () => acknowledge(...filtered().filter(waits)));
