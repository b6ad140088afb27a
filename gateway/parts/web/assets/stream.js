// The event stream, the token, and whether what is shown is live: when the stream breaks or is
// late, nothing is live at once.

import { byId, put, clock } from "./dom.js";
import { said, t } from "./language.js";

const SILENT = 2500; // ms without an event until nothing is live
const LATE = 3000; // ms that an event may be later than the fastest one
const SLEPT = 10000; // ms in which this program did not run

export const gateway = { you: ["", false], live: false };
const takers = {};
const watchers = [];
let choice = {}; // of the stream: tags, line
let stream = null;
let heard = 0; // performance.now() of the last event
let serverTime = 0; // ms since 1970, of the last event
let fastest = Infinity; // the least difference of the two steady clocks, in this stream
let awake = Date.now();

export const on = (kind, taker) => (takers[kind] ??= []).push(taker);
export const onLive = (watcher) => watchers.push(watcher);
export const now = () => serverTime && serverTime + (performance.now() - heard);

// -- the token --

let asked = null; // of the dialog

export const operator = () => sessionStorage.getItem("by") ?? "";

function headers() {
  const token = sessionStorage.getItem("token");
  return token ? { Authorization: `Bearer ${token}` } : {};
}

// Returns true when the client has signed in, with the dialog if it has not.
export function signedIn(why = "") {
  if (gateway.you[0] && operator() && !why) return Promise.resolve(true);
  put("sign-in-why", why);
  if (!asked) {
    byId("by").value = operator();
    byId("sign-in").showModal();
    asked = {};
    asked.promise = new Promise((resolve) => (asked.resolve = resolve));
  }
  return asked.promise;
}

function answered(found) {
  if (byId("sign-in").open) byId("sign-in").close();
  asked?.resolve(found);
  asked = null;
}

byId("token-form").addEventListener("submit", (event) => {
  event.preventDefault();
  sessionStorage.setItem("token", byId("token").value.trim());
  sessionStorage.setItem("by", byId("by").value.trim());
  put("sign-in-why", "…");
  follow();
});
byId("sign-in").addEventListener("cancel", () => answered(false));
byId("sign-in-cancel").addEventListener("click", () => answered(false));
byId("account").addEventListener("click", () => {
  if (!gateway.you[0]) return signedIn();
  sessionStorage.removeItem("token");
  follow();
});

on("state", ({ you }) => {
  gateway.you = you;
  const [name, mayWrite] = you;
  byId("account").hidden = !mayWrite;
  document.documentElement.classList.toggle("read-only", !mayWrite);
  put("account", name ? t("{name}: sign out", { name }) : t("Sign in"));
  if (!sessionStorage.getItem("token")) return;
  if (!name) { // wrong, or withdrawn: the next action asks for it
    sessionStorage.removeItem("token");
    if (asked) put("sign-in-why", t("The gateway does not know this token."));
    return follow();
  }
  if (!asked) return;
  byId("token").value = "";
  answered(true);
});

// -- requests --

// Characters that turn the direction of text would turn the digits beside them too.
const plain = (text) => text.replace(/[\u202a-\u202e\u2066-\u2069]/g, "");

export async function api(path, query = {}, options = {}) {
  const reply = await fetch(`api/${path}?${new URLSearchParams(query)}`, {
    cache: "no-store", ...options, headers: { ...headers(), ...options.headers },
  });
  const text = plain(await reply.text());
  // The text of a value is kept as it was sent: a number of JavaScript would round it.
  return { ok: reply.ok, refused: reply.status === 401 || reply.status === 403, found: JSON.parse(text.replace(/"value":(-?\d[\d.eE+-]*|\[[^\]"]*\])/g, '"value":"$1"')) };
}

export const post = (path, query, body) =>
  api(path, query, { method: "POST", body, headers: { "Content-Type": "application/json" } });

// -- live or not --

function setLive(live, why = "") {
  gateway.live = live;
  document.body.classList.toggle("stale", !live);
  const since = serverTime ? t("Not live since {time}", { time: clock(serverTime) }) : t("Not connected");
  put("live", live ? t("live") : serverTime ? t("not live") : t("connecting …"));
  byId("lost").hidden = live || (!serverTime && !why);
  put("lost", live ? "" : `${since}${why ? `: ${said(why)}` : ""}. ${t("What is shown here may be old.")}`);
  for (const watcher of watchers) watcher(live);
}

// A computer that slept gets old events in a burst: they must not look live, so the stream begins again.
function slept() {
  const before = awake;
  awake = Date.now();
  if (Math.abs(awake - before) < SLEPT) return false;
  if (!document.hidden) {
    setLive(false, t("the page slept"));
    follow();
  }
  return true;
}

setInterval(() => {
  if (slept()) return;
  if (gateway.live && performance.now() - heard > SILENT) setLive(false, t("no event arrives"));
  for (const taker of takers.tick ?? []) taker();
}, 500);

// A browser has six connections to one gateway for all its tabs: one that is not seen has no stream.
document.addEventListener("visibilitychange", () => {
  awake = Date.now();
  if (document.hidden) setLive(false, t("the page slept"));
  run();
});

// -- the event stream --

export function follow(change = {}) {
  choice = { ...choice, ...change };
  run();
}

async function run() {
  stream?.abort();
  stream = null;
  if (document.hidden) return;
  const mine = (stream = new AbortController());
  const query = new URLSearchParams();
  for (const [name, value] of Object.entries(choice)) if (value) query.set(name, value);
  while (stream === mine) {
    fastest = Infinity;
    for (const taker of takers.begin ?? []) taker();
    let why = t("the connection ended");
    try {
      const reply = await fetch(`api/events?${query}`, { headers: headers(), signal: mine.signal, cache: "no-store" });
      if (reply.ok) await read(reply.body, mine);
      else {
        why = (await reply.json()).error;
        if (reply.status === 401 && stream === mine) signedIn(sessionStorage.getItem("token") ? t("The gateway does not know this token.") : t("This gateway shows its values with a token."));
      }
    } catch {
      if (mine.signal.aborted) return;
      why = t("no connection to the gateway");
    }
    if (stream !== mine) return;
    setLive(false, why);
    await new Promise((done) => setTimeout(done, 1000));
  }
}

async function read(body, mine) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done || stream !== mine) return;
    const events = (rest + plain(value)).split("\n\n");
    rest = events.pop();
    for (const event of events) {
      if (stream !== mine) return;
      const [, kind, data] = event.match(/^event: (\w+)\ndata: (.*)$/m) ?? [];
      if (kind === "time") takeTime(JSON.parse(data));
      else if (kind) for (const taker of takers[kind] ?? []) taker(JSON.parse(data));
    }
  }
}

function takeTime([time, steady]) {
  if (slept()) return;
  heard = performance.now();
  const behind = heard - steady;
  fastest = Math.min(fastest, behind);
  if (behind - fastest > LATE) return setLive(false, t("events are late")); // they wait on their way
  serverTime = time;
  setLive(true);
  for (const taker of takers.time ?? []) taker();
}
