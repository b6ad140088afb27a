// The strip chart of one line: which device used the wire in the last seconds, and what failed.

import { byId, h, put } from "./dom.js";
import { said, t } from "./language.js";
import { follow, now, on } from "./stream.js";

const WINDOW = 10000; // ms
const MOST_ROWS = 24;
const LISTED = 15; // exchanges below the chart
const LEGEND = { read: t("read"), write: t("write"), probe: t("probe"), wait: t("wait for a late reply"), failed: t("failed ×") };
const KINDS = { read: "read", write: "write", probe: "probe" };

let shown = null; // { line, place, button, the elements, and a function that returns the devices }
let exchanges = [];
let missed = 0;

export function wireOf(line, place, button, devicesOf) {
  const was = shown?.line;
  close();
  if (was === line) return;
  const canvas = h("canvas", { role: "img", "aria-label": t("strip chart of {line}", { line }) });
  const list = h("ul", { className: "exchanges" });
  const sum = h("p", { className: "soft wire-sum" });
  const legend = h("p", { className: "legend", "aria-hidden": "true" }, ...Object.entries(LEGEND).map(([kind, text]) => h("span", { className: kind }, text)));
  place.replaceChildren(canvas, legend, sum, h("details", {}, h("summary", {}, t("Last exchanges, decoded")), list));
  button.setAttribute("aria-pressed", "true");
  shown = { line, place, button, canvas, list, sum, devicesOf };
  follow({ line });
}

function close() {
  if (!shown) return;
  shown.place.replaceChildren();
  shown.button.setAttribute("aria-pressed", "false");
  shown = null;
  follow({ line: null });
}

addEventListener("hashchange", () => byId("view-lines").hidden && close());

on("begin", () => {
  exchanges = [];
});

on("wire", (found) => {
  for (const [number, begun, took, device, kind, what, result, failed] of found.exchanges) {
    exchanges.push({ number, begun, took, device, kind, what, result, failed });
  }
  missed = found.missed;
  exchanges = exchanges.filter((one) => one.begun >= exchanges.at(-1).begun - WINDOW - 2000).slice(-5000);
  shown?.list.replaceChildren(...exchanges.slice(-LISTED).reverse().map((one) => h("li", {},
    h("span", { className: "age" }, new Date(one.begun).toISOString().slice(11, 23)), h("b", {}, one.device), h("span", {}, one.what),
    h("span", { className: "age" }, `${(one.took * 1000).toFixed(0)} ms`),
    h("span", { className: one.failed ? "wrong" : "soft" }, one.failed ? t("failed: {why}", { why: said(one.result) }) : said(one.result)))));
});

on("time", () => shown && draw());

function draw() {
  const { line, canvas, sum, devicesOf } = shown;
  const until = now();
  const seen = exchanges.filter((one) => one.begun + one.took * 1000 > until - WINDOW);
  const of = (device) => seen.filter((one) => one.device === device);
  const names = devicesOf(line);
  const rows = names.length > MOST_ROWS ? names.filter((name) => of(name).length).slice(0, MOST_ROWS) : names;
  const failed = seen.filter((one) => one.failed).length;
  const busy = seen.reduce((all, one) => all + one.took, 0);
  put(sum, [t("{n} exchanges in 10 s, {failed} failed, in use {share} % of the time", { n: seen.length, failed, share: Math.min(100, Math.round((100 * busy * 1000) / WINDOW)) }), missed && t("{n} are not shown", { n: missed })].filter(Boolean).join("; "));
  const [width, row] = [canvas.clientWidth, 24];
  const left = Math.min(160, width / 3);
  const height = row * Math.max(1, rows.length) + 22;
  const scale = devicePixelRatio;
  if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
    canvas.width = Math.round(width * scale);
    canvas.height = Math.round(height * scale);
    canvas.style.height = `${height}px`;
  }
  const pen = canvas.getContext("2d");
  const theme = getComputedStyle(document.documentElement);
  const color = (name) => theme.getPropertyValue(`--${name}`);
  pen.setTransform(scale, 0, 0, scale, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.font = "13px system-ui, sans-serif";
  const x = (time) => left + ((width - left) * (time - until + WINDOW)) / WINDOW;
  for (let second = 0; second <= 10; second += 2) {
    const at = x(until - WINDOW + second * 1000);
    pen.fillStyle = color("edge");
    pen.fillRect(Math.min(at, width - 1), 0, 1, height - 20);
    pen.fillStyle = color("soft");
    pen.textAlign = second === 10 ? "right" : "center";
    pen.fillText(second === 10 ? t("now") : t("{n} s", { n: second - 10 }), at, height - 4);
  }
  rows.forEach((name, number) => {
    const top = number * row;
    pen.fillStyle = color("ink");
    pen.textAlign = "left";
    pen.fillText(name, 0, top + 16, left - 8);
    for (const one of of(name)) {
      const from = Math.max(left, x(one.begun));
      const wide = Math.max(2, x(one.begun + one.took * 1000) - from);
      pen.fillStyle = color(one.failed ? "bad" : (KINDS[one.kind] ?? "wait"));
      pen.fillRect(from, top + (one.failed ? 3 : 7), wide, one.failed ? 18 : 10);
      if (one.failed) pen.fillText("×", Math.min(from + wide + 1, width - 9), top + 13);
    }
  });
}
