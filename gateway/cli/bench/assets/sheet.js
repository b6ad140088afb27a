// Import with a preview: columns and the settings that they mean, first rows, mistakes; then add.

import { byId, h, put } from "./dom.js";
import { t } from "./language.js";
import { call, step } from "./call.js";

let columns = {}; // the title of each setting that was chosen
let settings = [];
let after = () => {};

export function startSheet(changed) {
  after = changed;
  byId("sheet").addEventListener("change", () => {
    columns = {};
    const [file] = byId("sheet").files;
    if (file) step(byId("sheet"), "sheet-said", async () => show(await call(`sheet?${new URLSearchParams({ name: file.name, device: byId("sheet-device").value })}`, undefined, file)));
  });
  byId("sheet-device").addEventListener("change", again);
  byId("import").addEventListener("click", () => step(byId("import"), "sheet-said", async () => {
    const count = await call("import", asked());
    hide();
    put("sheet-said", t("{n} tags are in the change now.", { n: count }));
    byId("sheet").value = "";
    after();
  }));
}

export function showSheetDevices(devices, known) {
  settings = known;
  const names = devices.map((one) => one.device);
  const list = byId("sheet-device");
  if (list.names === names.join("\n")) return;
  list.names = names.join("\n");
  list.replaceChildren(...names.map((name) => h("option", {}, name)));
}

const asked = () => ({ device: byId("sheet-device").value, columns });
const again = () => byId("sheet").files.length && step(byId("sheet-device"), "sheet-said", async () => show(await call("columns", asked())));

function hide() {
  for (const part of [byId("sheet-table").tHead, byId("sheet-table").tBodies[0], byId("sheet-mistakes")]) part.replaceChildren();
  byId("import").hidden = byId("sheet-tags").hidden = true;
}

function show(found) {
  hide();
  const unknown = found.columns.filter((one) => one.title && !one.setting);
  put("sheet-said", `${t("{n} rows.", { n: found.count })} ${unknown.length ? t("Not used: {columns}.", { columns: unknown.map((one) => one.title).join(", ") }) : t("Every column is known.")}`);
  byId("sheet-table").tHead.append(h("tr", {}, ...found.columns.map((one) => h("th", { className: one.setting ? "" : "unknown" }, one.title || one.letter, h("br"), picker(one)))));
  byId("sheet-table").tBodies[0].append(...found.rows.map((row) => h("tr", {}, ...found.columns.map((_, at) => h("td", {}, row[at] ?? "")))));
  byId("sheet-mistakes").append(...found.mistakes.map((one) => h("li", {}, one)));
  byId("sheet-tags").replaceChildren(...found.tags.map((one) => h("span", {}, one)));
  byId("sheet-tags").hidden = !found.tags.length;
  byId("import").hidden = !!found.mistakes.length;
  put("import", t("Import {n} tags", { n: found.count }));
}

function picker({ title, setting }) {
  const list = h("select", { "aria-label": t("setting of column {title}", { title }), onchange: () => {
    for (const [name, one] of Object.entries(columns)) if (one === title) delete columns[name];
    if (list.value) columns[list.value] = title;
    again();
  } }, h("option", { value: "" }, t("not used")), ...[...new Set([...(setting ? [setting] : []), ...settings])].map((one) => h("option", { value: one }, one)));
  list.value = setting ?? "";
  return list;
}
