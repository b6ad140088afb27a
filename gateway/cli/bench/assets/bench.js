// The bench: scan, look, name, import, see the change, apply it, keep it.

import { byId, h, keyed, put, style } from "./dom.js";
import { listed, said, t } from "./language.js";
import { call, enter, lost, step } from "./call.js";
import { showDevices, startRegisters } from "./registers.js";
import { showSheetDevices, startSheet } from "./sheet.js";

const EVERY = 500; // ms
const percent = (share) => `${(100 * share).toFixed(1)} %`;
let state = null;
let named = ""; // the stations whose names are asked for

const OPTIONS = ["port", "protocol", "stations", "baud", "format", "timeout"];

function scan(port) {
  const options = Object.fromEntries(OPTIONS.map((name) => [name, byId(name).value.trim()]));
  return step(byId("scan"), "scan-error", async () => {
    await call("scan", { ...options, port: port ?? options.port });
    await look();
  });
}

byId("scan-form").addEventListener("submit", (event) => {
  event.preventDefault();
  scan();
});
byId("simulate").addEventListener("click", () => {
  byId("port").value = "simulated";
  scan();
});
byId("scan-stop").addEventListener("click", () => call("scan/stop", {}));
byId("stations-form").addEventListener("submit", (event) => {
  event.preventDefault();
  step(event.submitter, "stations-error", async () => {
    const names = Object.fromEntries([...byId("found").children].filter((row) => row.use.checked).map((row) => [row.key, row.name.value.trim()]));
    await call("stations", { gateway: byId("gateway-name").value.trim(), line: byId("line-name").value.trim(), names });
    byId("stations-form").hidden = true;
    await look();
    const [first] = Object.values(names);
    for (const list of ["device", "sheet-device"]) byId(list).value = first;
    byId("device").onchange();
  });
});

for (const name of ["undo", "reread", "apply", "keep", "back"]) {
  byId(name).addEventListener("click", () => step(byId(name), "apply-error", async () => {
    await call(name, {});
    await look();
  }));
}

async function look() {
  state = await call("state");
  lost("");
  document.title = t("Bench: {file}", state);
  put("file", state.file.split("/").at(-1));
  byId("file").title = state.file;
  showGateway(state.gateway);
  showScan(state);
  showDraft(state);
  showTrial(state.left);
}

function showGateway({ state: runs, log }) {
  put("gateway", runs ? (runs === "own" ? t("gateway runs") : t("a gateway runs already")) : t("no gateway runs"));
  style(byId("gateway"), `pill ${runs ? "good" : "starting"}`);
  put("log", log.join("\n"));
  byId("values-card").hidden = !runs;
}

function options(list, names) {
  if (list.names === names.join()) return;
  list.names = names.join();
  list.replaceChildren(...names.map((value) => h("option", { value }, value)));
}

function showScan({ scan: found, ports, protocols, draft }) {
  options(byId("ports"), ports);
  options(byId("protocol"), protocols);
  byId("scanning").hidden = !found.runs;
  byId("share").value = found.share;
  put("what", found.runs ? t("asking {what}", { what: said(found.what) }) : "");
  put("scan-said", [found.error, ...found.noises].filter(Boolean).map(said).join("\n"));
  const key = found.runs || !found.found.length ? "" : `${found.port} ${found.found.map((one) => one.station)}`;
  if (key === named) return;
  named = key;
  byId("stations-form").hidden = !key;
  put("found-title", t("Found at {at}, {port}:", { ...found, at: said(found.at) }));
  byId("gateway-label").hidden = draft.exists || draft.devices.length > 0;
  keyed(byId("found"), found.found, (one) => one.station, station, () => {});
}

function station(one) {
  const row = h("li", {});
  row.use = h("input", { type: "checkbox", checked: true, "aria-label": t("use station {station}", one) });
  row.name = h("input", { value: `station-${one.station}`, autocomplete: "off", "aria-label": t("name of station {station}", one) });
  row.append(h("label", {}, row.use, ` ${t("station {station}", one)}`), row.name, one.refusal ? h("span", { className: "soft" }, t("error reply: {refusal}", one)) : "");
  return row;
}

function showDraft({ draft, settings, said: happened, left, gateway }) {
  put("size", said(draft.size) || t("no tags yet"));
  byId("registers-card").hidden = byId("sheet-card").hidden = !draft.devices.length;
  showDevices(draft.devices);
  showSheetDevices(draft.devices, settings);
  keyed(byId("loads"), draft.lines, (one) => one.line, () => h("li", {}, h("b"), h("span", { className: "up-to" }), h("b", { className: "load" }), h("span", { className: "advice bad" })), (row, one) => {
    const [name, before, load, advice] = row.children;
    put(name, one.line);
    const was = one.before ?? 0;
    put(before, Math.abs(was - one.load) > 0.0005 ? `${t("load of the wire")} ${percent(was)} →` : t("load of the wire"));
    put(load, percent(one.load));
    style(load, one.load > 1 ? "load bad" : "load");
    put(advice, said(one.advice));
  });
  keyed(byId("mistakes"), draft.mistakes, (one) => one, (one) => h("li", {}, one), () => {});
  const text = draft.difference.join("\n");
  if (byId("difference").shown !== text) {
    byId("difference").shown = text;
    byId("difference").replaceChildren(...draft.difference.map((line) => h("span", { className: { "+": "plus", "-": "minus" }[line[0]] ?? "soft" }, line)), draft.more ? h("span", {}, t("and {n} more lines", { n: draft.more })) : "");
  }
  put("said", said(happened) || (draft.changed || !draft.exists ? "" : t("The file has no change.")));
  put("apply", draft.changed || gateway.state ? t("Apply") : t("Run the gateway"));
  byId("apply").disabled = left !== null || draft.mistakes.length > 0 || !(draft.changed || (draft.exists && !gateway.state));
  byId("undo").disabled = !draft.steps;
}

function showTrial(left) {
  byId("trial").hidden = left === null;
  if (left === null) return;
  put("trial-text", left < 0 ? t("A change of this file was never kept.") : t("The gateway took the change over. It goes back in {n} s.", { n: Math.ceil(left) }));
}

// -- values --

async function values() {
  if (!state?.gateway.state || document.hidden) return;
  const found = await call("values");
  const good = found.filter((one) => one.quality === "good").length;
  put("good", t("{n} of {all} values are good", { n: good, all: found.length }));
  found.sort((one, other) => one.tag.localeCompare(other.tag, undefined, { numeric: true }));
  keyed(byId("values"), found, (one) => one.tag, row, (item, one) => {
    put(item.number, one.quality === "good" ? `${one.text ?? one.value} ${one.unit ?? ""}`.trim() : `${said("bad")}: ${said(one.reason)}`);
    style(item.number, one.quality === "good" ? "" : "bad");
    item.write.hidden = !one.write;
  });
}

function row(one) {
  const item = h("li", {}, h("span", {}, one.tag));
  item.number = h("b");
  item.write = h("button", { type: "button", className: "quiet", "aria-label": t("write {tag}", one), onclick: () => editor(item, one) }, t("Write"));
  item.append(item.number, item.write);
  return item;
}

function editor(item, { tag, unit, write, verify }) {
  if (item.querySelector("form")) return item.querySelector("form").remove();
  const input = h("input", { required: true, autocomplete: "off", "aria-label": t("new value of {tag}", { tag }) });
  const send = h("button", { type: "submit", className: "main" }, t("Write …"));
  const result = h("p", { className: "result", role: "alert" });
  const limits = listed([write.min !== null && t("at least {n}", { n: write.min }), write.max !== null && t("at most {n}", { n: write.max }), verify && t("read back")]);
  let armed = false;
  input.addEventListener("input", () => { armed = false; put(send, t("Write …")); });
  item.append(h("form", { onsubmit: (event) => {
    event.preventDefault();
    armed = !armed;
    if (armed) return put(send, t("Confirm: {value}", { value: `${input.value} ${unit ?? ""}`.trim() }));
    put(send, t("Write …"));
    return step(send, result, async () => {
      const done = await call("write", { tag, value: input.value.trim() });
      put(result, done.error ? t("Not done: {why}", { why: [done.error, done.reason].filter(Boolean).map(said).join(": ") }) : `${done.value}: ${done.verified ? t("acknowledged and read back") : t("acknowledged by the device")}`);
    });
  } }, input, unit ?? "", h("span", { className: "soft" }, limits), send, result));
  return input.focus();
}

async function forever(work, every) {
  for (;;) {
    try {
      await work();
    } catch {
      // `call` has said so
    }
    await new Promise((done) => setTimeout(done, every));
  }
}

if (await enter()) {
  startRegisters(look);
  startSheet(look);
  await look();
  if (state.draft.devices.length) byId("look-form").requestSubmit();
  forever(look, EVERY);
  forever(values, 2 * EVERY);
}
