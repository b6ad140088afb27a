// Alarms that are not normal, each with its button.

import { byId, h, keyed, moment, put, style } from "./dom.js";
import { api, gateway, on, operator, post, signedIn } from "./stream.js";

const SHORT = 6; // in the overview
const PAGE = 1000; // alarms of one request
const MOST = 5000;
const EVERY = 4000; // ms between two requests for what is not in the events
const PAST_EVERY = 10_000; // ms
const LEVELS = {
  high_high: "far too high", high: "too high", low: "too low", low_low: "far too low", on: "on", off: "off",
  offline: "offline", down: "down", silent: "silent", stopped: "stopped",
};

let all = [];
let byTag = new Map();
let asked = 0; // performance.now() of the last request for more
const watchers = [];

export const alarmsOf = (key) => byTag.get(key);
export const onAlarms = (watcher) => watchers.push(watcher);

on("state", async ({ alarms }) => {
  if (!alarms?.shown) return put("alarms-head", "The alarms do not work now");
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
  put("acknowledge-all", `Acknowledge all ${open.length}`);
  put("alarms-head", all.length ? `Alarms: ${open.length} to acknowledge, ${all.length} in all` : "Alarms: none");
  showAll();
  for (const watcher of watchers) watcher();
}

function showAll() {
  const full = !byId("view-alarms").hidden;
  const list = byId(full ? "alarms-list" : "alarms-short");
  keyed(list, full ? all : all.slice(0, SHORT), (one) => one.alarm, makeRow, showRow);
  if (!all.length) list.append(h("li", { className: "soft" }, "None."));
  else if (!full && all.length > SHORT) list.append(h("li", {}, h("a", { href: "#alarms" }, `and ${all.length - SHORT} more`)));
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
  put("past-why", reply.ok ? (rows.length ? "" : "Nothing.") : reply.found.error);
  byId("past-list").replaceChildren(...rows.map((one) => {
    const by = one.event === "acknowledged" ? one.acknowledged.by : one.by;
    const reason = (one.shelved ?? one.out_of_service)?.reason ?? (one.part_of && `part of ${one.part_of}`);
    const words = [one.alarm, one.change ?? one.event, by && `by ${by}`, reason ?? why(one)];
    return h("li", { className: "soft" }, h("time", { dateTime: one.since }, moment(Date.parse(one.since))), ` ${words.filter(Boolean).join(" · ")}`);
  }));
}

function why(one) {
  const limit = typeof one.limit === "number" ? ` (${one.limit})` : "";
  const level = { on: "", off: "", offline: "", down: "", silent: "", stopped: "" }[one.level] ?? `${LEVELS[one.level] ?? ""}${limit}`;
  const text = one.text || one.alarm;
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
  row.button = h("button", { type: "button", onclick: () => acknowledge(row.alarm) }, "Acknowledge");
  row.shelve = h("button", { type: "button", onclick: () => shelve(row.alarm) }, "Shelve …");
  row.append(h("div", {}, row.why, row.detail, row.where, row.parts), h("div", { className: "bar" }, row.button, row.shelve));
  return row;
}

function showRow(row, one) {
  row.alarm = one;
  const { quality, reason, value, unit, acknowledged, state } = one;
  const text = typeof value === "boolean" || value === "true" || value === "false" ? "" : quality === "good" ? `${value} ${unit}`.trim() : `bad: ${reason ?? "not known"}`;
  put(row.why, one.why);
  put(row.detail, one.detail && !one.why.includes(one.detail) ? one.detail : "");
  const done = state === "acknowledged";
  const by = done ? `acknowledged by ${acknowledged.by}, ${moment(Date.parse(acknowledged.time))}` : `${state} since ${moment(Date.parse(one.since))}`;
  put(row.where, [one.priority, one.alarm.replace(/^line:/, "line "), "time" in one ? text : "", by].filter(Boolean).join(" · "));
  const parts = one.devices ?? [];
  row.parts.hidden = !parts.length;
  put(row.count, `${parts.length} devices`);
  put(row.names, parts.join(", "));
  row.button.hidden = done || !gateway.you[1];
  row.button.setAttribute("aria-label", `acknowledge ${one.alarm}`);
  row.shelve.hidden = !gateway.you[1];
  row.shelve.setAttribute("aria-label", `shelve ${one.alarm}`);
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
  row.button = h("button", { type: "button", onclick: () => order(row.alarm, { do: row.alarm.shelved ? "unshelve" : "in-service" }, "put back") }, "Put back");
  row.append(h("div", {}, row.why, row.where), row.button);
  return row;
}

function showRest(row, one) {
  row.alarm = one;
  const what = one.shelved ?? one.out_of_service;
  const until = one.shelved ? `shelved until ${moment(Date.parse(what.until))}` : `out of service since ${moment(Date.parse(what.time))}`;
  put(row.why, why(one));
  put(row.where, [one.priority, one.alarm, `${until} by ${what.by}`, what.reason].join(" · "));
  row.button.hidden = !gateway.you[1];
  row.button.setAttribute("aria-label", `put ${one.alarm} back`);
}

let asking = null; // the alarm of the dialog

async function shelve(one) {
  if (!(await signedIn())) return;
  asking = one;
  put("shelve-title", `Shelve ${one.alarm}`);
  byId("shelve").showModal();
}

byId("shelve-cancel").addEventListener("click", () => byId("shelve").close());
byId("shelve-form").addEventListener("submit", () => {
  const seconds = Number(byId("shelve-for").value);
  const fields = { do: seconds ? "shelve" : "out-of-service", reason: byId("shelve-reason").value, ...(seconds && { seconds }) };
  order(asking, fields, seconds ? "shelved" : "taken out of service");
});

async function order({ alarm }, fields, done) {
  if (!(await signedIn())) return;
  try {
    const { ok, found } = await post("alarms/order", { alarm }, JSON.stringify({ by: operator(), ...fields }));
    put("acknowledge-result", `${alarm}: ${ok ? done : found.reason ?? found.error}`);
  } catch {
    put("acknowledge-result", `${alarm}: the connection ended; it is not known whether it was ${done}`);
  }
}

// The time of the alarm goes with it: an alarm that was raised again meanwhile is not acknowledged.
async function acknowledge(...alarms) {
  if (!(await signedIn())) return;
  let done = 0;
  const wrong = [];
  for (const { alarm, raised } of alarms) {
    put("acknowledge-result", `acknowledging ${alarm} …`);
    try {
      const { ok, found } = await post("alarms/acknowledge", { alarm }, JSON.stringify({ by: operator(), raised }));
      if (!ok) wrong.push(`${alarm}: ${found.reason ?? found.error}`);
      else {
        done += 1;
        takeAll(all.map((one) => (one.alarm === alarm ? found : one)).filter((one) => one.state !== "normal"));
      }
    } catch {
      wrong.push(`${alarm}: the connection ended; it is not known whether it was acknowledged`);
      break;
    }
  }
  const first = done === 1 && alarms.length === 1 ? `${alarms[0].alarm}: acknowledged` : done ? `${done} alarms acknowledged` : "";
  put("acknowledge-result", [first, ...wrong.slice(0, 5)].filter(Boolean).join(". "));
}

byId("acknowledge-all").addEventListener("click", () => acknowledge(...all.filter((one) => one.state !== "acknowledged")));
