// The status page. It shows values only while they are live: when the event stream breaks or is
// late, everything turns grey at once, with the time of the last event.

const byId = (id) => document.getElementById(id);
const SILENT = 2500; // ms without an event until nothing is live
const LATE = 3000; // ms that an event may be later than the fastest one
const SLEPT = 10000; // ms in which this program did not run
const SHOWN = 200; // rows of devices
const WINDOW = 10000; // ms of the wire
const LONGEST_LIST = 200; // characters of an array that are shown

const known = { devices: new Map(), transfers: new Map(), lines: [], loads: new Map(), exchanges: [], tags: new Map() };
let token = "";
let choice = readHash();
let stream = null; // of the current choice
let heard = 0; // performance.now() of the last event
let serverTime = 0; // ms since 1970, of the last event
let fastest = Infinity; // the least difference of the two steady clocks, in this stream
let awake = Date.now();
let live = false;
let valuesLive = false; // values of the chosen device came by the current stream
let nextAfter = null;

function readHash() {
  const found = new URLSearchParams(location.hash.slice(1));
  return { line: found.get("line") ?? "", device: found.get("device") ?? "", after: found.get("after") ?? "" };
}

function choose(change) {
  const next = new URLSearchParams();
  for (const [name, value] of Object.entries({ ...choice, ...change })) if (value) next.set(name, value);
  location.hash = next.toString();
}

function element(name, text, className) {
  const made = document.createElement(name);
  if (text !== undefined) made.textContent = text;
  if (className) made.className = className;
  return made;
}

function clock(ms) {
  return new Date(ms).toLocaleTimeString([], { hour12: false });
}

function span(seconds) {
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 120) return `${Math.round(seconds)} s`;
  if (seconds < 7200) return `${Math.round(seconds / 60)} min`;
  return seconds < 172800 ? `${Math.round(seconds / 3600)} h` : `${Math.round(seconds / 86400)} d`;
}

// -- live or not --

function setLive(now, why) {
  live = now;
  const isStale = !live || (choice.device !== "" && !valuesLive);
  if (isStale !== document.body.classList.contains("stale")) {
    document.body.classList.toggle("stale", isStale);
    for (const tag of known.tags.values()) if (tag.last && tag.cells) showQuality(tag);
  }
  const since = serverTime ? `not live since ${clock(serverTime)}` : "not connected";
  put("live", live ? "live" : `${since}${why ? `: ${why}` : ""}`);
  put("values-live", !isStale ? "" : `These values are not live${serverTime ? `: they are of ${clock(serverTime)}` : ""}.`);
}

function put(id, text) {
  if (byId(id).textContent !== text) byId(id).textContent = text;
}

// A computer that slept gets old events in a burst: they must not look live, so the stream begins again.
function slept() {
  const before = awake;
  awake = Date.now();
  if (Math.abs(awake - before) < SLEPT) return false;
  if (!document.hidden) {
    setLive(false, "the page slept");
    follow();
  }
  return true;
}

setInterval(() => {
  if (slept()) return;
  if (live && performance.now() - heard > SILENT) setLive(false, "no event arrives");
  showAges();
}, 500);

// -- the event stream --

function headers() {
  return token ? { Authorization: `Bearer ${token}` } : {};
}

async function follow() {
  stream?.abort();
  const mine = (stream = new AbortController());
  valuesLive = false;
  fastest = Infinity;
  known.exchanges = [];
  known.loads.clear();
  known.transfers.clear(); // their first event has all
  const query = new URLSearchParams();
  for (const [name, value] of Object.entries(choice)) if (value) query.set(name, value);
  while (stream === mine) {
    let why = "the connection ended";
    try {
      const reply = await fetch(`api/events?${query}`, { headers: headers(), signal: mine.signal, cache: "no-store" });
      if (reply.ok) await read(reply.body, mine);
      else {
        why = `${reply.status} ${(await reply.json()).error}`;
        if (reply.status === 401) byId("login").hidden = false;
      }
    } catch (error) {
      if (mine.signal.aborted) return;
      why = "no connection to the gateway";
    }
    if (stream !== mine) return;
    valuesLive = false;
    known.devices.clear();
    known.transfers.clear();
    known.loads.clear();
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
    const events = (rest + value).split("\n\n");
    rest = events.pop();
    for (const event of events) {
      if (stream !== mine) return;
      const [, kind, data] = event.match(/^event: (\w+)\ndata: (.*)$/s) ?? [];
      if (kind) take(kind, JSON.parse(data));
    }
  }
}

function take(kind, data) {
  if (kind === "time") return takeTime(data);
  if (kind === "state") return takeState(data);
  if (kind === "loads") return takeLoads(data);
  if (kind === "values") return takeValues(data);
  if (kind === "wire") return takeWire(data);
}

function takeTime([now, steady]) {
  if (slept()) return;
  heard = performance.now();
  const behind = heard - steady;
  fastest = Math.min(fastest, behind);
  if (behind - fastest > LATE) return setLive(false, "events are late"); // they wait on their way
  serverTime = now;
  setLive(true);
  drawWire();
}

// -- state --

function takeState(state) {
  const standby = state.standby ? `, ${state.standby}` : "";
  put("name", state.name);
  const wanted = state.faults.length + state.alarms.shown.filter((one) => one.state !== "acknowledged").length;
  document.title = `${wanted ? `(${wanted}) ` : ""}${state.name}`;
  const history = state.history === null ? "" : `, history ${state.history === "ok" ? "ok" : "not ok"}`;
  put("about", `${state.version}, up ${span(state.up)}, ${state.tags} tags, ${state.links.length} Zenoh links${history}${standby}`);
  const sentences = [
    ...(state.ready ? [] : [["warning", "the gateway does not serve its plant: it starts, or is the standby"]]),
    ...state.faults.map((text) => ["wrong", text]),
    ...state.warnings.map((text) => ["warning", text]),
    ...(state.more ? [["warning", `and ${state.more} more`]] : []),
  ];
  const items = sentences.length ? sentences : [["good", "nothing"]];
  if (JSON.stringify(items) !== known.items) {
    known.items = JSON.stringify(items);
    byId("wrong").replaceChildren(...items.map(([kind, text]) => element("li", text, kind)));
  }
  showAlarms(state.alarms);
  known.lines = state.lines;
  known.simulated = state.simulated;
  showLines();
  showCalls(state.calls);
  if (merge(known.transfers, state.transfers) || !known.transfers.size) showTransfers();
  if (merge(known.devices, state.devices)) showDevices();
}

function merge(into, changes) {
  for (const [name, one] of Object.entries(changes)) {
    if (one === null) into.delete(name);
    else into.set(name, one);
  }
  return Object.keys(changes).length > 0;
}

// -- alarms --

const LEVELS = { high_high: "far too high", high: "too high", low: "too low", low_low: "far too low", on: "on", off: "off" };

function showAlarms({ shown, more }) {
  const text = JSON.stringify(shown);
  if (text === known.alarms) return;
  known.alarms = text;
  byId("alarms").replaceChildren(...shown.map((one) => {
    const row = element("tr");
    const title = element("th", one.alarm);
    title.scope = "row";
    const limit = typeof one.limit === "number" ? ` (${one.limit})` : "";
    const value = !("time" in one) ? "" : typeof one.value === "boolean" ? (one.value ? "on" : "off") : one.value;
    const since = Date.parse(one.since);
    const good = one.quality === "good";
    const shownValue = !good ? `bad: ${one.reason ?? "not known"}` : one.unit ? `${value} ${one.unit}` : value;
    const by = one.acknowledged;
    row.append(
      title,
      element("td", one.state, one.state === "acknowledged" ? "acknowledged" : `unacknowledged ${one.state}`),
      element("td", [one.text, LEVELS[one.level] && `${LEVELS[one.level]}${limit}`, one.detail].filter(Boolean).join(": ")),
      element("td", String(shownValue), good ? "number value" : "number bad"),
      element("td", Date.now() - since < 86400e3 ? clock(since) : new Date(since).toLocaleString(), "less"),
      element("td", by ? `${by.by}, ${clock(Date.parse(by.time))}` : "no"),
    );
    return row;
  }));
  put("alarm-count", shown.length ? (more ? `and ${more} more: see api/alarms` : "") : "none");
  const open = shown.filter((one) => one.state !== "acknowledged");
  const chosen = byId("acknowledge-alarm").value;
  byId("acknowledge-alarm").replaceChildren(...open.map((one) => {
    const option = element("option", one.alarm);
    option.dataset.raised = one.raised;
    return option;
  }));
  if (open.some((one) => one.alarm === chosen)) byId("acknowledge-alarm").value = chosen;
  byId("acknowledging").hidden = !open.length && !byId("acknowledge-result").textContent;
}

// The time of the alarm goes with it: an alarm that was raised again meanwhile is not acknowledged.
byId("acknowledge-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  token = byId("acknowledge-token").value.trim() || token;
  const [chosen] = byId("acknowledge-alarm").selectedOptions;
  if (!chosen) return;
  const alarm = chosen.value;
  const body = JSON.stringify({ by: byId("acknowledge-name").value.trim(), raised: chosen.dataset.raised });
  put("acknowledge-result", "sending …");
  try {
    const reply = await fetch(`api/alarms/acknowledge?${new URLSearchParams({ alarm })}`, {
      method: "POST", body, headers: { ...headers(), "Content-Type": "application/json" },
    });
    const found = await reply.json();
    put("acknowledge-result", reply.ok ? `${alarm}: acknowledged by ${found.acknowledged.by}, now ${found.state}` : `${alarm}: ${found.reason ?? found.error}`);
  } catch {
    put("acknowledge-result", `${alarm}: the connection ended; it is not known whether it was acknowledged`);
  }
});

// -- lines --

function takeLoads(loads) {
  for (const [name, added] of Object.entries(loads)) {
    known.loads.set(name, [...(known.loads.get(name) ?? []), ...added].slice(-360));
  }
  showLines();
}

function showLines() {
  const body = byId("lines");
  known.lines.forEach(([name, open, trouble, expected, requests], number) => {
    const row = body.children[number] ?? body.appendChild(lineRow());
    const [button, state, picture, load, planned, rate] = row.cells;
    const shown = button.firstChild;
    if (shown.textContent !== name) shown.textContent = name;
    shown.setAttribute("aria-pressed", String(choice.line === name));
    const text = open ? (known.simulated.includes(name) ? "simulated" : "open") : `down: ${trouble || "not opened yet"}`;
    if (state.textContent !== text) state.textContent = text;
    state.className = open ? "open" : "down";
    const loads = known.loads.get(name) ?? [];
    const last = loads.at(-1);
    load.textContent = last === undefined ? "" : `${Math.round(last * 100)} %`;
    planned.textContent = `${Math.round(expected * 100)} %`;
    rate.textContent = requests === null ? "" : requests.toFixed(1);
    const step = 360 / Math.max(60, loads.length); // five minutes at least
    const points = loads.map((share, at) => `${360 - (loads.length - 1 - at) * step},${20 - share * 18}`).join(" ");
    const chart = picture.firstChild;
    if (chart.dataset.count !== String(loads.length) || chart.dataset.last !== String(last)) {
      chart.dataset.count = loads.length;
      chart.dataset.last = last;
      chart.firstChild.setAttribute("points", points);
      chart.setAttribute("aria-label", `load of ${name}: now ${load.textContent}, highest ${Math.round(Math.max(0, ...loads) * 100)} %`);
    }
  });
  while (body.children.length > known.lines.length) body.lastChild.remove();
}

function lineRow() {
  const row = element("tr");
  const button = element("button", "", "link");
  button.type = "button";
  button.addEventListener("click", () => choose({ line: choice.line === button.textContent ? "" : button.textContent }));
  const chart = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  chart.setAttribute("viewBox", "0 0 360 22");
  chart.setAttribute("preserveAspectRatio", "none");
  chart.setAttribute("class", "load");
  chart.setAttribute("role", "img");
  chart.append(document.createElementNS("http://www.w3.org/2000/svg", "polyline"));
  const cells = [element("td"), element("td"), element("td"), element("td", "", "number"), element("td", "", "number less"), element("td", "", "number less")];
  cells[0].append(button);
  cells[2].append(chart);
  row.append(...cells);
  return row;
}

// -- calls and transfers --

function rowTitle(text) {
  const title = element("th", text);
  title.scope = "row";
  return title;
}

function showCalls(calls) {
  byId("calls-section").hidden = !calls.length;
  byId("calls").replaceChildren(...calls.map(([line, state, since, next, result, made, failed]) => {
    const row = element("tr");
    row.append(
      rowTitle(line), element("td", since === null ? state : `${state} for ${span(since)}`, state),
      element("td", next === null ? "" : `in ${span(next)}`), element("td", result),
      element("td", String(made), "number"), element("td", String(failed), "number"),
    );
    return row;
  }));
}

const STATES = { unclear: 0, refused: 1, stale: 2, waiting: 3, starting: 4, carried: 5 };
const STYLES = { stale: "old" }; // `stale` is the class of a page that is not live

function showTransfers() {
  const all = [...known.transfers].sort(([a, one], [b, other]) => STATES[one[2]] - STATES[other[2]] || a - b);
  byId("transfers-section").hidden = !all.length;
  byId("transfers").replaceChildren(...all.slice(0, SHOWN).map(([number, [from, to, state, code, time, why]]) => {
    const row = element("tr");
    const at = Date.parse(time);
    const carried = element("td", time ? clock(at) : "never");
    if (time) carried.dataset.time = at;
    const reason = element("td", why);
    if (code) reason.append(element("span", why ? ` (${code})` : code, "code"));
    row.append(
      rowTitle(`${number}: ${from} to ${to}`), element("td", state, STYLES[state] ?? state),
      carried, reason,
    );
    return row;
  }));
  const working = all.filter(([, one]) => one[2] === "carried").length;
  put("transfer-count", `${working} of ${all.length} carry their value${all.length > SHOWN ? `; ${SHOWN} are shown` : ""}`);
  showAges();
}

const ORDER = { silent: 0, failing: 1, starting: 2, up: 3 };

function showDevices() {
  const find = byId("find").value.toLowerCase();
  const all = [...known.devices].filter(([name, [line]]) => `${line} ${name}`.toLowerCase().includes(find));
  all.sort(([a, [, one]], [b, [, other]]) => (ORDER[one] ?? 0) - (ORDER[other] ?? 0) || a.localeCompare(b));
  const focused = document.activeElement?.dataset?.device;
  byId("devices").replaceChildren(...all.slice(0, SHOWN).map(([name, [line, state, why]]) => {
    const row = element("tr");
    const button = element("button", name, "link");
    button.type = "button";
    button.dataset.device = name;
    button.setAttribute("aria-pressed", String(choice.device === name));
    button.addEventListener("click", () => choose({ device: choice.device === name ? "" : name, after: "" }));
    const first = element("td");
    first.append(button);
    row.append(first, element("td", line), element("td", state, state), element("td", why));
    return row;
  }));
  if (focused) byId("devices").querySelector(`[data-device="${CSS.escape(focused)}"]`)?.focus();
  put("device-count", all.length > SHOWN ? `${SHOWN} of ${all.length}` : `${all.length}`);
}

byId("find").addEventListener("input", showDevices);

// -- values --

async function showTags() {
  const { device, after } = choice;
  byId("values-section").hidden = !device;
  byId("trend").hidden = true;
  byId("values").replaceChildren();
  known.tags.clear();
  if (!device) return;
  put("values-title", `Values of ${device}`);
  const query = new URLSearchParams({ device, limit: "200" });
  if (after) query.set("after", after);
  const reply = await fetch(`api/tags?${query}`, { headers: headers(), cache: "no-store" });
  if (!reply.ok || choice.device !== device || choice.after !== after) return;
  const { tags, next } = await reply.json();
  nextAfter = next;
  byId("next").disabled = next === null;
  byId("first").disabled = !after;
  byId("write-tag").replaceChildren(...tags.filter((tag) => tag.write).map((tag) => {
    const option = element("option", tag.tag);
    if (tag.length) option.dataset.length = tag.length;
    return option;
  }));
  byId("writing").hidden = !tags.some((tag) => tag.write);
  for (const tag of tags) {
    const row = element("tr");
    const name = tag.tag.slice(device.length + 1);
    const title = element("th", name);
    title.scope = "row";
    title.title = [tag.description, tag.type, tag.address].filter(Boolean).join(", ");
    const cells = [element("td", "", tag.length ? "value" : "number value"), element("td", tag.unit), element("td"), element("td", "", "number"), element("td")];
    if (tag.history && !tag.length) { // a list has no line
      const button = element("button", "trend", "link");
      button.type = "button";
      button.setAttribute("aria-label", `trend of ${tag.tag}`);
      button.addEventListener("click", () => showTrend(tag));
      cells[4].append(button);
    }
    row.append(title, ...cells);
    byId("values").append(row);
    const { last } = known.tags.get(name) ?? {}; // its value may have come before its row
    known.tags.set(name, { cells, last, isList: Boolean(tag.length) });
    if (last) showValue(last);
  }
}

function takeValues(values) {
  for (const value of values) {
    if (!known.tags.has(value[0])) known.tags.set(value[0], {});
    showValue(value);
  }
  valuesLive = true;
}

function showValue(last) {
  const tag = known.tags.get(last[0]);
  tag.last = last;
  if (!tag.cells) return;
  const text = last[2] ? last[1] : "–";
  const isLong = tag.isList && text.length > LONGEST_LIST;
  tag.cells[0].textContent = isLong ? `${text.slice(0, text.lastIndexOf(",", LONGEST_LIST) + 1)} …` : text;
  tag.cells[0].title = isLong ? text : "";
  showQuality(tag);
}

function showQuality({ cells, last: [, , good, , why] }) {
  const isStale = document.body.classList.contains("stale");
  cells[2].textContent = isStale ? "not live" : !good ? `bad: ${why}` : why ? `good, ${why}` : "good";
  cells[2].className = isStale ? "" : good ? "good" : "bad";
}

function showAges() {
  if (!serverTime) return;
  const now = serverTime + (performance.now() - heard);
  for (const tag of known.tags.values()) {
    if (tag.cells && tag.last) {
      const text = span(Math.max(0, (now - tag.last[3]) / 1000));
      if (tag.cells[3].textContent !== text) tag.cells[3].textContent = text;
    }
  }
  for (const cell of document.querySelectorAll("#transfers [data-time]")) {
    const text = `${span(Math.max(0, (now - cell.dataset.time) / 1000))} ago`;
    if (cell.textContent !== text) cell.textContent = text;
  }
}

byId("next").addEventListener("click", () => choose({ after: nextAfter ?? "" }));
byId("first").addEventListener("click", () => choose({ after: "" }));

async function showTrend(tag) {
  byId("trend").hidden = false;
  put("trend-title", `${tag.tag}, the last 15 minutes`);
  put("trend-text", "reading …");
  byId("trend-chart").replaceChildren();
  const query = new URLSearchParams({ tag: tag.tag, time: "[now(-15m)..]", limit: "10000" });
  const reply = await fetch(`api/history?${query}`, { headers: headers(), cache: "no-store" });
  const found = await reply.json();
  if (!reply.ok) return put("trend-text", found.error);
  drawTrend(found, tag);
}

function drawTrend({ samples, complete }, tag) {
  const good = samples.filter((sample) => sample.quality === "good" && typeof sample.value !== "string");
  if (!good.length) return put("trend-text", `${samples.length} samples, none with a good number`);
  const numbers = good.map((sample) => Number(sample.value));
  const [low, high] = [Math.min(...numbers), Math.max(...numbers)];
  const times = samples.map((sample) => Date.parse(sample.time));
  const [from, to] = [times[0], Math.max(times.at(-1), times[0] + 1000, serverTime)];
  const x = (time) => (600 * (time - from)) / (to - from);
  const y = (value) => (high === low ? 75 : 140 - (130 * (value - low)) / (high - low));
  const lines = [[]]; // a bad sample breaks the line
  samples.forEach((sample, at) => {
    if (sample.quality !== "good") return lines.at(-1).length && lines.push([]);
    const here = lines.at(-1);
    if (here.length) here.push(`${x(times[at])},${here.at(-1).split(",")[1]}`); // a value stays until the next
    here.push(`${x(times[at])},${y(Number(sample.value))}`);
  });
  const drawn = lines.filter((line) => line.length).map((line) => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", "polyline");
    made.setAttribute("points", line.join(" "));
    return made;
  });
  byId("trend-chart").replaceChildren(...drawn);
  const bad = samples.length - good.length;
  put("trend-text", `${clock(from)} to ${clock(to)}: ${samples.length} samples${bad ? `, ${bad} bad` : ""}, ` +
    `least ${low} ${tag.unit}, greatest ${high} ${tag.unit}${complete ? "" : "; there are more"}`);
}

// -- writing --

byId("write-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  token = byId("write-token").value.trim() || token;
  const [tag, value] = [byId("write-tag").value, byId("write-value").value.trim()];
  const isList = byId("write-tag").selectedOptions[0]?.dataset.length; // it goes out as typed: [1, 2]
  if (!confirm(`Write ${tag} = ${value} ?`)) return;
  put("write-result", "writing …");
  const query = new URLSearchParams({ tag });
  try {
    const reply = await fetch(`api/write?${query}`, {
      method: "POST", body: isList ? value : asJson(value), headers: { ...headers(), "Content-Type": "application/json" },
    });
    const found = await reply.json();
    const done = found.acknowledged ? (found.verified ? "acknowledged and read back" : "acknowledged") : "sent to all, which no device acknowledges";
    put("write-result", reply.ok ? `${tag} = ${Array.isArray(found.value) ? `[${found.value.join(", ")}]` : found.value}: ${done}` : `${tag}: ${found.error}${found.reason ? `: ${found.reason}` : ""}`);
  } catch {
    put("write-result", `${tag}: the connection ended; it is not known whether the value was written`);
  }
});

// A number or true and false go out as they are typed: a number of JavaScript would round them.
function asJson(text) {
  return /^(true|false|-?\d+(\.\d+)?([eE][+-]?\d+)?)$/.test(text) ? text : JSON.stringify(text);
}

byId("token-form").addEventListener("submit", (event) => {
  event.preventDefault();
  token = byId("token").value.trim();
  byId("login").hidden = true;
  show();
});

// -- the wire --

function takeWire({ missed, exchanges }) {
  for (const [number, begun, took, device, kind, what, result, failed] of exchanges) {
    known.exchanges.push({ number, begun, took, device, kind, what, result, failed });
  }
  known.missed = missed;
  const oldest = exchanges.at(-1)[1] - WINDOW - 2000;
  known.exchanges = known.exchanges.filter((one) => one.begun >= oldest).slice(-5000);
  showExchanges();
}

function showExchanges() {
  const last = known.exchanges.slice(-15).reverse();
  byId("exchanges").replaceChildren(...last.map((one) => {
    const row = element("tr");
    row.append(
      element("td", new Date(one.begun).toISOString().slice(11, 23)), element("td", one.device), element("td", one.what),
      element("td", `${(one.took * 1000).toFixed(0)} ms`, "number"), element("td", one.failed ? `failed: ${one.result}` : one.result, one.failed ? "bad" : ""),
    );
    return row;
  }));
}

function drawWire() {
  byId("wire-section").hidden = !choice.line;
  if (!choice.line) return;
  put("wire-title", `The wire of ${choice.line}, the last 10 seconds`);
  const canvas = byId("wire");
  const shown = known.exchanges.filter((one) => one.begun + one.took * 1000 > serverTime - WINDOW);
  const of = (device) => shown.filter((one) => one.device === device);
  const names = [...known.devices].filter(([, [line]]) => line === choice.line).map(([name]) => name);
  const devices = names.length > 24 ? names.filter((name) => of(name).length).slice(0, 24) : names;
  const failed = shown.filter((one) => one.failed).length;
  const busy = shown.reduce((sum, one) => sum + one.took, 0);
  put("wire-sum", `${shown.length} exchanges, ${failed} failed, in use ${Math.min(100, Math.round((100 * busy * 1000) / WINDOW))} % of the time` +
    `${known.missed ? `; ${known.missed} are not shown` : ""}. ${devices.map((name) => `${name}: ${of(name).length}`).join(", ")}`);
  canvas.setAttribute("aria-label", `strip chart of ${choice.line}`);
  const [width, row, left] = [canvas.clientWidth, 22, Math.min(140, canvas.clientWidth / 4)];
  const height = row * Math.max(1, devices.length) + 20;
  const scale = devicePixelRatio;
  if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
    canvas.width = Math.round(width * scale);
    canvas.height = Math.round(height * scale);
    canvas.style.height = `${height}px`;
  }
  const pen = canvas.getContext("2d");
  const style = getComputedStyle(document.documentElement);
  const color = (name) => style.getPropertyValue(`--${name}`);
  pen.setTransform(scale, 0, 0, scale, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.font = "13px system-ui, sans-serif";
  const x = (time) => left + ((width - left) * (time - serverTime + WINDOW)) / WINDOW;
  for (let second = 0; second <= 10; second += 2) {
    const at = x(serverTime - WINDOW + second * 1000);
    pen.fillStyle = color("edge");
    pen.fillRect(at, 0, 1, height - 18);
    pen.fillStyle = color("soft");
    pen.textAlign = second === 10 ? "right" : "center";
    pen.fillText(second === 10 ? "now" : `${second - 10} s`, at, height - 4);
  }
  devices.forEach((name, number) => {
    const top = number * row;
    pen.fillStyle = color("ink");
    pen.textAlign = "left";
    pen.fillText(name, 0, top + 15, left - 8);
    for (const one of of(name)) {
      const from = Math.max(left, x(one.begun));
      const wide = Math.max(2, x(one.begun + one.took * 1000) - from);
      pen.fillStyle = color(one.failed ? "bad" : { read: "read", write: "write", probe: "probe" }[one.kind] ?? "wait");
      pen.fillRect(from, top + (one.failed ? 2 : 6), wide, one.failed ? 18 : 10);
      if (one.failed) pen.fillText("×", Math.min(from + wide + 1, width - 9), top + 12);
    }
  });
}

// -- begin --

byId("skip").addEventListener("click", () => byId("find").focus());

function show() {
  choice = readHash();
  setLive(false);
  showLines();
  showDevices();
  drawWire();
  showTags();
  follow();
}

addEventListener("hashchange", show);
show();
