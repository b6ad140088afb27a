// All tags in a list of which only the rows in sight exist, and the one search over tags and devices.

import { byId, go, h, keyed, place, put, style } from "./dom.js";
import { said, several, t } from "./language.js";
import { api, gateway, on, onLive } from "./stream.js";
import { limits, showParts, tagOf, takeSample, title, valueParts } from "./values.js";
import { alarmsOf } from "./alarms.js";
import { devices } from "./lines.js";
import { isPinned, pin } from "./overview.js";
import { isEdited, writeButton } from "./writing.js";

const EVERY = 1000; // ms between two requests for the rows in sight
const OLD = 4000; // ms until rows without an answer are old
const BEYOND = 8; // rows above and below those in sight
const CHIPS = 12; // devices

let question = { find: "", device: "" };
let keys = []; // by place, as far as they were in sight
let total = 0;
let asking = null; // the request in flight
let begun = 0; // performance.now() at the beginning of the last request that was answered
let due = 0;

const view = byId("window");
const space = byId("space");
const inView = () => !byId("view-tags").hidden;
const theme = getComputedStyle(document.documentElement);
const rowHeight = () => Math.round(parseFloat(theme.getPropertyValue("--row")) * parseFloat(theme.fontSize)) || 56;

export function showTags() {
  const { choice } = place();
  const next = { find: choice.get("find") ?? "", device: choice.get("device") ?? "" };
  if (byId("find").value !== next.find && document.activeElement !== byId("find")) byId("find").value = next.find;
  if (next.find !== question.find || next.device !== question.device || !total) {
    question = next;
    keys = [];
    begun = 0;
    view.scrollTop = 0;
  }
  showChips();
  draw();
  ask();
}

// -- the search --

byId("find").addEventListener("input", () => {
  const find = byId("find").value;
  go("tags", { find, device: find ? "" : question.device }, place().view === "tags");
});
byId("search").addEventListener("submit", (event) => {
  event.preventDefault();
  if (place().view !== "tags") go("tags", { find: byId("find").value });
  view.focus();
});

function showChips() {
  const words = question.find.toLowerCase().split(/\s+/).filter(Boolean);
  const found = [...devices].filter(([name, [line]]) => question.device ? name === question.device : words.length && words.every((word) => `${line} ${name}`.toLowerCase().includes(word)));
  keyed(byId("found-devices"), found.slice(0, CHIPS), ([name]) => `${name} ${question.device}`, ([name, [line]]) => {
    const chip = h("li");
    const chosen = question.device === name;
    chip.link = h("a", { href: chosen ? "#tags" : `#tags?device=${encodeURIComponent(name)}` });
    chip.state = h("span");
    chip.link.append(h("b", {}, name), ` ${t("on {line}", { line })} `, chip.state, chosen ? " ✕" : "");
    if (chosen) chip.link.setAttribute("aria-label", t("show all tags, not only those of {name}", { name }));
    chip.why = h("span", { className: "why" });
    chip.append(chip.link, chip.why);
    return chip;
  }, (chip, [, [, state, why]]) => {
    put(chip.state, said(state));
    style(chip.state, state);
    put(chip.why, question.device ? said(why) : "");
  });
  if (found.length > CHIPS) byId("found-devices").append(h("li", { className: "soft" }, t("and {n} more devices", { n: found.length - CHIPS })));
}

on("state", () => inView() && showChips());

// -- the rows in sight --

function inSight() {
  const height = rowHeight();
  const first = Math.max(0, Math.floor(view.scrollTop / height) - BEYOND);
  return [first, Math.min(total, Math.ceil((view.scrollTop + view.clientHeight) / height) + BEYOND)];
}

async function ask() {
  asking?.abort();
  const mine = (asking = new AbortController());
  due = performance.now() + EVERY;
  const asked = question;
  const at = performance.now();
  const [first, end] = total ? inSight() : [0, Math.ceil(view.clientHeight / rowHeight()) + BEYOND];
  const query = { skip: first, limit: Math.min(1000, Math.max(end - first, 20)), ...(asked.find && { find: asked.find }), ...(asked.device && { device: asked.device }) };
  const reply = await api("tags", query, { signal: mine.signal }).catch(() => null);
  if (mine !== asking) return;
  asking = null;
  if (!reply || asked !== question) return;
  if (!reply.ok) return put("tags-title", said(reply.found.error));
  begun = at;
  total = reply.found.total;
  reply.found.tags.forEach((found, number) => (keys[first + number] = takeSample(found).key));
  put("tags-title", [several(total, "{n} tag", "{n} tags"), asked.device && t("of {device}", asked), asked.find && t("with “{find}”", asked)].filter(Boolean).join(" "));
  draw();
}

const isLive = () => gateway.live && performance.now() - begun < OLD;

function draw() {
  if (!inView()) return;
  const height = rowHeight();
  space.style.height = `${total * height}px`;
  space.style.setProperty("--height", `${height}px`);
  const [first, end] = inSight();
  const places = Array.from({ length: Math.max(0, end - first) }, (_, number) => first + number);
  byId("list").setAttribute("aria-rowcount", total + 1);
  const focused = space.contains(document.activeElement);
  keyed(space, places, (number) => `${number} ${keys[number] ?? ""}`, makeRow, (row, number) => {
    row.style.transform = `translateY(${number * height}px)`;
    showRow(row);
  });
  if (focused && !space.contains(document.activeElement)) view.focus({ preventScroll: true }); // its row scrolled away
}

function makeRow(number) {
  const key = keys[number];
  const row = h("div", { className: "row", role: "row", "aria-rowindex": number + 2 });
  if (!key) return row;
  row.tag = key;
  const { meta } = tagOf(key);
  const [device, ...rest] = key.split("/");
  row.parts = valueParts();
  row.limits = h("span", { className: "limits" }, limits(tagOf(key)));
  row.parts.value.setAttribute("role", "cell");
  row.star = h("button", { type: "button", className: "quiet", onclick: () => (pin(key), showRow(row)) });
  row.append(
    h("span", { className: "name", role: "rowheader", title: title({ meta }) }, h("a", { href: `#tags?device=${encodeURIComponent(device)}`, className: "device-of" }, `${device}/`), h("b", {}, rest.join("/")), " ", h("span", { className: "about" }, meta.description)),
    row.parts.value,
    h("span", { role: "cell", className: "state-of" }, row.parts.quality, " ", row.limits),
    row.parts.age,
    h("span", { role: "cell", className: "actions" },
      meta.write && writeButton(key),
      !meta.length && meta.type !== "string" && h("a", { className: "button quiet", href: `#trend?tags=${encodeURIComponent(key)}`, "aria-label": t("trend of {key}", { key }) }, t("Trend")),
      row.star));
  row.parts.age.setAttribute("role", "cell");
  return row;
}

function showRow(row) {
  if (!row.tag) return;
  const tag = tagOf(row.tag);
  const live = isLive();
  showParts(row.parts, tag, live);
  const pinned = isPinned(row.tag);
  put(row.star, pinned ? "★" : "☆");
  row.star.setAttribute("aria-pressed", String(pinned));
  if (!row.star.title) {
    row.star.title = t("On the overview");
    row.star.setAttribute("aria-label", t("{tag} on the overview", row));
  }
  const alarm = alarmsOf(row.tag);
  row.title = alarm?.why ?? "";
  style(row, `row ${alarm ? `in-alarm ${alarm.state}` : ""} ${tag.last && !tag.last.good ? "is-bad" : ""} ${live ? "" : "old"} ${isEdited(row) ? "editing" : ""}`);
}

let drawing = 0;
view.addEventListener("scroll", () => {
  cancelAnimationFrame(drawing);
  drawing = requestAnimationFrame(() => {
    draw();
    const [first, end] = inSight();
    if (!asking && Array.from({ length: end - first }, (_, number) => keys[first + number]).includes(undefined)) ask();
    else due = Math.min(due, performance.now() + 150);
  });
});
addEventListener("resize", draw);
onLive(draw);
on("tick", () => {
  if (!inView() || document.hidden) return;
  if (performance.now() >= due && (!asking || performance.now() >= due + OLD)) ask();
  draw();
});
