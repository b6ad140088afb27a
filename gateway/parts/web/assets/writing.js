// Writing a tag where it is shown: unit, limits, present value, and a second step before it is sent.

import { h, put } from "./dom.js";
import { gateway, post, signedIn } from "./stream.js";
import { shown, tagOf } from "./values.js";

let open = null; // the editor

// Hidden by the class `read-only` of the page where nothing can be written.
export function writeButton(key) {
  return h("button", { type: "button", className: "quiet write", "aria-label": `write ${key}`, onclick: (event) => edit(key, event.currentTarget) }, "Write");
}

async function edit(key, button) {
  const was = open?.of;
  close();
  if (was === button || !(await signedIn())) return;
  const tag = tagOf(key);
  const input = field(tag.meta);
  const send = h("button", { type: "submit", className: "main" }, "Write …");
  const result = h("p", { className: "result", role: "alert" });
  const present = h("b");
  const editor = h("form", { className: "editor", "aria-label": `write ${key}` },
    h("p", {}, key, ", now ", present),
    h("label", {}, h("span", { className: "hidden" }, "New value"), input, " ", tag.meta.unit),
    h("span", { className: "soft" }, allowed(tag.meta)),
    h("span", { className: "bar" }, send, h("button", { type: "button", onclick: close }, "Close")),
    result);
  const disarm = () => {
    editor.armed = false;
    put(send, "Write …");
  };
  input.addEventListener("input", disarm);
  editor.addEventListener("keydown", (event) => event.key === "Escape" && close());
  editor.addEventListener("submit", async (event) => {
    event.preventDefault();
    const text = input.value.trim();
    if (!gateway.live) return put(result, "Not live: nothing was sent.");
    if (!editor.armed) {
      editor.armed = true;
      put(result, "");
      return put(send, `Confirm: ${text} ${tag.meta.unit}`.trim());
    }
    disarm();
    send.disabled = true;
    put(result, "writing …");
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
  const names = meta.type === "bool" ? { true: "on", false: "off" } : meta.enum;
  if (!names || meta.length) return h("input", { required: true, autocomplete: "off", inputMode: meta.type === "string" ? "text" : "decimal" });
  return h("select", {}, ...Object.entries(names).map(([value, name]) => h("option", { value }, name)));
}

function allowed({ write, length, unit }) {
  const { min, max, verify } = write;
  const ends = [min !== null && `at least ${min} ${unit}`.trim(), max !== null && `at most ${max} ${unit}`.trim(), length && `${length} values, as [1, 2]`, verify && "read back"];
  return ends.filter(Boolean).join(", ");
}

async function write(tag, text, meta) {
  try {
    const { ok, found } = await post("write", { tag }, meta.length ? text : asJson(text));
    if (!ok) return `Not done: ${found.error}${found.reason ? `: ${found.reason}` : ""}`;
    const done = !found.acknowledged ? "sent to all, which no device acknowledges" : found.verified ? "acknowledged and read back" : "acknowledged";
    return `${`${found.value} ${meta.unit}`.trim()}: ${done}${found.note ? `. ${found.note}` : ""}`;
  } catch {
    return "The connection ended; it is not known whether the value was written.";
  }
}

// A number or true and false go out as they are typed: a number of JavaScript would round them.
function asJson(text) {
  return /^(true|false|-?\d+(\.\d+)?([eE][+-]?\d+)?)$/.test(text) ? text : JSON.stringify(text);
}
