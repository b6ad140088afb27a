// The language of the page: its own texts by their English words, and sentences of the gateway.

import catalogue from "./catalogue.js";

export const locale = catalogue.code;
const KEPT = 500; // translated sentences
const PLACE = /\{(\w+)\}/g;

const fill = (text, given) => text.replace(PLACE, (_, name) => given[name]);

// Returns a text of the page; `{name}` is filled in.
export const t = (text, given = {}) => fill(catalogue.page[text] ?? text, given);

// German has the decimal point of the values, so it has no comma between thousands.
export const whole = (number) => number.toLocaleString("en", { useGrouping: locale !== "de" });

export const several = (number, one, many, given = {}) => t(number === 1 ? one : many, { n: whole(number), ...given });

export const listed = (items) => items.filter(Boolean).join(t(", "));

// As dates and times are written; English: as the browser writes them.
export const dates = locale === "en" ? [] : locale;

// -- sentences of the gateway --

// As `gateway.contract.translation`, where the kinds of places are explained.
const KINDS = [[/^(why|text)/, ".+"], [/^names/, "[^:;]+"], [/^n$/, "[-+\\d.,]+"], [/^/, "\\S+"]];
const literal = (text) => text.replace(PLACE, "").length;
const patterns = Object.entries(catalogue.sentences).sort(([one], [other]) => literal(other) - literal(one)).map(([from, to]) => {
  const parts = from.split(PLACE); // text and names in turn
  const source = parts.map((part, at) => (at % 2 ? `(?<${part}>${KINDS.find(([kind]) => kind.test(part))[1]})` : part.replace(/[.*+?^${}()|[\]\\]/g, "\\$&")));
  return [new RegExp(`^${source.join("")}$`, "s"), to];
});
const known = new Map();

// Returns a sentence of the gateway in the language of the page; an unknown one stays as it is.
export function said(text) {
  if (!text || !patterns.length) return text;
  if (!known.has(text)) {
    if (known.size >= KEPT) known.clear();
    known.set(text, translated(text));
  }
  return known.get(text);
}

function translated(text) {
  for (const [pattern, to] of patterns) {
    const found = text.match(pattern);
    if (!found) continue;
    const parts = Object.entries(found.groups ?? {}).map(([name, part]) => [name, /^(why|names)/.test(name) ? translated(part) : part]);
    return fill(to, Object.fromEntries(parts));
  }
  return text;
}

// -- the texts of the document, and the choice --

const ATTRIBUTES = ["aria-label", "placeholder"];

function translate(root) {
  for (const one of root.querySelectorAll("*")) {
    for (const name of ATTRIBUTES) if (one.hasAttribute(name)) one.setAttribute(name, t(one.getAttribute(name)));
    for (const node of one.childNodes) if (node.nodeType === Node.TEXT_NODE && node.data.trim()) node.data = node.data.replace(node.data.trim(), (text) => t(text));
  }
}

document.documentElement.lang = locale;
translate(document);

// The choice is kept as a cookie: the gateway sends one catalogue only.
const choice = document.getElementById("language");
if (choice) {
  const option = (value, text) => Object.assign(document.createElement("option"), { value, textContent: text, lang: value });
  choice.append(...Object.entries(catalogue.languages).map(([code, name]) => option(code, name)));
  choice.value = locale;
  choice.addEventListener("change", () => {
    document.cookie = `language=${choice.value}; max-age=31536000; samesite=strict`;
    location.reload();
  });
}
