// The overview: chosen tags as tiles, with their alarms, beside what is wrong.

import { byId, h, keyed, put, style } from "./dom.js";
import { t } from "./language.js";
import { api, follow, gateway, on, onLive } from "./stream.js";
import { describe, drawSpark, limits, notCurrent, showParts, sparkline, tagOf, take, title, valueParts } from "./values.js";
import { alarmsOf, onAlarms } from "./alarms.js";
import { writeButton } from "./writing.js";

const PAST = "[now(-15m)..]";
const STEP = "3s"; // of the past in a sparkline
const AT_ONCE = 2; // queries of the past
const PENS = 3; // of the first trend

let shown = []; // keys
let loads = 0; // under way
let pinned = JSON.parse(localStorage.getItem("overview") ?? "null"); // keys chosen on this page

export const isPinned = (key) => (pinned ?? shown).includes(key);

export function pin(key) {
  pinned = isPinned(key) ? (pinned ?? shown).filter((one) => one !== key) : [...(pinned ?? shown), key];
  localStorage.setItem("overview", JSON.stringify(pinned));
  choose();
}

function unpin() {
  pinned = null;
  localStorage.removeItem("overview");
  choose();
}

export function choose() {
  follow({ tags: pinned?.join(",") || (pinned ? "-" : null) });
  return load();
}

async function load() {
  loads += 1;
  await loadTiles().finally(() => (loads -= 1));
}

async function loadTiles() {
  const tags = pinned?.join(",") ?? "";
  if (pinned?.length === 0) return showTiles([]);
  const reply = await api("tags", { tags, limit: 200 }).catch(() => null);
  if (!reply?.ok || (pinned?.join(",") ?? "") !== tags) return;
  showTiles(reply.found.tags.map((meta) => describe(meta).key));
  readPast(shown.map(tagOf).filter(({ meta, trail }) => meta.history && !meta.length && trail.length < 3));
}

function showTiles(keys) {
  shown = keys;
  keyed(byId("tiles"), keys, (key) => key, makeTile, showTile);
  fill();
  showAll();
  if (!keys.length) byId("tiles").replaceChildren(h("li", { className: "soft" }, t("No tag is chosen.")));
  const curves = keys.filter((key) => tagOf(key).meta.history && !tagOf(key).meta.length && tagOf(key).meta.type !== "string").slice(0, PENS);
  document.querySelector("[data-view=trend]").href = curves.length ? `#trend?tags=${encodeURIComponent(curves.join(","))}` : "#trend";
  byId("chosen").replaceChildren(
    ...(pinned ? [t("Chosen on this page."), " ", h("button", { type: "button", className: "link", onclick: unpin }, t("Show the choice of the file"))] : []),
  );
}

// Few tiles are larger, so that a wall display is full and is read from far.
function fill() {
  const list = byId("tiles");
  list.removeAttribute("style");
  if (!shown.length || byId("view-overview").hidden || innerWidth < 1000) return;
  const rem = parseFloat(getComputedStyle(list).fontSize);
  const [gap, width] = [0.7 * rem, list.clientWidth];
  const height = byId("main").getBoundingClientRect().bottom - list.getBoundingClientRect().top - byId("main").scrollTop - 2 * rem;
  let best = { scale: 0 };
  for (let columns = 1; columns <= 8; columns += 1) {
    const rows = Math.ceil(shown.length / columns);
    const high = (height - gap * (rows - 1)) / rows;
    const scale = Math.min((width - gap * (columns - 1)) / columns / (13.5 * rem), high / (11.5 * rem), 2.2);
    if (scale > best.scale) best = { scale, columns, high: Math.min(high, 21 * rem) };
  }
  if (best.scale < 0.75) return;
  for (const [name, value] of [["columns", `repeat(${best.columns}, minmax(0, 1fr))`], ["high", `${Math.floor(best.high)}px`], ["scale", best.scale ** 1.25]]) list.style.setProperty(`--${name}`, value);
}

addEventListener("resize", fill);
new ResizeObserver(fill).observe(byId("wrong"));

async function readPast(tags) {
  const next = async () => {
    for (let tag = tags.shift(); tag; tag = tags.shift()) {
      const reply = await api("history", { tag: tag.key, time: PAST, bucket: STEP, agg: "last" }).catch(() => null);
      if (!reply?.ok) return;
      const past = reply.found.buckets.map(({ time, quality, last }) => [Date.parse(time), quality === "bad" || last === null ? null : Number(last)]);
      while (past[0]?.[1] === null) past.shift(); // nothing was recorded yet
      tag.trail = [...past.filter(([time]) => !tag.trail.length || time < tag.trail[0][0]), ...tag.trail];
    }
  };
  await Promise.all(Array.from({ length: AT_ONCE }, next));
}

function makeTile(key) {
  const parts = valueParts();
  const [device, ...rest] = key.split("/");
  const tile = h("li", { className: "tile" });
  tile.parts = parts;
  tile.alarm = h("p", { className: "alarm-text" });
  tile.limits = h("span", { className: "limits" });
  tile.spark = sparkline();
  tile.about = h("span", { className: "about" }, device);
  const { meta } = tagOf(key);
  if (meta.description) put(tile.about, `${device} · ${meta.description}`);
  tile.append(
    h("div", { className: "bar" },
      h("a", { className: "name", href: `#trend?tags=${encodeURIComponent(key)}`, title: title({ meta }) }, rest.join("/"), h("span", { className: "hidden" }, `, ${t("trend of {key}", { key })}`)),
      meta.write && writeButton(key, "✎")), // a word does not fit beside a name
    tile.about, parts.value, tile.spark, tile.alarm,
    h("p", { className: "foot" }, parts.quality, tile.limits, parts.age),
  );
  return tile;
}

function showTile(tile, key) {
  const tag = tagOf(key);
  const live = gateway.live && tag.current;
  showParts(tile.parts, tag, live, true);
  put(tile.limits, limits(tag));
  drawSpark(tile.spark, tag);
  const alarm = alarmsOf(key);
  put(tile.alarm, !alarm ? "" : alarm.state === "returned" ? t("{why}: over, to acknowledge", alarm) : alarm.why);
  tile.alarm.title = tile.alarm.textContent;
  tile.alarm.hidden = !alarm;
  const bad = tag.last && !tag.last.good;
  style(tile, `tile ${alarm ? `in-alarm ${alarm.state}` : ""} ${bad ? "is-bad" : ""} ${live ? "" : "old"}`);
}

function showAll() {
  if (byId("view-overview").hidden) return;
  for (const [key, tile] of byId("tiles").known ?? []) showTile(tile, key);
  if (measured || !document.querySelector(".tile:not(.old)")) return;
  measured = true;
  performance.mark("values"); // the first ones: for benchmarks
}

let measured = false;
let begun = false; // the next values are those of all tiles
on("begin", () => {
  begun = true;
  notCurrent();
});
on("values", (values) => {
  const keys = values.map(([key]) => key);
  if (begun && !loads && keys.join() !== shown.join()) load(); // the file was changed, or could not be read before
  begun = false;
  for (const [key, text, quality, time, why, name] of values) take(tagOf(key), { text, quality, time, why, name });
  showAll();
});
on("tick", showAll);
onLive(showAll);
onAlarms(showAll);
addEventListener("hashchange", () => (fill(), showAll()));
