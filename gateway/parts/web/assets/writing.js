// Writing a tag where it is shown: unit, limits, present value, and a second step before it is sent.

import { h, put } from "./dom.js";
import { listed, said, t } from "./language.js";
import { gateway, post, signedIn } from "./stream.js";
import { shown, tagOf } from "./values.js";

let open = null; // the editor

// Hidden by the class `read-only` of the page where nothing can be written.
export function writeButton(key, text = t("Write")) {
  const label = t("write {key}", { key });
  return h("button", { type: "button", className: "quiet write", title: label, "aria-label": label, onclick: (event) => edit(key, event.currentTarget) }, text);
}

async function edit(key, button) {
  const was = open?.of;
  close();
  if (was === button || !(await signedIn())) return;
  const tag = tagOf(key);
  const input = field(tag.meta);
  const send = h("button", { type: "submit", className: "main" }, t("Write …"));
  const result = h("p", { className: "result", role: "alert" });
  const present = h("b");
  const editor = h("form", { className: "editor", "aria-label": t("write {key}", { key }) },
    h("p", {}, t("{key}, now", { key }), " ", present),
    h("label", {}, h("span", { className: "hidden" }, t("New value")), input, " ", tag.meta.unit),
    h("span", { className: "soft" }, allowed(tag.meta)),
    h("span", { className: "bar" }, send, h("button", { type: "button", onclick: close }, t("Close"))),
    result);
  const disarm = () => {
    editor.armed = false;
    put(send, t("Write …"));
  };
  input.addEventListener("input", disarm);
  editor.addEventListener("keydown", (event) => event.key === "Escape" && close());
  editor.addEventListener("submit", async (event) => {
    event.preventDefault();
    const text = input.value.trim();
    if (!(await signedIn())) return;
    if (!gateway.live) return put(result, t("Not live: nothing was sent."));
    if (!editor.armed) {
      editor.armed = true;
      put(result, "");
      return put(send, t("Confirm: {value}", { value: `${text} ${tag.meta.unit}`.trim() }));
    }
    disarm();
    send.disabled = true;
    put(result, t("writing …"));
    put(result, await write(key, text, tag.meta));
    send.disabled = false;
  });
  const timer = setInterval(() => put(present, shown(tag).slice(0, 2).join(" ").trim()), 250);
  put(present, shown(tag).slice(0, 2).join(" ").trim());
  open = { editor, timer, of: button };
  button.closest("li, .row").append(editor);
  button.closest("li, .row").classList.add("editing");
  input.focus();
}

function close() {
  if (!open) return;
  clearInterval(open.timer);
  open.editor.parentElement?.classList.remove("editing");
  open.editor.remove();
  open.of.focus();
  open = null;
}

export const isEdited = (row) => open !== null && row.contains(open.editor);

function field(meta) {
  const names = meta.type === "bool" ? { true: t("on"), false: t("off") } : meta.enum;
  if (!names || meta.length) return h("input", { required: true, autocomplete: "off", inputMode: meta.type === "string" ? "text" : "decimal" });
  return h("select", {}, ...Object.entries(names).map(([value, name]) => h("option", { value }, name)));
}

function allowed({ write, length, unit }) {
  const { min, max, verify } = write;
  const ends = [min !== null && t("at least {n}", { n: `${min} ${unit}`.trim() }), max !== null && t("at most {n}", { n: `${max} ${unit}`.trim() }), length && t("{n} values, as [1, 2]", { n: length }), verify && t("read back")];
  return listed(ends);
}

async function write(tag, text, meta) {
  try {
    const { ok, found } = await post("write", { tag }, meta.length ? text : asJson(text));
    if (!ok) return t("Not done: {why}", { why: [found.error, found.reason].filter(Boolean).map(said).join(": ") });
    const done = !found.acknowledged ? t("sent to all, which no device acknowledges") : found.verified ? t("acknowledged and read back") : t("acknowledged by the device");
    return `${`${found.value} ${meta.unit}`.trim()}: ${done}${found.note ? `. ${said(found.note)}` : ""}`;
  } catch {
    return t("The connection ended; it is not known whether the value was written.");
  }
}

// A number or true and false go out as they are typed: a number of JavaScript would round them.
function asJson(text) {
  return /^(true|false|-?\d+(\.\d+)?([eE][+-]?\d+)?)$/.test(text) ? text : JSON.stringify(text);
}
