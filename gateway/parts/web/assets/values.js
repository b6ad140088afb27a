// Tags with their last values: how they are written, how old they are, their sparklines.

import { h, svg, put, style, span } from "./dom.js";
import { said, t } from "./language.js";
import { now } from "./stream.js";

const TRAIL = 15 * 60e3; // ms of a sparkline
const POINTS = 300; // of a sparkline
const LONGEST_LIST = 120; // characters of an array that are shown
const LONGEST_UNIT = 24; // characters

const known = new Map();

// Returns the tag of a key: `meta` as the JSON API has it, `last`, `trail` of [ms, number or null].
export function tagOf(key) {
  if (!known.has(key)) known.set(key, { key, meta: null, last: null, trail: [], current: false });
  return known.get(key);
}

// A unit is shown with its end cut off, so that it cannot hide the values beside it.
export const unitOf = ({ unit }) => (unit.length > LONGEST_UNIT ? `${unit.slice(0, LONGEST_UNIT)}…` : unit);

export function describe(meta) {
  const tag = tagOf(meta.tag);
  tag.meta = { ...meta, unit: unitOf(meta) };
  tag.decimals = decimals(meta);
  return tag;
}

function fraction(number) {
  const [, part = ""] = String(number ?? 0).split(".");
  return /e-/.test(String(number)) ? 9 : part.length;
}

function decimals(meta) {
  if (meta.decimals !== null && meta.decimals !== undefined) return meta.decimals;
  if (/^(float|string|bool)/.test(meta.raw_type ?? meta.type) || meta.from || meta.computed) return null;
  const found = Math.max(fraction(meta.scale ?? 1), fraction(meta.offset));
  return found > 6 ? null : found;
}

// A number has the same decimals always, so that a column does not jump.
export function written(tag, text) {
  const { meta } = tag;
  if (text === "true") return t("on");
  if (text === "false") return t("off");
  if (text.startsWith("[") && meta?.length) {
    const list = text.replaceAll(",", ", ");
    return list.length > LONGEST_LIST ? `${list.slice(0, list.lastIndexOf(",", LONGEST_LIST) + 1)} …` : list;
  }
  if (!/^-?\d/.test(text) || /^string/.test(meta?.type ?? "")) return text;
  const number = Number(text);
  const places = tag.decimals ?? null;
  if (places === 0 && /^-?\d+$/.test(text)) return text; // an integer may be larger than a number of JavaScript
  if (places !== null) return number.toFixed(places).replace(/^-(0(\.0*)?)$/, "$1");
  if (number !== 0 && Math.abs(number) < 0.01) return number.toPrecision(3);
  return Math.abs(number) < 1e15 ? number.toFixed(Math.abs(number) < 1000 ? 2 : 1) : text;
}

// The value as [text, unit, tooltip]; the tooltip has every digit, and the bits of an integer.
export function shown(tag) {
  const { last, meta } = tag;
  if (!last) return ["", "", ""];
  if (last.quality === "bad") return ["–", "", ""];
  const hex = /^-?\d+$/.test(last.text) && !/^string/.test(meta?.type ?? "") ? `${last.text} = 0x${BigInt(last.text).toString(16)}` : last.text;
  return [last.name ?? written(tag, last.text), last.name ? "" : (meta?.unit ?? ""), last.name ? `${last.name} (${last.text})` : hex];
}

// The code of the reason and its sentence, or where the value is from.
export const reasons = (why) => why.replace(/^(\S+) ?(.*?)( simulated| replayed| computed)?$/s, (_, code, rest, origin = "") => `${said(code)} ${said(rest)} ${said(origin.trim())}`).trim();

// `short`: without the sentence after the code.
const quality = ({ last }, short) => (!last ? "" : last.good ? reasons(last.why) || t("good") : `${said(last.quality)}: ${reasons(short ? last.why.split(" ")[0] : last.why).split(/: |：/)[0]}`);

export const age = ({ last }) => (last && now() ? span(Math.max(0, (now() - last.time) / 1000)) : "");

export const title = ({ meta }) =>
  meta ? [meta.tag, meta.description, t("{type} at {address}", meta), t("read every {span}", { span: span(meta.every) })].filter(Boolean).join("\n") : "";

// `last`: text ("" if there is no value), quality, time, why, name.
export function take(tag, last) {
  last.good = last.quality === "good";
  tag.last = last;
  tag.current = true;
  const number = !last.good ? null : last.text === "true" ? 1 : last.text === "false" ? 0 : Number(last.text);
  if (Number.isNaN(number)) return;
  const end = tag.trail.at(-1);
  if (!end || last.time > end[0]) tag.trail.push([last.time, number]);
  while (tag.trail.length > POINTS || tag.trail[0]?.[0] < last.time - TRAIL) tag.trail.shift();
}

export function takeSample(found) {
  const tag = describe(found);
  const why = [found.reason, found.detail, found.origin, found.limited && `limited ${found.limited}`].filter(Boolean).join(" ");
  const text = found.value === null ? "" : typeof found.value === "string" ? found.value : JSON.stringify(found.value);
  take(tag, { text, quality: found.quality, time: Date.parse(found.time), why, name: found.text ?? null });
  return tag;
}

export function notCurrent() {
  for (const tag of known.values()) tag.current = false;
}

const LEVELS = { high_high: "▲▲", high: "▲", low: "▼", low_low: "▼▼", on: t("alarm when on"), off: t("alarm when off") };

export function limits({ meta }) {
  if (!meta?.alarm) return "";
  return Object.entries(meta.alarm).map(([level, limit]) => (/^o/.test(level) ? LEVELS[level] : `${LEVELS[level]} ${limit}`)).join("  ");
}

// -- sparklines --

const [WIDTH, HEIGHT] = [300, 44];

export function sparkline() {
  const chart = svg("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, preserveAspectRatio: "none", class: "spark", "aria-hidden": "true" });
  chart.append(svg("path", { class: "limit" }), svg("path", { class: "trail" }));
  return chart;
}

export function drawSpark(chart, { trail, meta }) {
  const numbers = trail.map(([, number]) => number).filter((number) => number !== null);
  let [low, high] = [Math.min(...numbers), Math.max(...numbers)];
  if (low === high) [low, high] = [low - 1, high + 1];
  const until = now() || trail.at(-1)?.[0];
  const from = Math.min(until - 60e3, trail[0]?.[0] ?? until);
  const x = (time) => ((WIDTH * (time - from)) / (until - from)).toFixed(1);
  const y = (number) => (HEIGHT - 3 - ((HEIGHT - 6) * (number - low)) / (high - low)).toFixed(1);
  let path = "";
  let before = null;
  for (const [time, number] of trail) {
    if (number !== null) path += before === null ? `M${x(time)} ${y(number)}` : `H${x(time)}V${y(number)}`;
    else if (before !== null) path += `H${x(time)}`;
    before = number;
  }
  if (before !== null) path += `H${WIDTH}`;
  chart.lastChild.setAttribute("d", numbers.length ? path : "");
  const lines = Object.values(meta?.alarm ?? {}).filter((limit) => typeof limit === "number" && limit >= low && limit <= high);
  chart.firstChild.setAttribute("d", meta?.type === "bool" ? "" : lines.map((limit) => `M0 ${y(limit)}H${WIDTH}`).join(""));
}

// -- the parts of a value that tiles and rows share --

export function valueParts() {
  const parts = { number: h("b"), unit: h("span", { className: "unit" }), quality: h("span", { className: "quality" }), age: h("span", { className: "age" }) };
  parts.value = h("span", { className: "value" }, parts.number, " ", parts.unit);
  return parts;
}

// `live`: false when the value may be old. `short`: where a sentence has no room.
export function showParts(parts, tag, live, short = false) {
  const [text, unit, tip] = shown(tag);
  put(parts.number, text);
  put(parts.unit, unit);
  if (parts.value.title !== tip) parts.value.title = tip;
  const good = tag.last?.good;
  parts.quality.title = good === false ? reasons(tag.last.why) : "";
  put(parts.quality, !tag.last ? "" : live ? quality(tag, short) : t("not live"));
  style(parts.quality, `quality ${!live || !tag.last ? "" : good ? "good" : "bad"}`);
  put(parts.age, age(tag));
}
