// Small helpers: elements, text, times.

import { dates, t } from "./language.js";

export const byId = (id) => document.getElementById(id);

// Makes an element: properties, `data-…`, `aria-…` and `role` as attributes, `on…` as listeners.
export function h(name, properties = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(properties)) {
    if (value === undefined || value === null || value === false) continue;
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (key.includes("-") || key === "role" || key === "for") made.setAttribute(key, value);
    else made[key] = value;
  }
  made.append(...children.filter((one) => one !== null && one !== undefined && one !== false && one !== ""));
  return made;
}

export const svg = (name, attributes = {}) => {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
};

export function put(target, text) {
  const element = typeof target === "string" ? byId(target) : target;
  if (element.textContent !== text) element.textContent = text;
}

export function style(element, className) {
  if (element.className !== className) element.className = className;
}

// Keeps the children of a list in the order of `items`; `make` and `update` one of them by its key.
export function keyed(list, items, key, make, update) {
  const known = (list.known ??= new Map());
  const wanted = new Map(items.map((item) => [key(item), item]));
  for (const child of [...list.children]) {
    if (wanted.has(child.key) && known.get(child.key) === child) continue;
    child.remove(); // also a text that said it was empty
    known.delete(child.key);
  }
  let place = list.firstElementChild;
  for (const [name, item] of wanted) {
    let child = known.get(name);
    if (!child) known.set(name, (child = make(item)));
    child.key = name;
    if (child === place) place = place.nextElementSibling;
    else list.insertBefore(child, place);
    update(child, item);
  }
}

export const clock = (ms) => new Date(ms).toLocaleTimeString(dates, { hour12: false });

export function moment(ms) {
  if (Number.isNaN(ms)) return "";
  return Math.abs(Date.now() - ms) < 86400e3 ? clock(ms) : new Date(ms).toLocaleString(dates, { hour12: false });
}

export function span(seconds) {
  if (seconds < 10) return t("{n} s", { n: seconds.toFixed(1) });
  if (seconds < 120) return t("{n} s", { n: Math.round(seconds) });
  if (seconds < 7200) return t("{n} min", { n: Math.round(seconds / 60) });
  return seconds < 172800 ? t("{n} h", { n: Math.round(seconds / 3600) }) : t("{n} d", { n: Math.round(seconds / 86400) });
}

// The view and its choices are in the address, so that a link or a wall display keeps them.
export function place() {
  const [view, rest] = location.hash.slice(1).split(/\?(.*)/s);
  return { view: view || "overview", choice: new URLSearchParams(rest ?? "") };
}

export function go(view, choice = {}, replace = false) {
  const query = new URLSearchParams();
  for (const [name, value] of Object.entries(choice)) if (value) query.set(name, value);
  const hash = `#${view}${query.size ? `?${query}` : ""}`;
  if (!replace) location.hash = hash;
  else if (location.hash !== hash) {
    history.replaceState(null, "", hash);
    dispatchEvent(new Event("hashchange"));
  }
}
