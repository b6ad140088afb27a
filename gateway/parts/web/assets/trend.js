// Trends: several tags, any span of the history, with axes, cursor, zoom, and bands where no value
// was valid. Drawn by uPlot, which is loaded when the first trend is opened.

import { byId, clock, go, h, keyed, place, put } from "./dom.js";
import { dates, said, t } from "./language.js";
import { api, gateway, now, on, onLive } from "./stream.js";
import { showParts, tagOf, takeSample, title, valueParts, written } from "./values.js";
import { writeButton } from "./writing.js";

const MOST = 8; // tags
const SPANS = [300, 3600, 28800, 86400, 604800, 2592000]; // s
const STEPS = [0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 28800, 86400]; // s of a bucket
const AXES = 2; // units with an axis of their own

let keys = [];
let spanOf = 3600; // s, up to now
let fixed = null; // [from, to] in s, of a zoom
let touched = null; // the same, while fingers move it
let chart = null;
let drawn = null; // what is drawn: { step, series }
let loading = 0; // its number
let due = 0;
let askedAt = 0;

const seconds = () => (now() || Date.now()) / 1000;
const range = () => touched ?? fixed ?? [seconds() - spanOf, seconds()];

let library = null;

function loaded() {
  library ??= new Promise((resolve, reject) => {
    document.head.append(h("link", { rel: "stylesheet", href: "uplot.css" }));
    document.head.append(h("script", { src: "uplot.js", onload: () => resolve(window.uPlot), onerror: reject }));
  });
  return library;
}

export function showTrend() {
  const { choice } = place();
  const wanted = (choice.get("tags") ?? "").split(",").filter(Boolean).slice(0, MOST);
  spanOf = Number(choice.get("span")) || 3600;
  fixed = choice.get("from") && choice.get("to") ? [Number(choice.get("from")), Number(choice.get("to"))] : null;
  for (const button of byId("spans").children) button.setAttribute("aria-pressed", String(!fixed && Number(button.value) === spanOf));
  keys = wanted;
  showPens();
  load();
}

export function leaveTrend() {
  loading += 1;
  fingers.clear();
  touched = null;
  chart?.destroy();
  chart = null;
  drawn = null;
  keys = [];
}

function choose(change) {
  const known = { tags: keys.join(","), span: spanOf === 3600 ? "" : spanOf, from: fixed?.[0], to: fixed?.[1] };
  go("trend", { ...known, ...change }, true);
}

function zoom([from, to]) {
  const least = 2;
  if (to - from < least) [from, to] = [(from + to - least) / 2, (from + to + least) / 2];
  choose({ from: from.toFixed(1), to: to.toFixed(1) });
}

function move(by, factor = 1) {
  const [from, to] = range();
  const [middle, half] = [(from + to) / 2 + by * (to - from), ((to - from) * factor) / 2];
  if (by < 0) zoom([middle - half, middle + half]);
  else settle([middle - half, middle + half]);
}

// A range that reaches now goes on with it.
function settle([from, to]) {
  if (to < seconds()) zoom([from, to]);
  else choose({ span: Math.max(2, Math.round(to - from)), from: "", to: "" });
}

byId("spans").append(...SPANS.map((value) =>
  h("button", { type: "button", value, onclick: () => choose({ span: value, from: "", to: "" }) }, length(value))));
const MOVES = { earlier: [-0.5], later: [0.5], closer: [0, 0.5], wider: [0, 2] };
for (const [id, how] of Object.entries(MOVES)) byId(id).addEventListener("click", () => move(...how));
byId("chart").addEventListener("keydown", (event) => {
  const how = { ArrowLeft: MOVES.earlier, ArrowRight: MOVES.later, "+": MOVES.closer, "-": MOVES.wider }[event.key];
  if (!how) return;
  event.preventDefault();
  move(...how);
});

// -- touch: one finger moves the curve, two zoom it --

const LONGEST = 3.2e8; // s: ten years
const fingers = new Map(); // by number: [x at the beginning, x now], in px
let held = null; // the range at the beginning

function grip() {
  held = touched ?? range();
  for (const finger of fingers.values()) finger[0] = finger[1];
}

// The times that were under the fingers stay under them.
function pull() {
  const { left, width } = chart.over.getBoundingClientRect();
  const time = (x) => held[0] + ((x - left) / width) * (held[1] - held[0]);
  const [[was, is], [was2, is2] = []] = [...fingers.values()];
  const scale = was2 === undefined ? (held[1] - held[0]) / width : (time(was2) - time(was)) / (is2 - is);
  if (!(scale > 2 / width && scale < LONGEST / width)) return;
  const from = time(was) - (is - left) * scale;
  touched = [from, from + width * scale];
  chart.setScale("x", { min: touched[0], max: touched[1] });
}

byId("chart").addEventListener("pointerdown", (event) => {
  if (event.pointerType !== "touch" || !chart || fingers.size === 2) return;
  fingers.set(event.pointerId, [event.clientX, event.clientX]);
  grip();
});
byId("chart").addEventListener("pointermove", (event) => {
  const finger = fingers.get(event.pointerId);
  if (!finger || !chart) return;
  finger[1] = event.clientX;
  pull();
});
for (const kind of ["pointerup", "pointercancel"]) byId("chart").addEventListener(kind, (event) => {
  if (!fingers.delete(event.pointerId)) return;
  if (fingers.size) return grip();
  const ends = touched;
  touched = null;
  if (ends) settle(ends);
});

// -- the chosen tags --

byId("add").addEventListener("input", async () => {
  const find = byId("add").value;
  const reply = await api("tags", { find, limit: 20 }).catch(() => null);
  if (!reply?.ok || find !== byId("add").value) return;
  const numbers = reply.found.tags.filter((one) => !one.length && one.type !== "string");
  byId("known-tags").replaceChildren(...numbers.map((one) => h("option", { value: one.tag, label: one.description })));
});
byId("add-form").addEventListener("submit", (event) => {
  event.preventDefault();
  const key = byId("add").value.trim();
  byId("add").value = "";
  if (key && !keys.includes(key)) choose({ tags: [...keys, key].slice(-MOST).join(",") });
});

function showPens() {
  keyed(byId("pens"), keys, (key) => key, (key) => {
    const pen = h("li", { className: "pen" });
    pen.parts = valueParts();
    pen.about = h("span", { className: "about" });
    pen.at = h("span", { className: "at" });
    pen.actions = h("span", { className: "actions" });
    pen.append(h("i", {}), h("span", { className: "name" }, h("b", {}, key), pen.about), pen.parts.value, pen.parts.quality, pen.at, pen.actions);
    return pen;
  }, (pen, key) => {
    const tag = tagOf(key);
    pen.firstChild.style.background = `var(--pen${keys.indexOf(key)})`;
    showParts(pen.parts, tag, gateway.live && performance.now() - (tag.asked ?? -1e9) < 4000);
    if (!tag.meta || pen.actions.childElementCount) return;
    put(pen.about, tag.meta.description);
    pen.title = title(tag);
    if (tag.meta.write) pen.actions.append(writeButton(key));
    pen.actions.append(h("button", { type: "button", className: "quiet", "aria-label": t("remove {key}", { key }), onclick: () => choose({ tags: keys.filter((one) => one !== key).join(",") }) }, "✕"));
  });
}

async function askValues() {
  if (!keys.length) return;
  const at = performance.now();
  const reply = await api("tags", { tags: keys.join(","), limit: MOST }).catch(() => null);
  if (!reply?.ok) return;
  for (const found of reply.found.tags) takeSample(found).asked = at;
  showPens();
}

// -- reading --

async function load() {
  const mine = (loading += 1);
  due = performance.now() + 1e9;
  if (!keys.length) {
    chart?.destroy();
    chart = null;
    byId("chart").replaceChildren();
    return put("trend-text", t("No tag is chosen: add one above, or choose Trend at a tag."));
  }
  if (!drawn) put("trend-text", t("reading …"));
  const uPlot = await loaded().catch(() => null);
  if (mine !== loading) return;
  if (!uPlot) return put("trend-text", t("The chart could not be loaded."));
  await askValues();
  const [from, to] = range();
  const points = Math.max(100, byId("chart").clientWidth / 2);
  const step = STEPS.find((one) => (to - from) / one <= points) ?? Math.ceil((to - from) / points / 86400) * 86400;
  const [first, end] = [Math.floor(from / step) * step, to];
  const series = await Promise.all(keys.map((key) => past(tagOf(key), first, end, step)));
  if (mine !== loading) return;
  drawn = { step, first, end, series };
  draw(uPlot);
  due = performance.now() + Math.max(1000, Math.min(step * 1000, 30000));
}

const utc = (time) => new Date(time * 1000).toISOString();

// Returns the buckets of one tag by their time, and why there are none.
async function past(tag, from, to, step) {
  const key = tag.key;
  if (!tag.meta) return { tag, why: t("there is no tag {key}", tag), found: new Map() };
  if (!tag.meta.history) return { tag, why: t("no history is kept of {key}: only what this page has seen", tag), found: seen(tag, step) };
  const width = step < 1 ? `${step * 1000}ms` : `${step}s`;
  const reply = await api("history", { tag: key, time: `[${utc(from)}..${utc(to)}]`, bucket: width }).catch(() => null);
  if (!reply?.ok) return { tag, why: said(reply?.found.error) ?? t("no connection to the gateway"), found: new Map() };
  return { tag, found: new Map(reply.found.buckets.map((one) => [Math.round((Date.parse(one.time) / 1000) * 2), one])) };
}

function seen({ trail }, step) {
  const found = new Map();
  for (const [time, number] of trail) {
    const at = Math.floor(time / 1000 / step) * step;
    found.set(Math.round(at * 2), number === null ? { quality: "bad" } : { quality: "good", min: number, max: number, mean: number, last: number });
  }
  return found;
}

// -- drawing --

const number = (value) => (value === null || value === undefined ? null : Number(value));

function columns({ step, first, end, series }) {
  const times = [];
  for (let time = first; time <= end; time += step) times.push(time);
  const data = [times];
  for (const { tag, found } of series) {
    const isBit = tag.meta?.type === "bool" || Boolean(tag.meta?.enum);
    let before = null;
    const rows = times.map((time) => {
      const one = found.get(Math.round(time * 2));
      if (one) before = one;
      return one ?? (tag.meta?.history ? null : before); // a value stays until the next
    });
    data.push(rows.map((one) => number(isBit ? one?.last : one?.mean)), rows.map((one) => number(isBit ? null : one?.min)), rows.map((one) => number(isBit ? null : one?.max)));
  }
  return data;
}

function draw(uPlot) {
  const data = columns(drawn);
  const { series } = drawn;
  const box = byId("chart");
  const theme = getComputedStyle(document.documentElement);
  const color = (name) => theme.getPropertyValue(`--${name}`).trim();
  const scaleOf = ({ tag }) => (tag.meta?.type === "bool" ? "bit" : `u ${tag.meta?.unit ?? ""}`);
  const scales = [...new Set(series.map(scaleOf))];
  const size = { width: box.clientWidth, height: box.clientHeight };
  const signature = JSON.stringify([keys, scales, color("ink")]);
  const [from, to] = range();
  if (chart?.signature === signature) {
    chart.setSize(size);
    chart.setData(data, false);
    chart.setScale("x", { min: from, max: to });
    return caption();
  }
  chart?.destroy();
  box.replaceChildren();
  const line = { stroke: color("soft"), grid: { stroke: color("edge"), width: 1 }, ticks: { stroke: color("edge"), width: 1 }, font: `13px ${theme.fontFamily || "system-ui"}` };
  const many = series.length > 1;
  const narrow = size.width < 600;
  const options = {
    ...size,
    legend: { show: false },
    cursor: { drag: { x: true, y: false, setScale: false }, points: { size: 8 }, bind: { dblclick: () => () => choose({ from: "", to: "" }) } },
    scales: { x: { time: true }, ...Object.fromEntries(scales.map((name) => [name, name === "bit" ? { range: [-0.1, 1.1] } : {}])) },
    axes: [
      { ...line, space: narrow ? 44 : 80, values: (_, splits, axis, space, step) => times(splits, step) },
      ...scales.map((name, at) => ({
        ...line, scale: name, side: at ? 1 : 3, show: at < AXES, grid: { ...line.grid, show: at === 0 },
        size: narrow ? 46 : 64, ...(!narrow && name !== "bit" && { label: name.slice(2), labelSize: 22, labelFont: line.font }),
        ...(name === "bit" && { splits: () => [0, 1], values: () => [t("off"), t("on")] }),
      })),
    ],
    series: [{}, ...series.flatMap((one, at) => {
      const stroke = color(`pen${at}`);
      const isStep = one.tag.meta?.type === "bool" || Boolean(one.tag.meta?.enum) || !one.tag.meta?.history;
      const scale = scaleOf(one);
      const edge = { scale, stroke: "transparent", width: 0, points: { show: false } };
      return [{ scale, stroke, width: 2, points: { show: false }, ...(isStep && { paths: uPlot.paths.stepped({ align: 1 }) }) }, edge, edge];
    })],
    bands: series.map((_, at) => ({ series: [at * 3 + 3, at * 3 + 2], fill: `${color(`pen${at}`)}40` })),
    hooks: {
      drawClear: [(plot) => bands(plot, color, many)],
      draw: [(plot) => !many && limitLines(plot, series[0], color)],
      setCursor: [cursor],
      setSelect: [(plot) => {
        if (plot.select.width < 4) return;
        const ends = [plot.posToVal(plot.select.left, "x"), plot.posToVal(plot.select.left + plot.select.width, "x")];
        plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
        zoom(ends);
      }],
    },
  };
  chart = new uPlot(options, data, box);
  chart.signature = signature;
  chart.setScale("x", { min: from, max: to });
  caption();
}

// Time without a valid value is tinted; beside several tags each has a strip of its colour.
function bands(plot, color, many) {
  const { ctx: pen, bbox } = plot;
  const { step, first, end, series } = drawn;
  const strip = 7 * devicePixelRatio;
  const x = (time) => Math.min(bbox.left + bbox.width, Math.max(bbox.left, plot.valToPos(time, "x", true)));
  const recorded = series.filter(({ tag }) => tag.meta?.history);
  const kinds = (one, time) => kindOf(one.found.get(Math.round(time * 2)), time + step > end);
  // Runs of the same kind: `fill` is called with each.
  const runs = (kindAt, fill) => {
    let [kind, since, time] = ["", first, first];
    for (; time <= end; time += step) {
      const next = kindAt(time);
      if (next === kind) continue;
      if (kind && x(time) > x(since)) fill(kind, x(since), x(time) - x(since));
      [kind, since] = [next, time];
    }
    if (kind && x(time) > x(since)) fill(kind, x(since), x(time) - x(since));
  };
  const worst = (time) => {
    const found = recorded.map((one) => kinds(one, time));
    return ["gap-bad", "partial"].find((kind) => found.includes(kind)) ?? (found.length && found.every((kind) => kind === "gap") ? "gap" : "");
  };
  runs(worst, (kind, from, wide) => {
    pen.fillStyle = color(kind);
    pen.fillRect(from, bbox.top, wide, bbox.height);
  });
  if (!many) return;
  recorded.forEach((one, at) => runs((time) => kinds(one, time).replace(/^gap$/, ""), (_, from, wide) => {
    pen.fillStyle = color(`pen${series.indexOf(one)}`);
    pen.fillRect(from, bbox.top + bbox.height - strip * (at + 1), wide, strip - 1);
  }));
}

function kindOf(one, isLast) {
  if (!one) return isLast ? "" : "gap";
  if (one.quality === "good") return "";
  if (one.reason === "not-recorded") return "gap";
  return one.quality === "partial" ? "partial" : "gap-bad";
}

function limitLines(plot, { tag }, color) {
  const { ctx: pen, bbox } = plot;
  pen.save();
  pen.strokeStyle = pen.fillStyle = color("bad");
  pen.lineWidth = devicePixelRatio;
  pen.setLineDash([6 * devicePixelRatio, 4 * devicePixelRatio]);
  for (const limit of Object.values(tag.meta?.alarm ?? {})) {
    if (typeof limit !== "number" || tag.meta.type === "bool") continue;
    const y = plot.valToPos(limit, plot.series[1].scale, true);
    if (y < bbox.top || y > bbox.top + bbox.height) continue;
    pen.beginPath();
    pen.moveTo(bbox.left, y);
    pen.lineTo(bbox.left + bbox.width, y);
    pen.stroke();
  }
  pen.restore();
}

const two = (value) => String(value).padStart(2, "0");

function times(splits, step) {
  let day = "";
  return splits.map((time) => {
    const at = new Date(time * 1000);
    const date = `${at.getFullYear()}-${two(at.getMonth() + 1)}-${two(at.getDate())}`;
    const hour = `${two(at.getHours())}:${two(at.getMinutes())}${step < 60 ? `:${two(at.getSeconds())}` : ""}`;
    const text = step >= 86400 ? date.slice(5) : date === day ? hour : `${hour}\n${date.slice(5)}`;
    day = date;
    return text;
  });
}

function cursor(plot) {
  const { idx } = plot.cursor;
  const pens = byId("pens").known;
  for (const { tag, found } of drawn.series) {
    const pen = pens?.get(tag.key);
    if (!pen) continue;
    const one = idx === null || idx === undefined ? null : found.get(Math.round(plot.data[0][idx] * 2));
    put(pen.at, idx === null || idx === undefined ? "" : t("at the cursor: {value}", { value: told(tag, one) }));
  }
  caption(idx);
}

function told(tag, one) {
  if (!one || one.quality === "bad" || one.last === null) return `${t("no value")}${one?.reason ? `: ${said(one.reason)}` : ""}`;
  const text = (value) => (tag.meta.enum?.[value] ?? written(tag, String(value)));
  if (typeof one.last !== "number" || tag.meta.enum || one.min === one.max) return text(one.last);
  return t("{mean}, from {min} to {max}", { mean: text(one.mean), min: text(one.min), max: text(one.max) });
}

function caption(idx = null) {
  if (idx !== null && idx !== undefined) return put("trend-text", `${new Date(chart.data[0][idx] * 1000).toLocaleString(dates, { hour12: false })}, ${length(drawn.step)}`);
  const why = drawn.series.map((one) => one.why).filter(Boolean);
  const [from, to] = range();
  const at = (time) => (to - from > 86400 ? new Date(time * 1000).toLocaleString(dates, { hour12: false }) : clock(time * 1000));
  put("trend-text", [`${t("{from} to {to}", { from: at(from), to: at(to) })}${fixed ? "" : ` ${t("(now)")}`}${t(", ")}${t("each point {span}", { span: length(drawn.step) })}`, ...why].join("; "));
}

function length(step) {
  if (step < 60) return t("{n} s", { n: step });
  if (step < 3600) return t("{n} min", { n: step / 60 });
  return step < 86400 ? t("{n} h", { n: step / 3600 }) : t("{n} d", { n: step / 86400 });
}

const open = () => !byId("view-trend").hidden;
on("tick", () => {
  if (!open() || document.hidden) return;
  if (performance.now() > askedAt + 1000) {
    askedAt = performance.now();
    askValues();
  }
  if (!fixed && performance.now() > due) load();
});
onLive(() => open() && showPens());
new ResizeObserver(() => chart && chart.setSize({ width: byId("chart").clientWidth, height: byId("chart").clientHeight })).observe(byId("chart"));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => chart && load());
