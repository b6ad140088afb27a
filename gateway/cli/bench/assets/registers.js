// Registers live, in every type side by side: choose the right number, name the row, add the tags.

import { byId, h, keyed, put, style } from "./dom.js";
import { said, t } from "./language.js";
import { call, step } from "./call.js";

const EVERY = 400; // ms
const chosen = new Map(); // by address: the title of the column
let columns = [];
let marked = null; // raw values by address, since the question what changes
let device = "";
let after = () => {};

export function startRegisters(changed) {
  after = changed;
  byId("look-form").addEventListener("submit", (event) => {
    event.preventDefault();
    step(byId("look"), "look-error", look);
  });
  byId("mark").addEventListener("click", () => {
    marked = marked ? null : new Map();
    byId("mark").setAttribute("aria-pressed", String(!!marked));
    byId("registers").classList.toggle("only", !!marked);
    for (const row of byId("registers").tBodies[0].rows) if (marked) marked.set(row.key, row.raw);
  });
  byId("tags-form").addEventListener("submit", (event) => {
    event.preventDefault();
    step(byId("add-tags"), "tags-error", add);
  });
  setInterval(read, EVERY);
}

// The devices of the draft; a new one is looked at by itself.
export function showDevices(devices) {
  const list = byId("device");
  const names = devices.map((one) => one.device).join("\n");
  if (list.names === names) return;
  list.names = names;
  const was = list.value;
  list.replaceChildren(...devices.map((one) => h("option", { value: one.device }, t("{device} ({protocol}, station {station})", one))));
  list.ranges = Object.fromEntries(devices.map((one) => [one.device, one.range]));
  if (devices.some((one) => one.device === was)) list.value = was;
  else byId("range").value = list.ranges[list.value] ?? "";
  list.onchange = () => {
    byId("range").value = list.ranges[list.value];
    byId("look-form").requestSubmit();
  };
}

async function look() {
  const wanted = byId("device").value;
  device = "";
  chosen.clear();
  marked = null;
  byId("mark").setAttribute("aria-pressed", "false");
  byId("registers").classList.remove("only");
  byId("registers").tBodies[0].replaceChildren();
  byId("registers").tBodies[0].known = undefined;
  await call("look", { device: wanted, range: byId("range").value });
  device = wanted;
}

async function read() {
  if (!device || document.hidden) return;
  try {
    show(await call("registers"));
  } catch (error) {
    put("look-error", error.message);
  }
}

function show(found) {
  if (found.device !== device) return;
  put("look-error", said(found.error) || (found.reads ? "" : t("The registers are no longer read: choose Read.")));
  const titles = found.columns.join();
  if (columns.join() !== titles || !byId("registers").tHead.rows.length) {
    columns = found.columns;
    byId("registers").tHead.replaceChildren(h("tr", {}, ...[t("address"), t("name"), ...columns].map((title) => h("th", {}, title))));
  }
  keyed(byId("registers").tBodies[0], found.rows, (row) => row.address, made, update);
  byId("tags-form").hidden = !found.rows.length;
}

function made(row) {
  const line = h("tr", {}, h("td", {}, row.address));
  line.known = h("span", { className: "known" });
  line.name = h("input", { className: "name", placeholder: t("name"), autocomplete: "off", spellcheck: false, "aria-label": t("name of {address}", row), onpaste: (event) => paste(event, line) });
  line.unit = h("input", { className: "unit", placeholder: t("unit"), autocomplete: "off", "aria-label": t("unit of {address}", row) });
  line.scale = h("input", { className: "scale", autocomplete: "off", inputMode: "decimal", placeholder: t("scale"), "aria-label": t("scale of {address}", row) });
  line.writes = h("input", { type: "checkbox", onchange: () => { line.least.hidden = line.most.hidden = !line.writes.checked; } });
  line.least = h("input", { type: "number", step: "any", placeholder: t("least"), hidden: true, "aria-label": t("least value of {address}", row) });
  line.most = h("input", { type: "number", step: "any", placeholder: t("greatest"), hidden: true, "aria-label": t("greatest value of {address}", row) });
  line.append(h("td", {}, line.name, line.known, h("span", { className: "more" }, line.unit, line.scale, h("label", {}, line.writes, ` ${t("may be written")}`), line.least, line.most)));
  line.cells_ = columns.map((title) => {
    const button = h("button", { type: "button", tabIndex: -1, "aria-pressed": "false", onclick: () => choose(line, row.address, title) });
    line.append(h("td", {}, button));
    return button;
  });
  return line;
}

function update(line, row) {
  line.raw = row.raw;
  row.cells.forEach((text, at) => {
    const button = line.cells_[at];
    put(button, text);
    style(button, text.endsWith("?") || text === "-" ? "doubtful" : "");
    button.setAttribute("aria-pressed", String(chosen.get(row.address) === columns[at]));
  });
  if (marked && !marked.has(row.address)) marked.set(row.address, row.raw);
  if (marked && marked.get(row.address) !== row.raw) line.moved = true;
  if (!marked) line.moved = false;
  style(line, `${row.changed ? "changed" : ""} ${line.moved ? "moved" : ""}`.trim());
  put(line.known, row.note);
  line.name.hidden = !!row.note;
}

function choose(line, address, title) {
  if (chosen.get(address) === title) chosen.delete(address);
  else chosen.set(address, title);
  line.cells_.forEach((button, at) => button.setAttribute("aria-pressed", String(chosen.get(address) === columns[at])));
  line.name.focus();
}

// A column of names from a spreadsheet fills the rows below.
function paste(event, line) {
  const names = event.clipboardData.getData("text").trim().split(/\r?\n/);
  if (names.length < 2) return;
  event.preventDefault();
  for (let row = line; row && names.length; row = row.nextElementSibling) if (!row.name.hidden) row.name.value = names.shift().split("\t")[0].trim();
}

function settings(line) {
  const found = { address: line.key };
  const title = chosen.get(line.key)?.split(" ") ?? [];
  const type = title.at(-1);
  if (/^(u?int|float)/.test(type ?? "")) found.type = type;
  if (title[0] === "low" || title[0] === "high") found.word_order = `${title[0]}_first`;
  const [unit, scale, every] = [line.unit.value.trim(), line.scale.value.trim(), byId("every").value.trim()];
  if (unit) found.unit = unit;
  if (scale) found.scale = Number(scale.replace(",", "."));
  if (every && every !== "1s") found.every = every;
  if (line.writes.checked) {
    const ends = { min: line.least.value, max: line.most.value };
    const limits = Object.entries(ends).filter(([, end]) => end !== "").map(([name, end]) => [name, Number(end)]);
    found.write = limits.length ? Object.fromEntries(limits) : true;
  }
  return found;
}

async function add() {
  const lines = [...byId("registers").tBodies[0].rows].filter((line) => !line.name.hidden && line.name.value.trim());
  if (!lines.length) throw new Error(t("Name a row first."));
  const names = lines.map((line) => line.name.value.trim());
  const twice = names.find((name, at) => names.indexOf(name) !== at);
  if (twice) throw new Error(t("{name} is there twice.", { name: twice }));
  await call("tags", { device, tags: Object.fromEntries(lines.map((line) => [line.name.value.trim(), settings(line)])) });
  for (const line of lines) line.name.value = "";
  after();
}
